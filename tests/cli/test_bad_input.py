import importlib.util
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from nexwarp.cli import main as cli
from tests.cli.support import refused, snapshot
from tests.data.test_scene import make_scene


@pytest.fixture
def refuses(tmp_path, capsys) -> Callable[..., None]:
    """Train, expecting a refusal that leaves no run folder, not even its parent."""

    def check(path: Path | str, flags: list[str], *words: str) -> None:
        run = tmp_path / "runs" / "new"
        refused(capsys, ["train", str(path), "--run", str(run), "--device", "cpu", *flags], *words)
        assert not run.parent.exists()

    return check


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--preset", "papr"], ["preset", "expected one of default, fast, paper", "'papr'"]),
        (["--max-hits", "9"], ["max_hits", "at most 8", "got 9"]),
        (["--downscale", "37"], ["downscale", "expected at most", "got 37"]),
        (["--device", "gpu"], ["--device", "expected cuda or cpu", "'gpu'"]),
        (["--format", "blender"], ["expected transforms_train.json of a Blender scene"]),
        (["--resume"], ["new", "expected a run to resume"]),
        (["--set", "texture.levels=many"], ['--set: texture.levels: expected an integer, got "many"']),
        (["--set", "preset=paper"], ["--set: preset: expected --preset instead"]),
        (["--seed", "1", "--set", "seed=1"], ["--set: seed: expected --seed instead"]),
        (["--set", "seed=1", "--set", "seed=2"], ["--set: seed: expected it once"]),
    ],
)
def test_flags_that_cannot_be(scene, refuses, flags, words):
    refuses(scene, flags, *words)


def test_a_scene_without_its_photos(tmp_path, refuses):
    folder = make_scene(tmp_path / "scene")
    photo = folder / "images" / "03.png"
    refuses(photo, [], f"{photo}: expected the folder of a scene, got a file; give {photo.parent}")
    shutil.rmtree(folder / "images")
    refuses(folder, [], "images", str(folder))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_no_cuda_when_asked_for(scene, finished, refuses, capsys):
    refuses(scene, ["--device", "cuda"], "--device", "no CUDA device", "--device cpu")
    for command in ("eval", "render"):
        refused(capsys, [command, str(finished), "--device", "cuda"], "--device", "no CUDA device")


@pytest.mark.parametrize(
    ("package", "words", "command"),
    [
        ("tensorboard", ["--tensorboard", "pip install 'nexwarp[tensorboard]'"], ["train", "demo", "--tensorboard"]),
        ("av", ["pip install 'nexwarp[video]'"], ["process", "{file}.mp4", "{file}.scene"]),
        ("av", ["--video", "pip install 'nexwarp[video]'"], ["render", "{run}", "--video", "{file}.out.mp4"]),
        ("flip_evaluator", ["--metrics: flip", "pip install 'nexwarp[flip]'"], ["eval", "{run}", "--metrics", "flip"]),
        ("lpips", ["--metrics: lpips", "python -m benchmarks.lpips_weights"], ["eval", "{run}", "--metrics", "lpips"]),
    ],
)
def test_a_missing_package_is_one_line(finished, tmp_path, monkeypatch, capsys, package, words, command):
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *a: None if name == package else find(name, *a))
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setenv("NEXWARP_LPIPS", str(tmp_path / "vgg16.safetensors"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "walk.mp4").touch()
    before = snapshot(tmp_path)
    refused(capsys, [word.format(run=finished, file=tmp_path / "walk") for word in command], *words)
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("content", ["", '{"scene": {"path": 3}, "config": {}}', "\x00"])
@pytest.mark.parametrize("command", ["eval", "info"])
def test_damaged_config(command, content, finished, capsys):
    (finished / "config.json").write_text(content)
    refused(capsys, [command, str(finished)], str(finished / "config.json"), "expected the settings of a nexwarp run")


def test_damaged_files_of_a_run(finished, capsys):
    (finished / "metrics.json").write_text("{")
    refused(capsys, ["info", str(finished)], str(finished / "metrics.json"))
    (finished / "model.safetensors").write_bytes(b"nonsense")
    for command in ("render", "info"):
        refused(capsys, [command, str(finished)], "model.safetensors", "expected a safetensors file")


@pytest.mark.parametrize("columns", [40, 200])
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["expected one of {train, eval", "see nexwarp --help"]),
        (["fly"], ["no command 'fly', expected one of train, eval", "sfm\n"]),
        (["trian", "x"], ["no command 'trian', expected one of", "; perhaps you meant nexwarp train\n"]),
        (["train"], ["missing from nexwarp train: scene folder of a colmap", "see nexwarp train --help"]),
        (["train", "x", "--iterations", "many"], ["--iterations: expected an integer, got 'many'; see nexwarp train"]),
        (["render", "x", "--scale", "big"], ["--scale: expected a number, got 'big'; see nexwarp render --help"]),
        (["train", "x", "--colour", "red"], ["unrecognized options: --colour, red"]),
        (["train", "x", "--itertions", "3"], ["options: --itertions, 3; perhaps you meant --iterations n; see"]),
        (["render", "x", "--out", "r"], ["options: --out, r; perhaps you meant nexwarp export --out folder; see nexw"]),
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
