"""The command line, driven in-process: what a run leaves behind, what continues it, and one line for bad input."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import nexwarp as nw
from benchmarks.inputs import write_blender, write_points
from nexwarp.cameras.cameras_file import load_cameras
from nexwarp.cli import main as cli
from nexwarp.cli.display import TrainingDisplay
from nexwarp.data import write_demo
from nexwarp.io.pictures import CAPTION_HEIGHT, to_uint8
from nexwarp.run.metrics import CONVENTION, psnr
from nexwarp.train.config import Config, TextureConfig
from nexwarp.train.densify import Densifier, DensifyConfig
from nexwarp.train.presets import config_from_dict
from nexwarp.train.trainer import Trainer
from tests.test_scene import make_scene

pytestmark = pytest.mark.usefixtures("small_preset")

SMALL = Config(
    texture=TextureConfig(levels=4, table_size=2**10, width=16),
    densify=DensifyConfig(every=3),  # so that 20 iterations have rounds
)
FLAGS = ["--iterations", "20", "--max-surfels", "100", "--device", "cpu"]
RUN_FILES = {
    "config.json",
    "model.safetensors",
    "cameras.json",
    "metrics.json",
    "metrics.jsonl",
    "renders",
    "checkpoint",
}
RUN_FILES |= {"checkpoint.old"}  # where there was more than one


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return write_demo(tmp_path_factory.mktemp("scenes") / "tiny", width=48, height=36, views=10, points=200)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory) -> Path:
    """A finished run."""
    run = tmp_path_factory.mktemp("runs") / "nested" / "tiny"
    assert cli.main(["train", str(scene), "--run", str(run), *FLAGS]) == 0
    return run


@pytest.fixture
def finished(trained, tmp_path) -> Path:
    """A copy of the finished run, to be worked on."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def read(run: Path, name: str) -> Any:
    return json.loads((run / name).read_text())


def picture(file: Path) -> torch.Tensor:
    with Image.open(file) as image:
        return torch.from_numpy(np.array(image))


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


# A run


def test_a_run_holds_what_it_should(trained, scene):
    assert {f.name for f in trained.iterdir()} == RUN_FILES
    assert {f.name for f in (trained / "checkpoint").iterdir()} == {"tensors.safetensors", "state.json"}
    config = read(trained, "config.json")
    given = {"path": str(scene.resolve()), "images": "images", "downscale": 1, "masks": "masks"}
    assert config["scene"] == given | dict.fromkeys(("background", "points", "format"))
    assert config["device"] == "cpu" and config["config"]["preset"] == "default"
    settings = config_from_dict(config["config"])
    assert (settings.iterations, settings.max_surfels, settings.texture) == (20, 100, SMALL.texture)
    metrics = read(trained, "metrics.json")
    assert list(metrics["views"]) == ["view_000.png", "view_008.png"] and metrics["convention"] == CONVENTION
    assert metrics["iterations"] == 20 and metrics["preset"] == "default" and metrics["device"] == "cpu"
    assert metrics["megabytes"] == (trained / "model.safetensors").stat().st_size / 1e6
    assert metrics["iterations_per_second"] == pytest.approx(20 / metrics["seconds"])
    for name, figures in metrics["views"].items():
        render = picture(trained / "renders" / "test" / name)
        assert render.shape == (36, 48, 3)
        assert figures["psnr"] == pytest.approx(psnr(render, picture(scene / "images" / name)))
        assert picture(trained / "renders" / "compare" / name).shape == (36 + CAPTION_HEIGHT, 3 * 48 + 8, 3)
    stray = [f.name for f in trained.rglob("*") if "tmp" in f.name or f.name.startswith(".")]
    assert not stray


def test_the_model_is_that_of_the_last_iteration(trained):
    model = nw.load(trained)
    metrics = read(trained, "metrics.json")
    assert len(model.surfels) == metrics["surfels"] <= 100
    assert model.meta["iteration"] == 20 and model.meta["preset"] == "default" and model.options.sh_degree == 3
    cameras = load_cameras(trained / "cameras.json")
    assert list(cameras["test"]) == ["view_000.png", "view_008.png"] and len(cameras["train"]) == 8
    with torch.no_grad():
        out = model.render(cameras["test"]["view_000.png"])
    assert torch.equal(to_uint8(out.image), picture(trained / "renders" / "test" / "view_000.png"))


def test_training_says_what_it_does(scene, tmp_path, capsys):
    run = tmp_path / "run"
    assert cli.main(["train", str(scene), "--run", str(run), *FLAGS, "--max-hits", "0", "--seed", "3"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "tiny on the CPU, preset default" in out
    assert "8 training and 2 test views of 48x36" in out
    for word in ("iteration 20/20", "it/s", "loss", "train", "dB", "surfels", "s left", "test PSNR", "test SSIM"):
        assert word in out, word
    settings = config_from_dict(read(run, "config.json")["config"])
    assert (settings.max_hits, settings.seed) == (0, 3)
    assert nw.load(run).options.max_hits == 0


def test_default_run_folder_is_named_after_the_scene(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["train", str(scene), *FLAGS, "--iterations", "1", "--downscale", "2"]) == 0
    assert {f.name for f in Path("runs", "tiny").iterdir()} == RUN_FILES - {"checkpoint.old"}
    assert picture(Path("runs/tiny/renders/test/view_000.png")).shape == (18, 24, 3)


# eval, render, info


def test_memory_that_ends_while_finishing_costs_no_training(scene, tmp_path, monkeypatch, capsys):
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. And more")

    command = ["train", str(scene), "--run", str(tmp_path / "run"), *FLAGS]
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "finish", full)
        assert cli.main(command) == 2
    told = "out of memory: needed 2.00 GiB; training is complete and saved: --resume finishes the run"
    assert capsys.readouterr().err == f"nexwarp: error: {told}\n"
    assert cli.main([*command, "--resume"]) == 0
    assert "resumed at iteration 20" in capsys.readouterr().out
    assert (tmp_path / "run" / "metrics.json").is_file()


def test_eval_reproduces_the_metrics(finished, capsys):
    before = read(finished, "metrics.json")
    renders = snapshot(finished / "renders")
    (finished / "metrics.json").unlink()
    shutil.rmtree(finished / "renders")
    assert cli.main(["eval", str(finished), "--device", "cpu"]) == 0
    now = read(finished, "metrics.json")
    assert now == {key: before[key] for key in ("psnr", "ssim", "views", "convention")}
    assert snapshot(finished / "renders") == renders
    assert f"{before['psnr']:.2f} dB" in capsys.readouterr().out


def test_eval_keeps_the_facts_of_the_training(finished):
    before = read(finished, "metrics.json")
    assert cli.main(["eval", str(finished), "--device", "cpu"]) == 0
    assert read(finished, "metrics.json") == before


def test_eval_finds_a_scene_that_moved(finished, scene, tmp_path, capsys):
    before = read(finished, "metrics.json")
    config = read(finished, "config.json")
    config["scene"]["path"] = str(tmp_path / "gone")
    (finished / "config.json").write_text(json.dumps(config))
    assert cli.main(["eval", str(finished), "--device", "cpu"]) == 2
    assert str(tmp_path / "gone") in capsys.readouterr().err
    assert read(finished, "metrics.json") == before
    assert cli.main(["eval", str(finished), "--scene", str(scene), "--device", "cpu"]) == 0
    assert read(finished, "metrics.json") == before


def test_render_needs_no_photos(scene, tmp_path, capsys):
    moved = Path(shutil.copytree(scene, tmp_path / "scene"))
    run = tmp_path / "run"
    assert cli.main(["train", str(moved), "--run", str(run), *FLAGS, "--iterations", "2"]) == 0
    tests = snapshot(run / "renders" / "test")
    shutil.rmtree(run / "renders")
    moved.rename(tmp_path / "elsewhere")
    capsys.readouterr()
    assert cli.main(["render", str(run), "--frames", "3", "--device", "cpu"]) == 0
    assert "5 pictures" in capsys.readouterr().out
    assert snapshot(run / "renders" / "test") == tests
    frames = sorted((run / "renders" / "ellipse").iterdir())
    assert [f.name for f in frames] == ["0000.png", "0001.png", "0002.png"]
    pictures = [picture(f) for f in frames]
    assert all(p.shape == (36, 48, 3) for p in pictures) and not torch.equal(pictures[0], pictures[1])


def test_render_without_an_ellipse(finished):
    assert cli.main(["render", str(finished), "--frames", "0", "--device", "cpu"]) == 0
    assert {f.name for f in (finished / "renders").iterdir()} == {"test", "compare"}


def test_info_tells_what_a_run_holds(trained, scene, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert cli.main(["info", str(trained)]) == 0
    out = capsys.readouterr().out
    metrics = read(trained, "metrics.json")
    size = (trained / "model.safetensors").stat().st_size / 1e6
    for text in (str(scene), f"{metrics['surfels']} (budget 100)", "4 levels of 1,024", f"{size:.1f} MB"):
        assert text in out, text
    assert f"{metrics['psnr']:.2f} dB" in out and f"{metrics['ssim']:.4f}" in out


def test_info_of_an_unfinished_run(finished, capsys):
    for name in ("model.safetensors", "metrics.json"):
        (finished / name).unlink()
    assert cli.main(["info", str(finished)]) == 0
    assert "none yet" in capsys.readouterr().out


# Interruptions


def interrupt_after(
    patch: pytest.MonkeyPatch, owner: type, method: str, calls: int, number: int = signal.SIGINT
) -> None:
    """Press Ctrl-C (or send another signal), once, in the given call of a method."""
    original: Callable[..., Any] = getattr(owner, method)
    count = iter(range(1, 1_000_000))

    def interrupted(*args: Any, **kwargs: Any) -> Any:
        if next(count) == calls:
            signal.raise_signal(number)
        return original(*args, **kwargs)

    patch.setattr(owner, method, interrupted)


@pytest.mark.parametrize(
    ("owner", "method", "calls"),
    [
        (TrainingDisplay, "__call__", 7),  # between two steps
        (TrainingDisplay, "__call__", 1),  # before there is any checkpoint
        (Densifier, "accumulate", 5),  # after a backward pass, before the optimizer steps
        (torch.optim.Adam, "step", 8),
    ],
)
def test_an_interrupted_run_resumes_to_the_same_bits(trained, scene, tmp_path, capsys, owner, method, calls):
    """Ctrl-C anywhere in a step, then --resume: the same model, byte for byte, as of the run that was left alone."""
    run = tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        interrupt_after(patch, owner, method, calls)
        assert cli.main(["train", str(scene), "--run", str(run), *FLAGS]) == 130
    assert capsys.readouterr().err == "nexwarp: interrupted; continue with --resume\n"
    assert {f.name for f in run.iterdir()} - {"checkpoint.old"} == {"config.json", "metrics.jsonl", "checkpoint"}
    assert read(run / "checkpoint", "state.json")["iteration"] == calls
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert cli.main(["train", str(scene), "--run", str(run), "--device", "cpu", "--resume"]) == 0
    assert f"resumed at iteration {calls}" in capsys.readouterr().out
    assert (run / "model.safetensors").read_bytes() == (trained / "model.safetensors").read_bytes()
    expected, metrics = read(trained, "metrics.json"), read(run, "metrics.json")
    for key in ("psnr", "ssim", "views", "iterations", "surfels"):
        assert metrics[key] == expected[key], key


def test_a_killed_run_resumes_to_the_same_bits(trained, scene, tmp_path):
    """Without a chance to save anything, the last regular checkpoint serves."""

    class Killed(BaseException):
        pass

    def kill(_: Any, step: Any) -> None:
        if step.iteration == 7:
            raise Killed

    run = tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrainingDisplay, "__call__", kill)
        with pytest.raises(Killed):
            cli.main(["train", str(scene), "--run", str(run), *FLAGS])
    assert read(run / "checkpoint", "state.json")["iteration"] == 6
    assert cli.main(["train", str(scene), "--run", str(run), "--device", "cpu", "--resume"]) == 0
    assert (run / "model.safetensors").read_bytes() == (trained / "model.safetensors").read_bytes()


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGHUP", 129)])
def test_other_signals_stop_in_order_too(trained, scene, tmp_path, capsys, name, code):
    number = getattr(signal, name)
    before, run = signal.getsignal(number), tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        interrupt_after(patch, torch.optim.Adam, "step", 7, number)
        assert cli.main(["train", str(scene), "--run", str(run), *FLAGS]) == code
    assert capsys.readouterr().err == "nexwarp: terminated; continue with --resume\n"
    assert read(run / "checkpoint", "state.json")["iteration"] == 7
    assert signal.getsignal(number) == before
    assert cli.main(["train", str(scene), "--run", str(run), "--device", "cpu", "--resume"]) == 0
    assert (run / "model.safetensors").read_bytes() == (trained / "model.safetensors").read_bytes()


def test_a_closed_terminal_does_not_stop_what_nohup_started(scene, tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with pytest.MonkeyPatch.context() as patch:
            interrupt_after(patch, torch.optim.Adam, "step", 2, signal.SIGHUP)
            command = ["train", str(scene), "--run", str(tmp_path / "run"), *FLAGS, "--iterations", "3"]
            assert cli.main(command) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_checkpoints_come_as_often_as_asked_and_two_are_kept(trained, scene, tmp_path, monkeypatch, capsys):
    seen, save = [], Trainer.save
    monkeypatch.setattr(Trainer, "save", lambda self, run: (seen.append(self.iteration), save(self, run)))
    run = tmp_path / "run"
    command = ["train", str(scene), "--run", str(run), *FLAGS]
    assert cli.main([*command, "--checkpoint-every", "7"]) == 0
    assert seen == [7, 14, 20]
    kept = [read(run / name, "state.json")["iteration"] for name in ("checkpoint", "checkpoint.old")]
    assert kept == [20, 14]
    assert (run / "model.safetensors").read_bytes() == (trained / "model.safetensors").read_bytes()
    refused(capsys, [*command, "--overwrite", "--checkpoint-every", "0"], "--checkpoint-every", "at least 1", "got 0")


@pytest.mark.parametrize("damage", ["cut", "flip", "state", "missing"])
def test_a_damaged_checkpoint_gives_way_to_the_one_before(trained, scene, finished, capsys, damage):
    tensors, state = (finished / "checkpoint" / name for name in ("tensors.safetensors", "state.json"))
    content = tensors.read_bytes()
    if damage == "cut":
        tensors.write_bytes(content[: len(content) // 2])
    elif damage == "flip":
        tensors.write_bytes(content[:-7] + bytes([content[-7] ^ 1]) + content[-6:])
    elif damage == "state":
        state.write_text(state.read_text().replace('"iteration": 20', '"iteration": 21'))
    else:
        state.unlink()
    (finished / "model.safetensors").unlink()
    capsys.readouterr()
    assert cli.main(["train", str(scene), "--run", str(finished), "--device", "cpu", "--resume"]) == 0
    out = capsys.readouterr().out
    assert (
        f"warning: {finished / 'checkpoint'}: expected a whole checkpoint" in out and "resumed at iteration 18" in out
    )
    assert (finished / "model.safetensors").read_bytes() == (trained / "model.safetensors").read_bytes()


def test_only_damaged_checkpoints_are_refused_and_left(finished, scene, capsys):
    for name in ("checkpoint", "checkpoint.old"):
        (finished / name / "state.json").write_text("{}")
    before = snapshot(finished)
    command = ["train", str(scene), "--run", str(finished), "--device", "cpu", "--resume"]
    refused(capsys, command, str(finished / "checkpoint"), "expected a whole checkpoint", "format version 1, got None")
    assert snapshot(finished) == before


@pytest.mark.parametrize("left", ["nothing", "half a config", "the config", "half a checkpoint"])
def test_a_run_killed_before_its_first_checkpoint_starts_anew(trained, scene, tmp_path, capsys, left):
    run = tmp_path / "run"
    run.mkdir()
    if left == "half a config":
        (run / f".config.{2**22 + 1}.tmp.json").write_text("{")
    elif left != "nothing":
        shutil.copy(trained / "config.json", run)
    if left == "half a checkpoint":
        (run / "checkpoint.tmp").mkdir()
        (run / "checkpoint.tmp" / "tensors.safetensors").write_bytes(b"\x10")
    command = ["train", str(scene), "--run", str(run), *FLAGS, "--resume"]
    assert cli.main(command) == 0
    assert f"{run}: no checkpoint yet, training starts from the beginning" in capsys.readouterr().out
    assert {f.name for f in run.iterdir()} == RUN_FILES
    assert (run / "model.safetensors").read_bytes() == (trained / "model.safetensors").read_bytes()


def test_resuming_removes_what_killed_processes_left(finished, scene):
    mine = finished / "renders" / f".a.{os.getppid()}.tmp.png"  # of a process that lives
    for file in (mine, finished / f".model.{2**22 + 1}.tmp.safetensors", finished / ".notes.tmp"):
        file.touch()
    assert cli.main(["train", str(scene), "--run", str(finished), "--device", "cpu", "--resume"]) == 0
    assert {f.name for f in finished.iterdir()} == RUN_FILES | {".notes.tmp"} and mine.exists()


def test_a_run_whose_overwriting_was_killed_is_a_run_still(finished, scene, monkeypatch):
    """The old config goes last."""

    class Killed(BaseException):
        pass

    def kill(*_: Any) -> None:
        raise Killed

    command = ["train", str(scene), "--run", str(finished), *FLAGS]
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", kill)
        with pytest.raises(Killed):
            cli.main([*command, "--overwrite"])
    assert {f.name for f in finished.iterdir()} == {"config.json"}
    assert cli.main([*command, "--resume"]) == 0


@pytest.mark.parametrize("change", ["photo", "points"])
def test_a_scene_that_changed_is_not_resumed(finished, scene, tmp_path, capsys, change):
    moved = Path(shutil.copytree(scene, tmp_path / "scene"))
    if change == "photo":
        with Image.open(moved / "images" / "view_003.png") as image:
            pixels = np.array(image)
        pixels[3, 4, 1] ^= 1
        Image.fromarray(pixels).save(moved / "images" / "view_003.png")
    else:
        file = moved / "sparse" / "0" / "points3D.bin"
        content = bytearray(file.read_bytes())
        content[8 + 8 + 5] ^= 1  # of the first point's x
        file.write_bytes(content)
    command = ["train", str(moved), "--run", str(finished), "--device", "cpu", "--resume"]
    refused(capsys, command, str(finished), "expected a checkpoint of this run", "photos, masks or points have changed")


def test_a_second_interrupt_does_not_wait(scene, tmp_path):
    def insist(*_: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("not interrupted")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Densifier, "accumulate", insist)
        assert cli.main(["train", str(scene), "--run", str(tmp_path / "run"), *FLAGS]) == 130


def test_resume_takes_its_settings_from_the_run(scene, tmp_path):
    """Also those that a scene is loaded with: a resumed run does not change its photos' size."""
    run = tmp_path / "run"
    assert cli.main(["train", str(scene), "--run", str(run), *FLAGS, "--iterations", "2", "--downscale", "2"]) == 0
    before = read(run, "metrics.json")
    assert cli.main(["train", str(scene), "--run", str(run), "--resume", "--device", "cpu"]) == 0
    assert picture(run / "renders" / "test" / "view_000.png").shape == (18, 24, 3)
    assert read(run, "metrics.json")["views"] == before["views"]


# Bad input


def refused(capsys: pytest.CaptureFixture, arguments: list[str], *words: str) -> None:
    """Fail unless the command exits with 2 and one line on stderr that holds all of `words`."""
    capsys.readouterr()
    assert cli.main(arguments) == 2
    err = capsys.readouterr().err
    assert err.startswith("nexwarp: error: ") and err.count("\n") == 1 and err.endswith("\n"), err
    missing = [word for word in words if word not in err]
    assert not missing, f"{missing} not in {err!r}"


@pytest.fixture
def refuses(tmp_path, capsys) -> Callable[..., None]:
    """Train, expecting a refusal that leaves no run folder, not even its parent."""

    def check(path: Path | str, flags: list[str], *words: str) -> None:
        run = tmp_path / "runs" / "new"
        refused(capsys, ["train", str(path), "--run", str(run), "--device", "cpu", *flags], *words)
        assert not run.parent.exists()

    return check


def test_missing_folder(tmp_path, refuses):
    refuses(tmp_path / "nowhere", [], f"{tmp_path / 'nowhere'}", "no such folder", "expected a scene")


def test_folder_without_a_model(tmp_path, refuses):
    (tmp_path / "empty").mkdir()
    refuses(
        tmp_path / "empty", [], f"{tmp_path / 'empty'}", "no scene found", "expected a COLMAP model", "transforms.json"
    )


def test_no_images_folder(tmp_path, refuses):
    folder = make_scene(tmp_path / "scene")
    shutil.rmtree(folder / "images")
    refuses(folder, [], "images", str(folder))
    refuses(folder, ["--images", "images_4"], "images_4", str(folder))


def test_no_registered_images(tmp_path, refuses):
    folder = make_scene(tmp_path / "scene", names=[])
    refuses(folder, [], str(folder), "no registered images")


def test_absent_photo(tmp_path, refuses):
    folder = make_scene(tmp_path / "scene")
    (folder / "images" / "03.png").unlink()
    refuses(folder, [], str(folder / "images" / "03.png"), "not found", "the COLMAP model names it")


def test_truncated_photo(tmp_path, refuses):
    folder = make_scene(tmp_path / "scene")
    photo = folder / "images" / "03.png"
    photo.write_bytes(photo.read_bytes()[:2000])
    refuses(folder, [], f"{photo}: expected a complete image file")
    photo.write_text("no image")
    refuses(folder, [], f"{photo}: expected a complete image file, could not decode it: no format is known\n")
    refuses(photo, [], f"{photo}: expected the folder of a scene, got a file; give {photo.parent}")


def test_lens_that_is_no_number(tmp_path, refuses):
    params = (40.0, 40.0, 24.0, 18.0, float("nan"), 0.0, 0.0, 0.0)
    folder = make_scene(tmp_path / "scene", model="OPENCV", params=params)
    refuses(folder, [], "00.png", "OPENCV", "expected finite parameters")


def test_zero_points(tmp_path, refuses):
    folder = make_scene(tmp_path / "scene", points=np.zeros((0, 3)))
    refuses(folder, [], str(folder), "no 3D points", "expected at least one")


@pytest.mark.parametrize("budget", ["15", "0", "-3"])
def test_budget_below_the_minimum(scene, refuses, budget):
    refuses(scene, ["--max-surfels", budget], "max_surfels", "expected at least 16", f"got {budget}")


def test_unknown_preset(scene, refuses):
    refuses(scene, ["--preset", "papr"], "preset", "expected one of default, paper", "'papr'")


@pytest.mark.parametrize("hits", ["9", "-1"])
def test_too_many_hits(scene, refuses, hits):
    refuses(scene, ["--max-hits", hits], "max-hits", "expected 0 to 8", f"got {hits}")


@pytest.mark.parametrize(("factor", "expected"), [("0", "at least 1"), ("-2", "at least 1"), ("37", "at most")])
def test_impossible_downscale(scene, refuses, factor, expected):
    refuses(scene, ["--downscale", factor], "downscale", f"expected {expected}", f"got {factor}")


def test_no_iterations(scene, refuses):
    refuses(scene, ["--iterations", "0"], "iterations", "expected at least 1", "got 0")


def test_unknown_device(scene, refuses):
    refuses(scene, ["--device", "gpu"], "--device", "expected cuda or cpu", "'gpu'")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_no_cuda_when_asked_for(scene, finished, refuses, capsys):
    refuses(scene, ["--device", "cuda"], "--device", "cuda", "no CUDA device", "--device cpu")
    for command in ("eval", "render"):
        refused(capsys, [command, str(finished), "--device", "cuda"], "--device", "no CUDA device")


def test_nothing_to_resume(scene, refuses, tmp_path):
    refuses(scene, ["--resume"], str(tmp_path / "runs" / "new"), "expected a run to resume")


# Run folders


def test_existing_run_is_refused_and_untouched(finished, scene, capsys):
    before = snapshot(finished)
    command = ["train", str(scene), "--run", str(finished), *FLAGS]
    refused(capsys, command, str(finished), "exists", "--resume or --overwrite")
    refused(capsys, [*command, "--resume", "--overwrite"], "--resume, --overwrite", "at most one")
    for flag, value in (
        ("--iterations", "40"),
        ("--max-surfels", "99"),
        ("--max-hits", "1"),
        ("--seed", "5"),
        ("--downscale", "2"),
        ("--images", "images_2"),
        ("--preset", "paper"),
    ):
        refused(capsys, [*command, "--resume", flag, value], flag, "as in the run to resume", f"got {value}")
    assert snapshot(finished) == before


def test_bad_input_does_not_overwrite(finished, tmp_path, capsys):
    before = snapshot(finished)
    refused(capsys, ["train", str(tmp_path / "no"), "--run", str(finished), *FLAGS, "--overwrite"], "no such folder")
    assert snapshot(finished) == before


def test_overwrite_replaces_a_run(finished, scene):
    (finished / "renders" / "old.png").touch()
    command = ["train", str(scene), "--run", str(finished), *FLAGS, "--iterations", "1", "--overwrite"]
    assert cli.main(command) == 0
    assert {f.name for f in finished.iterdir()} == RUN_FILES - {"checkpoint.old"} and not (
        finished / "renders" / "old.png"
    ).exists()
    assert read(finished, "metrics.json")["iterations"] == 1


def test_overwrite_refuses_what_is_no_run(scene, tmp_path, capsys):
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.tex").write_text("years of work")
    file = tmp_path / "file"
    file.write_text("a file")
    for place in (precious, file):
        command = ["train", str(scene), "--run", str(place), *FLAGS, "--overwrite"]
        refused(capsys, command, str(place), "expected a run folder to overwrite", "config.json")
    assert snapshot(precious) == {"thesis.tex": b"years of work"} and file.read_text() == "a file"


def test_an_empty_folder_may_become_a_run(scene, tmp_path):
    (tmp_path / "run").mkdir()
    assert cli.main(["train", str(scene), "--run", str(tmp_path / "run"), *FLAGS, "--iterations", "1"]) == 0


@pytest.mark.parametrize("command", ["eval", "render", "info"])
def test_no_run_there(command, tmp_path, capsys):
    refused(capsys, [command, str(tmp_path / "no")], str(tmp_path / "no"), "expected a run folder")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("content", ["", "[]", '{"scene": {}}', '{"scene": {"path": "x"}, "config": {"a": 1}}', "\x00"])
@pytest.mark.parametrize("command", ["eval", "info"])
def test_damaged_config(command, content, finished, capsys):
    (finished / "config.json").write_text(content)
    refused(capsys, [command, str(finished)], str(finished / "config.json"), "expected the settings of a nexwarp run")


def test_damaged_files_of_a_run(finished, capsys):
    (finished / "metrics.json").write_text("{")
    refused(capsys, ["info", str(finished)], str(finished / "metrics.json"))
    (finished / "cameras.json").write_text("{}")
    refused(capsys, ["render", str(finished), "--device", "cpu"], "cameras", "expected at least one")
    (finished / "cameras.json").unlink()
    refused(capsys, ["render", str(finished), "--device", "cpu"], "cameras.json", "expected the run's cameras")
    (finished / "model.safetensors").write_bytes(b"nonsense")
    for command in ("render", "info"):
        refused(capsys, [command, str(finished)], "model.safetensors", "expected a safetensors file")


def test_negative_frames(finished, capsys):
    refused(capsys, ["render", str(finished), "--frames", "-1"], "--frames", "expected at least 0", "got -1")


@pytest.mark.parametrize("columns", [40, 80, 200])
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["expected one of {train, eval", "see nexwarp --help"]),
        (["fly"], ["unrecognized options: fly", "see nexwarp --help"]),
        (["train"], ["missing from nexwarp train: scene folder of a colmap", "see nexwarp train --help"]),
        (["train", "x", "--iterations", "many"], ["--iterations: expected an integer, got 'many'; see nexwarp train"]),
        (["train", "x", "--port", "8o80"], ["--port: expected an integer, got '8o80'; see nexwarp train --help"]),
        (["render", "x", "--scale", "big"], ["--scale: expected a number, got 'big'; see nexwarp render --help"]),
        (["render", "x", "--fps", "3O"], ["--fps: expected a number, got '3o'; see nexwarp render --help"]),
        (["train", "x", "--colour", "red"], ["unrecognized options: --colour, red"]),
        (["train", "x", "--itertions", "3"], ["options: --itertions, 3; perhaps you meant --iterations n; see"]),
        (["train", "x", "--run"], ["missing value for argument '--run'. expected 1 values; see nexwarp train"]),
        (["sfm", "x", "y", "--matching", "no"], ["invalid choice 'no' for argument '--matching'. expected one of"]),
    ],
)
def test_wrong_arguments(arguments, words, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit) as exited:
        cli.main(arguments)
    out, err = capsys.readouterr()
    assert exited.value.code == 2 and out == ""
    assert err.startswith("nexwarp: error: ") and err.count("\n") == 1 and not set(err) & set("│─╭╰")
    assert all(word in err.lower() for word in words), err


@pytest.mark.parametrize("arguments", [["--help"], ["train", "--help"], ["render", "--help"]])
def test_help(arguments, capsys):
    with pytest.raises(SystemExit) as exited:
        cli.main(arguments)
    out, err = capsys.readouterr()
    assert exited.value.code == 0 and "usage: nexwarp" in out and err == ""


def test_python_dash_m(tmp_path):
    """`python -m nexwarp` is the same program; of a mistake, one line is all that reaches the terminal."""
    command = [sys.executable, "-m", "nexwarp", "train", str(tmp_path / "no"), "--device", "cpu"]
    root = Path(__file__).parents[1]
    environment = os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=120)
    assert done.returncode == 2
    assert (
        done.stderr
        == f"nexwarp: error: {tmp_path / 'no'}: no such folder, expected a scene: COLMAP, nerfstudio or Blender\n"
    )
    assert os.listdir(tmp_path) == []


def test_a_run_may_not_replace_its_own_scene(scene, tmp_path, capsys):
    folder = tmp_path / "holds"
    shutil.copytree(scene, folder / "scene")
    (folder / "config.json").write_text("{}")
    assert cli.main(["train", str(folder / "scene"), "--run", str(folder), "--overwrite"]) == 2
    assert "--run: expected a folder that does not contain the scene" in capsys.readouterr().err
    assert (folder / "scene" / "images").is_dir()


# Scenes in other forms


def test_a_blender_scene_through_train_resume_and_eval(tmp_path, capsys):
    """Background, masks and points of the flags reach the run, and eval and --resume find them there again."""
    path = write_blender(make_scene(tmp_path / "colmap"), tmp_path / "blender")
    for file in path.rglob("*.png"):
        with Image.open(file) as photo:
            photo.putalpha(Image.linear_gradient("L").resize(photo.size))
            photo.save(file)
    points = write_points(tmp_path / "mine.ply", np.random.default_rng(0).uniform(-1, 1, (50, 3)), np.zeros((50, 3)))
    run = tmp_path / "run"
    flags = ["--run", str(run), "--device", "cpu", "--max-surfels", "32"]
    flags += ["--background", "0,0.5,1", "--masks", "alpha", "--points", str(points), "--iterations", "3"]
    assert cli.main(["train", str(path), *flags]) == 0
    assert "50 points" in capsys.readouterr().out
    config = read(run, "config.json")
    given = {"background": "0,0.5,1", "masks": "alpha", "points": str(points), "format": None}
    assert config["scene"] == {"path": str(path), "images": "images", "downscale": 1} | given
    assert config["config"]["background"] == [0.0, 0.5, 1.0]
    assert nw.load(run).options.background == (0.0, 0.5, 1.0)
    before = read(run, "metrics.json")["psnr"]
    assert cli.main(["eval", str(run), "--device", "cpu"]) == 0
    assert read(run, "metrics.json")["psnr"] == pytest.approx(before, abs=1e-6)
    assert cli.main(["train", str(path), "--run", str(run), "--device", "cpu", "--resume"]) == 0
    assert cli.main(["train", str(path), "--run", str(run), "--resume", "--background", "white"]) == 2
    assert "--background: expected 0,0.5,1 as in the run to resume, got white" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--background", "pink"], ["background: expected white, black, random or three numbers", "'pink'"]),
        (["--masks", "absent"], ["masks: no folder 'absent'"]),
        (["--points", "nowhere.ply"], ["nowhere.ply: no such file, expected a PLY file"]),
        (["--format", "blender"], ["expected transforms_train.json of a Blender scene"]),
    ],
)
def test_flags_of_scenes_that_cannot_be(scene, refuses, flags, words):
    refuses(scene, flags, *words)
