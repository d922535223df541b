"""Kills trainings at random moments, resumes them, and compares the models with that of an undisturbed training.

    python -m tests.robustness.kills --count 20

trains a short demo on the CPU and lists each kill: its time, the checkpoints that it left, and whether the resumed run
ended with the same bytes. The exit code is 1 unless all did. A GPU repeats its results only with --deterministic:

    python -m tests.robustness.kills --device cuda --deterministic --count 5 --iterations 600 --checkpoint-every 20
"""

import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nexwarp.model.model_file import MODEL_FILE
from nexwarp.run.contents import CONFIG_FILE
from nexwarp.train.checkpoint import CHECKPOINTS

POLL_SECONDS = 0.002


@dataclass(frozen=True)
class Kill:
    """One kill of a run.

    Attributes:
        seconds: after the run folder got its config.
        left: iterations of the complete checkpoints that it left, the newest first.
        writing: whether it interrupted the writing of a checkpoint.
        same: whether the resumed run's model has the expected bytes.
    """

    seconds: float
    left: tuple[int, ...]
    writing: bool
    same: bool


def kill_and_resume(
    start: Callable[[Path], subprocess.Popen[bytes]],
    resume: Callable[[Path], int],
    run: Path,
    seconds: float,
    expected: bytes,
) -> Kill:
    """Start a training, kill it so many seconds after its folder got its config, resume it and compare.

    Args:
        start: starts a training into a folder, as a process of its own.
        resume: continues it to its end, and returns the exit code.
        run: the folder; must not be there.
        seconds: when to kill.
        expected: content of the model file of an undisturbed run.
    """
    process = start(run)
    while not (run / CONFIG_FILE).is_file():
        if process.poll() is not None:
            raise RuntimeError(f"the training ended by itself, with exit code {process.returncode}")
        time.sleep(POLL_SECONDS)
    begun = time.perf_counter()
    while process.poll() is None and time.perf_counter() - begun < seconds:
        time.sleep(POLL_SECONDS)
    process.kill()
    process.wait()
    left = []
    for name in CHECKPOINTS:
        try:
            left.append(json.loads((run / name / "state.json").read_bytes())["iteration"])
        except (OSError, ValueError):
            continue
    writing = any(run.glob(".checkpoint.*.tmp"))
    if resume(run) != 0:
        raise RuntimeError(f"{run}: the training did not resume after a kill at {seconds:.3f} s")
    same = (run / MODEL_FILE).read_bytes() == expected
    return Kill(seconds, tuple(left), writing, same)


def undisturbed(start: Callable[[Path], subprocess.Popen[bytes]], run: Path) -> tuple[bytes, float]:
    """Let a training run to its end.

    Returns:
        Content of the model file, and seconds that the training took after its folder got its config.
    """
    process = start(run)
    while not (run / CONFIG_FILE).is_file() and process.poll() is None:
        time.sleep(POLL_SECONDS)
    begun = time.perf_counter()
    if process.wait() != 0:
        raise RuntimeError(f"the undisturbed training failed, with exit code {process.returncode}")
    return (run / MODEL_FILE).read_bytes(), time.perf_counter() - begun


@dataclass
class Kills:
    """Kill trainings of the demo at random moments, resume them, and compare their models."""

    count: int = 20
    """Kills, each of a run of its own."""
    iterations: int = 60
    """Of the demo's training."""
    checkpoint_every: int = 2
    """Iterations between checkpoints: often, so that many a kill meets one half-written."""
    max_surfels: int = 3000
    """Budget of the runs."""
    seed: int = 0
    """Of the moments."""
    device: Annotated[str, tyro.conf.arg(metavar="{cuda,cpu}")] = "cpu"
    """Where to train."""
    deterministic: bool = False
    """Train with --deterministic, without which a GPU does not end with the same bytes even undisturbed."""

    def command(self) -> list[str]:
        """Return the training, but for its --run."""
        flags = [f"--iterations={self.iterations}", f"--checkpoint-every={self.checkpoint_every}"]
        flags += [f"--max-surfels={self.max_surfels}", f"--device={self.device}"]
        flags += ["--deterministic"] * self.deterministic
        return [sys.executable, "-m", "nexwarp", "train", "demo", *flags]

    def __call__(self) -> int:
        """Run, print, and return the exit code."""
        train = self.command()

        def start(run: Path) -> subprocess.Popen[bytes]:
            return subprocess.Popen([*train, "--run", str(run)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

        def resume(run: Path) -> int:
            return subprocess.run([*train, "--run", str(run), "--resume"], stdout=subprocess.DEVNULL).returncode

        with tempfile.TemporaryDirectory() as folder:
            # The first run may compile kernels; the second one is timed.
            first, _ = undisturbed(start, Path(folder) / "first")
            expected, length = undisturbed(start, Path(folder) / "whole")
            if first != expected:
                print("two undisturbed runs end with different models: there is nothing to compare with")
                return 1
            print(f"undisturbed: {length:.1f} s, {len(expected):,} bytes", flush=True)
            generator, kills = random.Random(self.seed), []
            for number in range(1, self.count + 1):
                run = Path(folder) / "killed"
                kill = kill_and_resume(start, resume, run, generator.uniform(0, length), expected)
                kills.append(kill)
                shutil.rmtree(run)
                left = ", ".join(map(str, kill.left)) or "none"
                print(
                    f"{number:3}: killed after {kill.seconds:6.2f} s, checkpoints left: {left}"
                    f"{', one half-written' if kill.writing else ''}; {'same' if kill.same else 'DIFFERENT'} model",
                    flush=True,
                )
        same = sum(kill.same for kill in kills)
        writing = sum(kill.writing for kill in kills)
        print(f"{same} of {len(kills)} models bit-identical; {writing} kills while a checkpoint was being written")
        return 0 if same == len(kills) else 1


if __name__ == "__main__":
    sys.exit(tyro.cli(Kills)())
