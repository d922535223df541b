"""The benchmarks' timer: warm-up, CUDA events or the wall clock, median and spread, peak memory, JSON lines."""

import dataclasses
import datetime
import functools
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

ROOT = Path(__file__).resolve().parents[1]
MIB = 2**20


@functools.cache
def git_commit() -> str:
    """Commit of the working tree, with a + when it was changed; without git NEXWARP_COMMIT or else "unknown"."""
    try:
        git = functools.partial(subprocess.run, cwd=ROOT, capture_output=True, text=True, check=True, timeout=10)
        head = git(["git", "rev-parse", "--short", "HEAD"]).stdout.strip()
        changed = git(["git", "status", "--porcelain"]).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return os.environ.get("NEXWARP_COMMIT", "unknown")
    return head + ("+" if changed else "")


@dataclass(frozen=True)
class Measurement:
    """One figure, with all facts that are needed to reproduce it.

    Attributes:
        name: what was measured.
        scene: what it was measured on.
        device: "cuda" or "cpu".
        unit: of `median`, `p10` and `p90`.
        median, p10, p90: over `repeats` runs.
        repeats: how many runs.
        peak_mib: peak memory during the runs, MiB: on CUDA, of torch's allocator plus the high-water mark of Warp's
            pool; on a CPU, of the whole process (Linux only).
        sizes: surfels, width, height and the like.
        note: remarks for the reader.
        device_name, commit, date, versions: of the measurement.
    """

    name: str
    scene: str
    device: str
    median: float
    p10: float
    p90: float
    unit: str = "ms"
    repeats: int = 1
    peak_mib: float | None = None
    sizes: dict[str, Any] = field(default_factory=dict)
    note: str = ""
    device_name: str = ""
    commit: str = field(default_factory=git_commit)
    date: str = field(default_factory=lambda: datetime.datetime.now(datetime.timezone.utc).isoformat("T", "seconds"))
    versions: str = field(default_factory=lambda: f"torch {torch.__version__}, warp {wp.__version__}")

    def json(self) -> str:
        """One line."""
        return json.dumps(dataclasses.asdict(self))


@dataclass(frozen=True)
class Repeats:
    """How often a function is timed.

    Attributes:
        seconds: stop repeating after this long.
        warmup: untimed runs; the first one compiles.
        least: timed runs at least, however long they take.
        most: timed runs at most.
    """

    seconds: float = 2.0
    warmup: int = 3
    least: int = 5
    most: int = 100


def measure(
    runs: Mapping[str, Callable[[], Any]], device: torch.device, repeats: Repeats, **facts: Any
) -> list[Measurement]:
    """Time functions after warming them up: in turns, so that what slows the machine for a while slows them all.

    On CUDA each run lies between two events and is waited for, so that launches that are slower than the kernels count.
    With several functions, the peak of memory is that of all. `facts` are those of `figure`.
    """
    for run in list(runs.values()) * repeats.warmup:
        run()
    clock = _cuda_clock if device.type == "cuda" else _wall_clock
    synchronize(device)
    reset_peak(device)
    start = time.perf_counter()
    times: dict[str, list[float]] = {name: [] for name in runs}
    done, longest = 0, repeats.seconds * len(runs)
    while done < repeats.least or (done < repeats.most and time.perf_counter() - start < longest):
        for name, run in runs.items():
            times[name].append(clock(run))
        done += 1
    facts["peak_mib"] = peak(device)
    return [figure(name, values, device, **facts) for name, values in times.items()]


def figure(name: str, values: float | list[float], device: torch.device, **facts: Any) -> Measurement:
    """Make a measurement of given values; `facts` are other fields of it, the scene at least."""
    values = values if isinstance(values, list) else [values]
    p10, median, p90 = np.quantile(values, [0.1, 0.5, 0.9]).tolist()
    facts |= {"repeats": len(values), "device_name": device_name(device.type)}
    return Measurement(name=name, device=device.type, median=median, p10=p10, p90=p90, **facts)


def mean_ms(run: Callable[[], Any], count: int, device: torch.device) -> float:
    """Return the milliseconds of a call, by the wall clock, of several without a pause between them."""
    synchronize(device)
    start = time.perf_counter()
    for _ in range(count):
        run()
    synchronize(device)
    return 1e3 * (time.perf_counter() - start) / count


def ratio(name: str, top: Measurement, bottom: Measurement, note: str = "") -> Measurement:
    """Ratio of two medians of one run; its spread is that of `top` alone, over the median of `bottom`."""
    median, p10, p90 = (value / bottom.median for value in (top.median, top.p10, top.p90))
    kept = dataclasses.replace(top, name=name, unit="x", note=note, peak_mib=None)
    return dataclasses.replace(kept, median=median, p10=p10, p90=p90)


def synchronize(device: torch.device) -> None:
    """Wait for a GPU; nothing on a CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def reset_peak(device: torch.device) -> None:
    """Start a new peak."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass


def peak(device: torch.device) -> float | None:
    """Return the peak memory since `reset_peak` in MiB; None where the system does not provide it."""
    if device.type == "cuda":
        pool = wp.get_mempool_used_mem_high(f"cuda:{device.index or 0}")
        return (torch.cuda.max_memory_allocated(device) + pool) / MIB
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:")), None)


@functools.cache
def device_name(kind: str) -> str:
    """Name of the GPU, or of the processor and how many cores this process may use."""
    if kind == "cuda":
        return torch.cuda.get_device_name()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{model}, {cores} cores"


def _cuda_clock(run: Callable[[], Any]) -> float:
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    run()
    end.record()
    end.synchronize()
    return start.elapsed_time(end)


def _wall_clock(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - start)
