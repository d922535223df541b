import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from nexwarp.cli import main as cli
from nexwarp.cli import session
from nexwarp.run.log import TrainingLog
from nexwarp.train.densify import DensityControl
from nexwarp.train.optimizer import FusedAdam
from nexwarp.train.trainer import Trainer
from tests.cli.support import FLAGS, RUN_FILES, SHORT, read, refused, snapshot


def interrupt_after(patch: pytest.MonkeyPatch, owner: type, method: str, calls: int, number: int) -> None:
    """Press Ctrl-C, or send another signal, once, in the given call of a method."""
    original: Callable[..., Any] = getattr(owner, method)
    count = iter(range(1, 1_000_000))

    def interrupted(*args: Any, **kwargs: Any) -> Any:
        if next(count) == calls:
            signal.raise_signal(number)
        return original(*args, **kwargs)

    patch.setattr(owner, method, interrupted)


@pytest.mark.parametrize(
    ("owner", "method", "calls", "name"),
    [
        (TrainingLog, "__call__", 7, "SIGINT"),  # between two steps
        (TrainingLog, "__call__", 1, "SIGINT"),  # before there is any checkpoint
        (DensityControl, "accumulate", 5, "SIGINT"),  # after a backward pass, before the optimizer steps
        (FusedAdam, "step", 8, "SIGINT"),
        (FusedAdam, "step", 7, "SIGTERM"),
        (FusedAdam, "step", 7, "SIGHUP"),
    ],
)
def test_an_interrupted_run_resumes_to_the_same_bits(trained, scene, tmp_path, capsys, owner, method, calls, name):
    """Ctrl-C anywhere in a step, then --resume: the same model, byte for byte, as of the run that was left alone."""
    run, number = tmp_path / "run", getattr(signal, name)
    before = signal.getsignal(number)
    with pytest.MonkeyPatch.context() as patch:
        interrupt_after(patch, owner, method, calls, number)
        assert cli.main(["train", str(scene), "--run", str(run), *FLAGS]) == 128 + number
    word = "interrupted" if name == "SIGINT" else "terminated"
    assert capsys.readouterr().err == f"nexwarp: {word}; continue with --resume\n"
    assert {f.name for f in run.iterdir()} - {"checkpoint.old"} == {"config.json", "metrics.jsonl", "checkpoint"}
    assert read(run / "checkpoint", "state.json")["iteration"] == calls and signal.getsignal(number) == before
    assert cli.main(["train", str(scene), "--run", str(run), "--device", "cpu", "--resume"]) == 0
    assert f"resumed at iteration {calls}" in capsys.readouterr().out
    assert (run / "model.safetensors").read_bytes() == (trained / "model.safetensors").read_bytes()
    expected, metrics = read(trained, "metrics.json"), read(run, "metrics.json")
    for key in ("psnr", "ssim", "views", "iterations", "surfels"):
        assert metrics[key] == expected[key], key


@pytest.fixture
def saved(monkeypatch):
    """Iterations of the checkpoints that are written."""
    seen, save = [], Trainer.save_checkpoint

    def note(self, run):
        seen.append(self.iteration)
        save(self, run)

    monkeypatch.setattr(Trainer, "save_checkpoint", note)
    return seen


def test_checkpoints_that_nobody_asked_for_are_apart(scene, tmp_path, monkeypatch, saved):
    """Tenths have 4 steps of 4 s: 30 s are between two, and after a start, but a stop and the end are always saved."""
    now, step = [0.0], Trainer.step

    def slow_step(self):
        now[0] += 4.0
        return step(self)

    monkeypatch.setattr(Trainer, "step", slow_step)
    monkeypatch.setattr(session, "monotonic", lambda: now[0])
    command = ["train", str(scene), "--run", str(tmp_path / "run"), *SHORT, "--iterations", "40"]
    with pytest.MonkeyPatch.context() as patch:
        interrupt_after(patch, TrainingLog, "__call__", 21, signal.SIGTERM)
        assert cli.main(command) == 128 + signal.SIGTERM
    assert saved == [8, 16, 21] and cli.main([*command, "--resume"]) == 0
    assert saved == [8, 16, 21, 32, 40]


def test_checkpoints_come_as_often_as_asked_and_two_are_kept(trained, scene, tmp_path, capsys, saved):
    run = tmp_path / "run"
    command = ["train", str(scene), "--run", str(run), *FLAGS]
    assert cli.main([*command, "--checkpoint-every", "7"]) == 0
    assert saved == [7, 14, 20]
    kept = [read(run / name, "state.json")["iteration"] for name in ("checkpoint", "checkpoint.old")]
    assert kept == [20, 14] and (run / "model.safetensors").read_bytes() == (trained / "model.safetensors").read_bytes()
    refused(capsys, [*command, "--overwrite", "--checkpoint-every", "0"], "--checkpoint-every", "at least 1", "got 0")


def test_a_damaged_checkpoint_gives_way_to_the_one_before(trained, scene, finished, capsys):
    tensors = finished / "checkpoint" / "tensors.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:-7])
    (finished / "model.safetensors").unlink()
    capsys.readouterr()
    assert cli.main(["train", str(scene), "--run", str(finished), "--device", "cpu", "--resume"]) == 0
    out = capsys.readouterr().out
    assert f"warning: {finished / 'checkpoint'}: expected a whole checkpoint" in out
    assert "resumed at iteration 18" in out
    assert (finished / "model.safetensors").read_bytes() == (trained / "model.safetensors").read_bytes()


def test_only_damaged_checkpoints_are_refused_and_left(finished, scene, capsys):
    for name in ("checkpoint", "checkpoint.old"):
        (finished / name / "state.json").write_text("{}")
    before = snapshot(finished)
    command = ["train", str(scene), "--run", str(finished), "--device", "cpu", "--resume"]
    refused(capsys, command, str(finished / "checkpoint"), "expected a whole checkpoint", "format version 1, got None")
    assert snapshot(finished) == before


@pytest.mark.parametrize("left", ["nothing", "half a config", "a lock", "the config", "half a checkpoint"])
def test_a_run_killed_before_its_first_checkpoint_starts_anew(trained, scene, tmp_path, capsys, left):
    run = tmp_path / "run"
    run.mkdir()
    if left == "half a config":
        (run / f".config.{2**22 + 1}-{0:016x}.tmp.json").write_text("{")
    elif left == "a lock":
        (run / "run.lock").write_text('{"process": 1, "host": "gone", "since": "then"}')
    elif left != "nothing":
        shutil.copy(trained / "config.json", run)
    if left == "half a checkpoint":
        aside = run / f".checkpoint.{os.getppid()}-{7:016x}.tmp"
        aside.mkdir()
        (aside / "tensors.safetensors").write_bytes(b"\x10")
    assert cli.main(["train", str(scene), "--run", str(run), *FLAGS, "--resume"]) == 0
    assert f"{run}: no checkpoint yet, training starts from the beginning" in capsys.readouterr().out
    assert {f.name for f in run.iterdir()} == RUN_FILES
    assert (run / "model.safetensors").read_bytes() == (trained / "model.safetensors").read_bytes()


def test_resuming_removes_what_killed_processes_left(finished, scene):
    """Of files that need the lock, all; of others, none: their processes may be at work."""
    alive, dead = (f"{process}-{0:016x}.tmp" for process in (os.getppid(), 2**22 + 1))
    stays = [f"renders/.a.{alive}.png", f"renders/test/.b.{dead}.png", ".notes.tmp", f"export/.c.{dead}.ply"]
    goes = [f".model.{alive}.safetensors", f"checkpoint/.state.{dead}.json"]
    for name in stays + goes:
        (finished / name).parent.mkdir(exist_ok=True)
        (finished / name).touch()
    before = snapshot(finished)
    assert cli.main(["train", str(scene), "--run", str(finished), "--device", "cpu", "--resume"]) == 0
    assert before.keys() - snapshot(finished).keys() == set(goes)


def test_a_resumed_run_knows_where_its_scene_lies_now(finished, scene, tmp_path):
    moved = Path(shutil.copytree(scene, tmp_path / "moved"))
    before = read(finished, "config.json")
    assert cli.main(["train", str(moved), "--run", str(finished), "--device", "cpu", "--resume"]) == 0
    assert read(finished, "config.json") == before | {"scene": before["scene"] | {"path": str(moved)}}


def test_a_second_interrupt_does_not_wait(scene, tmp_path):
    def insist(*_: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("not interrupted")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DensityControl, "accumulate", insist)
        assert cli.main(["train", str(scene), "--run", str(tmp_path / "run"), *FLAGS]) == 130
