"""Fuzzing of every reader with damaged files: `python -m tests.robustness.fuzz --seconds 60`.

An input is a small valid file with damage: bytes flipped, cut or spliced, numbers replaced by extreme ones, JSON with
values of other types, repeated keys, deep nesting. An input passes when its reader loads it or refuses it with a
documented exception of one line. It fails when the process dies, takes longer than 5 s, needs more than 1 GB of
additional memory, or raises another exception. Inputs run in forked processes, many per process; failing inputs are
saved. The same seed gives the same inputs.

`--driver hypothesis` draws JSON and numbers from Hypothesis' strategies. `--driver atheris` searches for new paths in
nexwarp's code (one target, in a process of its own; `pip install atheris`).
"""

import argparse
import ctypes
import inspect
import multiprocessing
import os
import random
import re
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import psutil
import warp as wp

from tests.robustness.fuzz_inputs import Files, damage, strategy
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
    """An input on which a reader failed: where it is saved, and how the reader failed."""

    target: str
    index: int
    kind: str
    detail: str
    folder: Path | None = None


@dataclass
class Result:
    """Outcomes of a target's inputs.

    Attributes:
        inputs: how many ran.
        loaded: how many of them loaded; the others were refused.
        seconds: for all inputs.
        refusals: count of each documented exception.
        failures: one for each input that failed.
    """

    inputs: int = 0
    loaded: int = 0
    seconds: float = 0.0
    refusals: Counter[str] = field(default_factory=Counter)
    failures: list[Failure] = field(default_factory=list)


def judge(read: Callable[[Path], object], folder: Path) -> str | Failure:
    """Read an input: "loaded", the name of a documented exception, or a failure without its target."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)
            read(folder)
    except Exception as error:
        chain: list[BaseException] = []
        link: BaseException | None = error
        while link is not None and link not in chain:
            chain.append(link)
            link = link.__cause__ or link.__context__
        text = "".join(traceback.format_exception(error))
        if any(isinstance(e, MemoryError) or any(word in str(e) for word in NO_MEMORY) for e in chain):
            return Failure("", 0, "memory", text)
        if not isinstance(error, DOCUMENTED) and not (isinstance(error, OSError) and str(folder) in str(error)):
            return Failure("", 0, type(error).__name__, text)
        message = str(error)
        if str(folder) not in message or "\n" in message or not message.isprintable() or len(message) > 2000:
            return Failure("", 0, "message", text)
        return type(error).__name__
    return "loaded"


def fuzz(target: FuzzTarget, *, seconds: float, inputs: int, seed: int, driver: str, failed: Path) -> Result:
    """Run a target until time or inputs are used up.

    Args:
        target: the reader and its valid inputs.
        seconds: at most this long.
        inputs: at most so many.
        seed: of the inputs.
        driver: "mutate" or "hypothesis".
        failed: folder for inputs that failed.
    """
    result = Result()
    start = time.perf_counter()
    index = 0
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as scratch:
        valid = target.make(Path(scratch) / "valid")
        folder = Path(scratch) / "input"
        while index < inputs and time.perf_counter() - start < seconds:
            left = seconds - (time.perf_counter() - start)
            index = _batch(target, valid, folder, result, index, min(index + BATCH, inputs), left, seed, driver, failed)
    result.seconds = time.perf_counter() - start
    return result


def _batch(
    target: FuzzTarget,
    valid: list[Files],
    folder: Path,
    result: Result,
    first: int,
    last: int,
    left: float,
    seed: int,
    driver: str,
    failed: Path,
) -> int:
    """Run inputs in one forked process, and return the index to continue with."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    now = context.RawArray("d", [float(first), time.monotonic(), 0.0])
    arguments = (target, valid, folder, theirs, now, first, last, left, seed, driver)
    process = context.Process(target=_work, args=arguments, daemon=True)
    process.start()
    theirs.close()
    hung = False
    while True:
        try:
            if ours.poll(0.1):
                _collect(ours.recv(), target, result, folder, failed)
        except EOFError:
            break
        if _hangs(process.pid, now):
            hung = True
            process.kill()
            while True:
                try:
                    _collect(ours.recv(), target, result, folder, failed)
                except EOFError:
                    break
            break
    process.join()
    index = int(now[0])
    if process.exitcode == 0:
        return index
    what = f"longer than {HANG:g} s" if hung else f"exit code {process.exitcode}"
    failure = Failure(target.name, index, "hang" if hung else "crash", what)
    result.inputs += 1
    result.failures.append(_saved(failure, folder, failed))
    return index + 1


def _hangs(process: int | None, now: Sequence[float]) -> bool:
    """Whether a process works on an input for too long.

    Args:
        process: its id.
        now: index of the input, and the times at which the process began it: `time.monotonic`, `time.process_time`.
    """
    seconds = time.monotonic() - now[1]
    if seconds <= HANG or process is None:
        return False
    try:
        used = sum(psutil.Process(process).cpu_times()[:2])
    except psutil.Error:  # it has ended
        return False
    return used - now[2] > HANG or seconds > ASLEEP * HANG


def _collect(message: tuple[Any, ...], target: FuzzTarget, result: Result, folder: Path, failed: Path) -> None:
    if message[0] == "failure":
        _, kind, index, detail, kept = message
        result.failures.append(_saved(Failure(target.name, index, kind, detail), Path(kept), failed))
        shutil.rmtree(kept, ignore_errors=True)
        return
    _, inputs, loaded, refusals = message
    result.inputs += inputs
    result.loaded += loaded
    result.refusals += refusals


def _saved(failure: Failure, folder: Path, failed: Path) -> Failure:
    kept = failed / f"{failure.target}-{failure.index}-{failure.kind}"
    kept.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(kept, ignore_errors=True)
    if folder.is_dir():
        shutil.copytree(folder, kept, symlinks=True)
    else:
        kept.mkdir()
    (kept / "failure.txt").write_text(failure.detail, encoding="utf-8", errors="backslashreplace")
    return Failure(failure.target, failure.index, failure.kind, failure.detail, kept)


def _work(
    target: FuzzTarget,
    valid: list[Files],
    folder: Path,
    report: Connection,
    now: Any,
    first: int,
    last: int,
    left: float,
    seed: int,
    driver: str,
) -> None:
    """Body of the forked process; its reports count only inputs that ended."""
    os.environ["NEXWARP_CACHE"] = str(folder.parent / "cache")
    sys.stdout = sys.stderr = open(os.devnull, "w")
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    _limit_memory()
    end = time.monotonic() + left
    counts = Result()

    def finish() -> None:
        _report(report, counts)
        report.close()
        shutil.rmtree(folder.parent / "cache", ignore_errors=True)
        os._exit(0)

    def run(index: int, files: Files) -> None:
        """Run an input; end the process when time is up."""
        target.write(folder, files)
        now[:] = [float(index), time.monotonic(), time.process_time()]
        outcome = judge(target.read, folder)
        counts.inputs += 1
        if isinstance(outcome, Failure):
            kept = folder.with_name(f"failed-{index}")
            shutil.copytree(folder, kept, symlinks=True)
            report.send(("failure", outcome.kind, index, outcome.detail, str(kept)))
        elif outcome == "loaded":
            counts.loaded += 1
        else:
            counts.refusals[outcome] += 1
        now[:] = [float(index + 1), time.monotonic(), time.process_time()]
        if counts.inputs % 50 == 0:
            _report(report, counts)
        if time.monotonic() > end:
            finish()

    if driver == "hypothesis":
        _draw(target, valid, first, last, seed, run)
    else:
        for index in range(first, last):
            rng = random.Random(f"{seed}/{target.name}/{index}")
            run(index, damage(rng, rng.choice(valid), target.fuzzed))
    finish()


def _report(report: Connection, counts: Result) -> None:
    report.send(("counts", counts.inputs, counts.loaded, Counter(counts.refusals)))
    counts.inputs = counts.loaded = 0
    counts.refusals.clear()


def _limit_memory() -> None:
    from nexwarp.kernels import launch

    launch.set_num_threads(1)  # each thread would take memory of its own
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL("libc.so.6").mallopt(M_ARENA_MAX, 1)
    base = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (base + MEMORY, base + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _draw(
    target: FuzzTarget, valid: list[Files], first: int, last: int, seed: int, run: Callable[[int, Files], None]
) -> None:
    """Run inputs that Hypothesis draws."""
    import hypothesis

    index = first

    @hypothesis.seed(f"{seed}/{target.name}/{first}")
    @hypothesis.settings(
        max_examples=last - first,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(strategy(valid, target.fuzzed))
    def one(files: Files) -> None:
        nonlocal index
        if index < last:
            run(index, files)
            index += 1

    one()


def drive_atheris(target: FuzzTarget, seconds: float, failed: Path) -> None:
    """Let atheris choose the bytes of a target's first file, guided by nexwarp's code; ends the process."""
    try:
        import atheris
    except ImportError:
        raise SystemExit("--driver atheris: expected the package atheris (pip install atheris)") from None
    scratch = Path(tempfile.mkdtemp())
    valid = target.make(scratch / "valid")
    folder = scratch / "input"
    failed.mkdir(parents=True, exist_ok=True)
    corpus = scratch / "corpus"
    corpus.mkdir()
    names = [name for name in valid[0] if name.endswith(target.fuzzed)]
    for index, files in enumerate(valid):
        for place, name in enumerate(n for n in names if n in files):
            (corpus / f"{index}-{place}").write_bytes(bytes([place]) + files[name])

    def one(data: bytes) -> None:
        name = names[data[0] % len(names)] if data else names[0]
        target.write(folder, {**valid[0], name: data[1:]})
        outcome = judge(target.read, folder)
        if isinstance(outcome, Failure):
            raise RuntimeError(f"{outcome.kind}: {outcome.detail}")

    for name, module in list(sys.modules.items()):
        if name.startswith("nexwarp.") and not name.startswith("nexwarp.kernels"):
            for function in vars(module).values():
                if inspect.isfunction(function) and function.__module__ == name:
                    atheris.instrument_func(function)
    options = [f"-max_total_time={int(seconds)}", f"-timeout={HANG:g}", "-rss_limit_mb=4096"]
    atheris.Setup([sys.argv[0], *options, f"-artifact_prefix={failed}/{target.name}-", str(corpus)], one)
    atheris.Fuzz()


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.robustness.fuzz", description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of the whole run")
    parser.add_argument("--inputs", type=int, default=10**9, help="at most so many a target")
    parser.add_argument("--targets", nargs="+", default=list(TARGETS), choices=list(TARGETS), metavar="TARGET")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--driver", choices=("mutate", "hypothesis", "atheris"), default="mutate")
    parser.add_argument("--failed", type=Path, default=Path("fuzz_failures"), help="where inputs that fail are kept")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_ERROR
    if options.driver == "atheris":
        if len(options.targets) != 1:
            parser.error("--driver atheris: expected one of --targets")
        drive_atheris(TARGETS[options.targets[0]], options.seconds, options.failed)
    total, failures = 0, 0
    start = time.perf_counter()
    for place, name in enumerate(options.targets):
        left = options.seconds - (time.perf_counter() - start)
        result = fuzz(
            TARGETS[name],
            seconds=left / (len(options.targets) - place),
            inputs=options.inputs,
            seed=options.seed,
            driver=options.driver,
            failed=options.failed,
        )
        total, failures = total + result.inputs, failures + len(result.failures)
        rate = result.inputs / max(result.seconds, 1e-9)
        refused = ", ".join(f"{count:,} {kind}" for kind, count in result.refusals.most_common())
        print(
            f"{name:18} {result.inputs:>9,} inputs  {rate:>7,.0f}/s  {result.loaded:>9,} loaded  "
            f"{len(result.failures):>4} failures  ({refused})",
            flush=True,
        )
        kinds: dict[str, list[Failure]] = {}
        for failure in result.failures:
            last = ascii(failure.detail.strip().splitlines()[-1])[1:-1]
            kinds.setdefault(f"{failure.kind}: {re.sub('[0-9]+', '0', last)[:40]}", []).append(failure)
        for alike in kinds.values():
            text = ascii(alike[0].detail.strip().splitlines()[-1])[1:200]
            print(f"    {len(alike)} x {alike[0].kind}, first {alike[0].folder}: {text}", flush=True)
    print(f"{total:,} inputs, {failures} failures, {time.perf_counter() - start:.0f} s")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
