"""Kills a training at some moment, resumes it, and compares the model with that of an undisturbed training."""

import json
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

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
    return Kill(seconds, tuple(left), writing, (run / MODEL_FILE).read_bytes() == expected)
