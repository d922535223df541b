"""Fuzzing of every reader with damaged files: `python -m tests.robustness.fuzz --seconds 60`.

An input is a small valid file with damage: bytes flipped, cut or spliced, numbers replaced by extreme ones, JSON with
values of other types, repeated keys, deep nesting. An input passes when its reader loads it or refuses it with a
documented exception of one line. It fails when the process dies, takes longer than 5 s, needs more than 1 GB of
additional memory, or raises another exception. Inputs run in forked processes, many per process; failing inputs are
saved. The same seed gives the same inputs.
"""

import argparse
import ctypes
import multiprocessing
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import psutil
import warp as wp

from nexwarp.kernels import launch
from tests.robustness.fuzz_inputs import Files, damage
from tests.robustness.fuzz_targets import TARGETS, FuzzTarget

HANG = 5.0  # seconds an input may use the processor
ASLEEP = 6  # how many times as long it may take where it does not use it: on a busy machine, or asleep
MEMORY = 10**9  # bytes that the process may have beyond those before its first input
BATCH = 2000  # inputs a process
DOCUMENTED = (ValueError, TypeError, FileNotFoundError)
M_ARENA_MAX = -8  # of glibc's mallopt: an arena a thread would count as 64 MB of address space
NO_MEMORY = ("can't allocate", "bad_alloc", "not enough memory", "Unable to allocate", "std::length_error")


@dataclass(frozen=True)
class Failure:
    """How a reader failed on an input, and where that is saved."""

    kind: str
    detail: str
    index: int = 0
    folder: Path | None = None


@dataclass
class Result:
    """Outcomes of a target's inputs: those that did not load were refused with a documented exception, or failed."""

    inputs: int = 0
    loaded: int = 0
    refusals: Counter[str] = field(default_factory=Counter)
    failures: list[Failure] = field(default_factory=list)


def judge(read: Callable[[Path], object], folder: Path) -> str | Failure:
    """Read an input: "loaded", the name of a documented exception, or a failure."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)
            read(folder)
    except Exception as error:
        text = "".join(traceback.format_exception(error))
        if any(isinstance(e, MemoryError) or any(word in str(e) for word in NO_MEMORY) for e in _causes(error)):
            return Failure("memory", text)
        if not isinstance(error, DOCUMENTED) and not (isinstance(error, OSError) and str(folder) in str(error)):
            return Failure(type(error).__name__, text)
        message = str(error)
        if str(folder) not in message or "\n" in message or not message.isprintable() or len(message) > 2000:
            return Failure("message", text)
        return type(error).__name__
    return "loaded"


def _causes(error: BaseException) -> list[BaseException]:
    chain: list[BaseException] = []
    link: BaseException | None = error
    while link is not None and link not in chain:
        chain.append(link)
        link = link.__cause__ or link.__context__
    return chain


@dataclass(frozen=True)
class Campaign:
    """A target's inputs; those that fail are kept in the folder `failed`."""

    target: FuzzTarget
    seed: int
    failed: Path

    def run(self, *, seconds: float, inputs: int) -> Result:
        """Run until time or inputs are used up."""
        result, index, end = Result(), 0, time.monotonic() + seconds
        with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as scratch:
            valid = self.target.make(Path(scratch) / "valid")
            folder = Path(scratch) / "input"
            while index < inputs and time.monotonic() < end:
                index = self._batch(valid, folder, result, range(index, min(index + BATCH, inputs)), end)
        return result

    def _batch(self, valid: list[Files], folder: Path, result: Result, indices: range, end: float) -> int:
        """Run inputs in one forked process, and return the index to continue with."""
        context = multiprocessing.get_context("fork")
        ours, theirs = context.Pipe(duplex=False)
        now = context.RawArray("d", [float(indices.start), time.monotonic(), 0.0])
        process = context.Process(target=self._work, args=(valid, folder, theirs, now, indices, end), daemon=True)
        process.start()
        theirs.close()
        hung = False
        while True:
            try:
                if hung or ours.poll(0.1):
                    self._collect(ours.recv(), result)
            except EOFError:
                break
            if not hung and _hangs(process.pid, now):
                hung = True
                process.kill()
        process.join()
        index = int(now[0])
        if process.exitcode == 0:
            return index
        detail = f"longer than {HANG:g} s" if hung else f"exit code {process.exitcode}"
        failure = Failure("hang" if hung else "crash", detail, index)
        result.inputs += 1
        result.failures.append(self._saved(failure, folder))
        return index + 1

    def _collect(self, message: tuple[Any, ...], result: Result) -> None:
        if isinstance(message[0], Failure):
            failure, folder = message
            result.failures.append(self._saved(failure, folder))
            shutil.rmtree(folder, ignore_errors=True)
            return
        inputs, loaded, refusals = message
        result.inputs += inputs
        result.loaded += loaded
        result.refusals += refusals

    def _saved(self, failure: Failure, folder: Path) -> Failure:
        kept = self.failed / f"{self.target.name}-{failure.index}-{failure.kind}"
        kept.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(kept, ignore_errors=True)
        if folder.is_dir():
            shutil.copytree(folder, kept, symlinks=True)
        else:
            kept.mkdir()
        (kept / "failure.txt").write_text(failure.detail, encoding="utf-8", errors="backslashreplace")
        return replace(failure, folder=kept)

    def _work(self, valid: list[Files], folder: Path, report: Connection, now: Any, indices: range, end: float) -> None:
        """Body of the forked process; its reports count only inputs that ended."""
        _confine()
        for index in indices:
            rng = random.Random(f"{self.seed}/{self.target.name}/{index}")
            self.target.write(folder, damage(rng, rng.choice(valid), self.target.fuzzed))
            now[:] = [float(index), time.monotonic(), time.process_time()]
            outcome = judge(self.target.read, folder)
            if isinstance(outcome, Failure):
                kept = folder.with_name(f"failed-{index}")
                shutil.copytree(folder, kept, symlinks=True)
                report.send((replace(outcome, index=index), kept))
                report.send((1, 0, Counter()))
            else:
                loaded = outcome == "loaded"
                report.send((1, int(loaded), Counter() if loaded else Counter([outcome])))
            now[:] = [float(index + 1), time.monotonic(), time.process_time()]
            if time.monotonic() > end:
                break
        report.close()
        shutil.rmtree(folder.parent / "cache", ignore_errors=True)
        os._exit(0)


def _hangs(process: int | None, now: Sequence[float]) -> bool:
    """Whether a process works for too long on an input, begun at the times now[1:], monotonic and of the process."""
    seconds = time.monotonic() - now[1]
    if seconds <= HANG or process is None:
        return False
    try:
        used = sum(psutil.Process(process).cpu_times()[:2])
    except psutil.Error:  # it has ended
        return False
    return used - now[2] > HANG or seconds > ASLEEP * HANG


def _confine() -> None:
    """Print nothing, and take little memory."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    sys.stdout = sys.stderr = open(os.devnull, "w")
    launch.set_num_threads(1)  # each thread would take memory of its own
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL("libc.so.6").mallopt(M_ARENA_MAX, 1)
    base = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (base + MEMORY, base + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.robustness.fuzz", description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of the whole run")
    parser.add_argument("--inputs", type=int, default=10**9, help="at most so many a target")
    parser.add_argument("--targets", nargs="+", default=list(TARGETS), choices=list(TARGETS), metavar="TARGET")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--failed", type=Path, default=Path("fuzz_failures"), help="where inputs that fail are kept")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_ERROR
    end, total, failures = time.monotonic() + options.seconds, 0, 0
    for place, name in enumerate(options.targets):
        seconds = (end - time.monotonic()) / (len(options.targets) - place)
        result = Campaign(TARGETS[name], options.seed, options.failed).run(seconds=seconds, inputs=options.inputs)
        total, failures = total + result.inputs, failures + len(result.failures)
        refused = ", ".join(f"{count:,} {kind}" for kind, count in result.refusals.most_common())
        figures = f"{result.inputs:>9,} inputs {result.loaded:>9,} loaded {len(result.failures):>4} failures"
        print(f"{name:18} {figures}  ({refused})", flush=True)
        for failure in result.failures[:10]:
            print(f"    {failure.kind} at {failure.folder}: {failure.detail.strip().splitlines()[-1][:200]!a}")
    print(f"{total:,} inputs, {failures} failures, in {options.seconds:.0f} s")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
