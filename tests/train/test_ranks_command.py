import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from nexwarp.model.model_file import MODEL_FILE
from nexwarp.train.checkpoint import has_checkpoint, load_checkpoint
from tests.subprocesses import ROOT, environment

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

SMALL = "texture.levels=4 texture.table_size=1024 texture.width=16 densify.every=300".split()
TRAIN = ["--device", "cpu", "--max-surfels", "200", *(x for s in SMALL for x in ("--set", s))]
TORCHRUN = ["-m", "torch.distributed.run", "--rdzv-backend=c10d", "--rdzv-endpoint=localhost:0"]

# torchrun would take --run for an abbreviation of an option of its own.
MODULE = ["-m", "--"]


def start(arguments: list[str], launcher: list[str] | None = None) -> subprocess.Popen[str]:
    command = [sys.executable, *(launcher or ["-m"]), "nexwarp", *arguments]
    variables, nowhere = environment(OMP_NUM_THREADS="1"), subprocess.DEVNULL
    return subprocess.Popen(command, env=variables, stdout=nowhere, stderr=subprocess.PIPE, text=True, cwd=ROOT)


def lines(process: subprocess.Popen[str], seconds: float = 600) -> list[str]:
    """What it printed on stderr until its end, without Warp's lines about a missing driver."""
    _, err = process.communicate(timeout=seconds)
    return [line for line in err.splitlines() if line and not line.startswith("Warp CUDA warning")]


def ranks_of(process: subprocess.Popen[str]) -> list[psutil.Process]:
    children = psutil.Process(process.pid).children()
    return sorted((c for c in children if "RANK" in c.environ()), key=lambda c: int(c.environ()["RANK"]))


def await_checkpoint(run: Path) -> None:
    until = time.monotonic() + 300
    while not has_checkpoint(run) and time.monotonic() < until:
        time.sleep(0.01)
    assert has_checkpoint(run)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_command_ends_with_one_line(tiny_folder: Path, tmp_path: Path, number: signal.Signals) -> None:
    """A rank is killed, or a signal comes to the command: all processes end within 10 s, and one line says why."""
    run = tmp_path / "run"
    options = ["--gpus", "3", "--iterations", "6000", "--checkpoint-every", "30"]
    process = start(["train", str(tiny_folder), "--run", str(run), *TRAIN, *options])
    await_checkpoint(run)
    ranks = ranks_of(process)
    assert len(ranks) == 3
    begun = time.monotonic()
    os.kill(ranks[1].pid if number == signal.SIGKILL else process.pid, number)
    told = lines(process, 60)
    assert time.monotonic() - begun < 10 and process.returncode == (3 if number == signal.SIGKILL else 128 + number)
    assert not any(rank.is_running() for rank in ranks)
    (line,) = told
    if number == signal.SIGKILL:
        expected = f"nexwarp: error: rank 1 (process {ranks[1].pid}) was ended by signal 9"
        assert line.startswith(expected) and "--resume" in line
    else:
        what = "terminated" if number == signal.SIGTERM else "interrupted"
        assert line == f"nexwarp: {what}; continue with --resume"
    _, state = load_checkpoint(run)
    assert state["iteration"] % 3 == 0


def test_torchrun_starts_a_training(tiny_folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    launcher = [*TORCHRUN, "--nproc-per-node=2", *MODULE]
    process = start(["train", str(tiny_folder), "--run", str(run), *TRAIN, "--iterations", "40"], launcher)
    assert not [line for line in lines(process) if line.startswith("nexwarp:")] and process.returncode == 0
    assert (run / MODEL_FILE).is_file()


def test_an_error_is_told_once(tiny_folder: Path, tmp_path: Path) -> None:
    """One that all ranks meet, and one that only rank 0 sees; the exit code is that of one process."""
    folder = shutil.copytree(tiny_folder, tmp_path / "scene")
    photo = sorted((folder / "images").iterdir())[1]
    photo.write_bytes(photo.read_bytes()[:200])
    run = tmp_path / "run"
    process = start(["train", str(folder), "--run", str(run), *TRAIN, "--gpus", "2"])
    (line,) = lines(process)
    assert line.startswith(f"nexwarp: error: {photo}: ") and process.returncode == 2 and not run.exists()
    run.mkdir()
    (run / "mine.txt").touch()
    process = start(["train", str(tiny_folder), "--run", str(run), *TRAIN, "--gpus", "2"])
    (line,) = lines(process)
    assert line.startswith(f"nexwarp: error: {run}: expected a new run folder") and process.returncode == 2


def test_ranks_train_teachers_first(tiny_folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = ["train", str(tiny_folder), "--run", str(run), *TRAIN, "--gpus", "2", "--iterations", "40"]
    command += ["--checkpoint-every", "4"]
    process = start([*command, "--set", "teachers=2"])
    assert lines(process) == [] and process.returncode == 0
    model, metrics = (run / MODEL_FILE).read_bytes(), json.loads((run / "metrics.json").read_text())
    assert (metrics["iterations"], metrics["teachers"]) == (40, 2)
    assert [(run / "teachers" / name / MODEL_FILE).is_file() for name in ("1", "2")] == [True, True]
    for name in ("checkpoint", "checkpoint.old", "teachers/2"):
        shutil.rmtree(run / name)
    (run / MODEL_FILE).unlink()
    process = start([*command, "--resume"])
    assert lines(process) == [] and process.returncode == 0 and (run / MODEL_FILE).read_bytes() == model
