"""The GPU's own part of a call, told apart from the host's: the time in which the GPU works, by torch's profiler."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

# Events of a trace that keep the GPU busy.
BUSY = ("kernel", "gpu_memcpy", "gpu_memset")


def gpu_time(run: Callable[[], Any], repeats: int) -> float:
    """Return the milliseconds that a call keeps the GPU busy, the mean of several calls.

    Gaps in which the GPU waits for the host do not count, kernels that run side by side count once. Launches of torch,
    of Warp and of CUDA graphs are all seen.
    """
    run()
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        for _ in range(repeats):
            run()
        torch.cuda.synchronize()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "trace.json"
        profiler.export_chrome_trace(str(file))
        events = json.loads(file.read_text())["traceEvents"]
    return busy([(e["ts"], e["ts"] + e["dur"]) for e in events if e.get("cat") in BUSY]) / repeats / 1e3


def busy(spans: list[tuple[float, float]]) -> float:
    """Return the length of the union of intervals (start, end)."""
    total, reached = 0.0, float("-inf")
    for start, end in sorted(spans):
        total += max(0.0, end - max(start, reached))
        reached = max(reached, end)
    return total
