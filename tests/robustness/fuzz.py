"""Fuzzing of every reader with damaged files: `python -m tests.robustness.fuzz --seconds 60`.

An input is a small valid file with damage: bytes flipped, cut or spliced, numbers replaced by extreme ones, JSON with
values of other types, repeated keys, deep nesting. An input passes when its reader loads it or refuses it with a
documented exception of one line. It fails when the process dies, takes longer than 5 s, needs more than 1 GB of
additional memory, or raises another exception. Inputs run in forked processes, many per process; failing inputs are
saved. The same seed gives the same inputs.
"""

import argparse
import contextlib
import ctypes
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path

import warp as wp

from nexwarp.kernels import launch
from tests.robustness.fuzz_inputs import Files, damage
from tests.robustness.fuzz_targets import TARGETS, FuzzTarget, write_input

HANG = 5.0  # seconds an input may use the processor
ASLEEP = 6  # how many times as long it may take where it does not use it: on a busy machine, or asleep
MEMORY = 10**9  # bytes that the process may have beyond those before its first input
BATCH = 2000  # inputs a process
DOCUMENTED = (ValueError, TypeError, FileNotFoundError)
M_ARENA_MAX = -8  # of glibc's mallopt: an arena a thread would count as 64 MB of address space
NO_MEMORY = ("MemoryError", "can't allocate", "bad_alloc", "not enough memory", "Unable to allocate", "length_error")


@dataclass(frozen=True)
class Failure:
    """How a reader failed on an input, and where that is saved."""

    kind: str
    detail: str
    folder: Path | None = None


@dataclass
class Result:
    """Outcomes of a target's inputs: those that did not load were refused with a documented exception, or failed."""

    inputs: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)  # "loaded", or the name of an exception
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
        reasons: list[str] = []
        link: BaseException | None = error
        while link is not None:
            reasons.append(repr(link))
            link = link.__cause__ or link.__context__
        if any(word in reason for word in NO_MEMORY for reason in reasons):
            return Failure("memory", text)
        if not isinstance(error, DOCUMENTED) and not (isinstance(error, OSError) and str(folder) in str(error)):
            return Failure(type(error).__name__, text)
        message = str(error)
        if str(folder) not in message or "\n" in message or not message.isprintable() or len(message) > 2000:
            return Failure("message", text)
        return type(error).__name__
    return "loaded"


@dataclass(frozen=True)
class Campaign:
    """A target's inputs; those that fail are kept in the folder `failed`."""

    target: FuzzTarget
    seed: int
    failed: Path

    def run(self, *, seconds: float, inputs: int) -> Result:
        """Run until time or inputs are used up."""
        result, end = Result(), time.monotonic() + seconds
        context = multiprocessing.get_context("fork")
        with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as scratch:
            made, folder = Path(scratch) / "valid", Path(scratch) / "input"
            made.mkdir()
            valid = self.target.make(made)
            while result.inputs < inputs and time.monotonic() < end:
                indices = range(result.inputs, min(result.inputs + BATCH, inputs))
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=self._work, args=(valid, folder, theirs, indices, end), daemon=True)
                process.start()
                theirs.close()
                with contextlib.suppress(EOFError, OSError):  # it has ended
                    while True:
                        self._count(ours.recv(), result)
                process.join()
                if (code := process.exitcode) != 0:
                    hung = code in (-signal.SIGPROF, -signal.SIGALRM)
                    kind, detail = ("hang", f"longer than {HANG:g} s") if hung else ("crash", f"exit code {code}")
                    self._count(self._saved(Failure(kind, detail), result.inputs, folder), result)
        return result

    def _count(self, outcome: str | Failure, result: Result) -> None:
        result.inputs += 1
        if isinstance(outcome, Failure):
            result.failures.append(outcome)
        else:
            result.outcomes[outcome] += 1

    def _saved(self, failure: Failure, index: int, folder: Path) -> Failure:
        kept = self.failed / f"{self.target.name}-{index}-{failure.kind}"
        shutil.rmtree(kept, ignore_errors=True)
        if folder.is_dir():
            shutil.copytree(folder, kept, symlinks=True)
        kept.mkdir(parents=True, exist_ok=True)
        (kept / "failure.txt").write_text(failure.detail, encoding="utf-8", errors="backslashreplace")
        return replace(failure, folder=kept)

    def _work(self, valid: list[Files], folder: Path, report: Connection, indices: range, end: float) -> None:
        """Body of the forked process; its reports count only inputs that ended."""
        _confine()
        for index in indices:
            rng = random.Random(f"{self.seed}/{self.target.name}/{index}")
            write_input(folder, damage(rng, rng.choice(valid), self.target.fuzzed))
            # Unless the input ends in time, a signal ends the process.
            signal.setitimer(signal.ITIMER_PROF, HANG)
            signal.setitimer(signal.ITIMER_REAL, ASLEEP * HANG)
            outcome = judge(self.target.read, folder)
            report.send(self._saved(outcome, index, folder) if isinstance(outcome, Failure) else outcome)
            if time.monotonic() > end:
                break
        report.close()
        shutil.rmtree(folder.parent / "cache", ignore_errors=True)
        os._exit(0)


def _confine() -> None:
    """Print nothing, take little memory, and die of signals."""
    for number in (signal.SIGPROF, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)
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
        outcomes = ", ".join(f"{count:,} {kind}" for kind, count in result.outcomes.most_common())
        print(f"{name:18} {result.inputs:>9,} inputs {len(result.failures):>4} failures  ({outcomes})", flush=True)
        for failure in result.failures[:10]:
            print(f"    {failure.kind} at {failure.folder}: {failure.detail.strip().splitlines()[-1][:200]!a}")
    print(f"{total:,} inputs, {failures} failures, in {options.seconds:.0f} s")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
