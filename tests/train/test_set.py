"""nexwarp train --set: what it takes and refuses, what a run keeps of it, and what --resume makes of it."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.cli.train import Train
from nexwarp.data.scene import SceneSource
from nexwarp.train.recipe import PRESETS, Config, LearningRates, preset
from nexwarp.train.settings import config_from_dict, parse_settings, setting, with_settings
from tests.scene_writers import write_blender, write_demo

SHAPE = ["--set", "texture.levels=4", "--set", "texture.table_size=256", "--set", "texture.width=16"]
FLAGS = [*SHAPE, "--iterations", "2", "--max-surfels", "50", "--device", "cpu"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return write_demo(tmp_path_factory.mktemp("scenes") / "tiny", width=24, height=18, views=9, points=100)


@pytest.fixture(scope="module")
def run(scene, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    extra = ["--set", "mask_mode=background", "--set", "rates.means=[1e-4, 1e-6]", "--set", "skybox=90"]
    assert cli.main(["train", str(scene), "--run", str(run), *FLAGS, *extra]) == 0
    return run


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str], *words: str) -> None:
    """Fail unless the command exits with 2 and one line on stderr that holds all of `words`."""
    capsys.readouterr()
    assert cli.main(arguments) == 2
    err = capsys.readouterr().err
    assert err.startswith("nexwarp: error: ") and err.count("\n") == 1, err
    assert all(word in err for word in words), err


# In Python


def test_every_setting_can_be_set_to_what_it_is():
    """By its name, through JSON, for both presets: the same config, with the same types."""
    for config in PRESETS.values():
        data = config.as_dict()
        parts = {name: value for name, value in data.items() if isinstance(value, dict)}
        flat = {name: value for name, value in data.items() if name not in parts}
        flat |= {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
        texts = [f"{name}={json.dumps(value)}" for name, value in flat.items()]
        again = with_settings(Config(), parse_settings(texts))
        assert again == config and repr(again) == repr(config)
        assert all(setting(again, name) == setting(config, name) for name in flat)


def test_types():
    """Integers do for numbers and lists for tuples; what is stored has the field's own type."""
    config = with_settings(Config(), {"texture.max_resolution": 1024, "rates.grid": [1, 0.5], "background": [0, 0, 1]})
    assert type(config.texture.max_resolution) is float and config.rates.grid == (1.0, 0.5)
    assert config.background == (0.0, 0.0, 1.0) and type(config.background[0]) is float
    assert with_settings(config, {"background": None}).background is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("max_resolution=1", "max_resolution: expected a setting, such as texture.max_resolution"),
        ("texture.nope=1", "texture.nope: expected a setting, such as texture."),
        ("texture=1", "texture: expected a setting"),
        ("texture.__init__=1", "texture.__init__: expected a setting"),
        ("scaled=1", "scaled: expected a setting"),
        ("a.b.c=1", "a.b.c: expected a setting"),
        ("texture.levels=16.0", "texture.levels: expected an integer, got 16.0"),
        ("max_hits=true", "max_hits: expected an integer, got true"),
        ("texture.residual=1", "texture.residual: expected true or false, got 1"),
        ("texture.residual=False", 'texture.residual: expected true or false, got "False"'),
        ("texture.max_resolution=NaN", "texture.max_resolution: expected a number or null, got NaN"),
        ("smooth_sh=1e999", "smooth_sh: expected a number, got Infinity"),
        (f"iterations=1{'0' * 4000}", "iterations: expected an integer, got 1000"),
        ("mask_mode=3", "mask_mode: expected text, got 3"),
        ("mask_mode=both", "mask_mode: expected one of ignore, background, got 'both'"),
        ("rates.means=[1e-3]", "rates.means: expected a list of 2 numbers, got [0.001]"),
        ("rates.means=0.1", "rates.means: expected a list of 2 numbers, got 0.1"),
        ("rates.means=[0.1, 0]", "rates.means: expected rates > 0, or 0 throughout, got (0.1, 0.0)"),
        ("rates.quats=-1", "rates.quats: expected rates > 0"),
        ("background=[0, 0, 2]", "background: expected at least 0 and at most 1, got 2"),
        ("background=[[0], 0, 0]", "background: expected a number, got [0]"),
        ("densify.every=0", "densify.every: expected at least 1, got 0"),
        ("losses.dssim=2", "losses.dssim: expected at least 0 and at most 1, got 2"),
        ("sh_every=0", "sh_every: expected at least 1, got 0"),
        ("skybox", "expected KEY=VALUE, got 'skybox'"),
        ("skybox=", "expected KEY=VALUE, got 'skybox='"),
        ("coarse=0.4", "coarse: expected a setting, got one that was removed"),
        ("=1", "expected KEY=VALUE, got '=1'"),
    ],
)
def test_refused(text, message):
    with pytest.raises(ValueError) as caught:
        with_settings(Config(), parse_settings([text]))
    assert str(caught.value).startswith(message) and len(str(caught.value)) < 200


def test_a_setting_is_given_once():
    with pytest.raises(ValueError, match=r"^skybox: expected it once, got it twice$"):
        parse_settings(["skybox=90", "skybox=1"])


def test_rates_of_zero_are_allowed():
    """They keep a parameter as it starts: the paper's ablation without gamma."""
    assert LearningRates(gammas=0.0, means=(0.0, 0.0)).gammas == 0.0


# nexwarp train --set


def test_a_run_keeps_what_was_set(run):
    stored = json.loads((run / "config.json").read_text())["config"]
    config = config_from_dict(stored)
    changes: dict[str, Any] = {"texture.levels": 4, "texture.table_size": 256, "texture.width": 16, "skybox": 90}
    changes |= {"mask_mode": "background", "rates.means": (1e-4, 1e-6), "iterations": 2, "max_surfels": 50}
    assert config == with_settings(preset("default"), changes)
    texture = nw.load(run).texture
    assert texture is not None and texture.grid.shape == (4, 256, 4)


def test_resume_agrees_or_is_refused(run, scene, capsys):
    resume = ["train", str(scene), "--run", str(run), "--resume", "--device", "cpu"]
    assert cli.main([*resume, "--set", "texture.levels=4", "--set", "mask_mode=background"]) == 0
    # What shapes no number may change.
    assert cli.main([*resume, "--set", "cuda_graphs=false"]) == 0
    before = (run / "config.json").read_bytes()
    expected = "--set: texture.levels: expected 4 as in the run to resume, got 8"
    refused(capsys, [*resume, "--set", "texture.levels=8"], expected)
    refused(capsys, [*resume, "--set", "texture.nope=8"], "--set: texture.nope: expected a setting")
    refused(capsys, [*resume, "--set", "preset=paper"], "--set: preset: expected --preset instead")
    assert (run / "config.json").read_bytes() == before


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--set", "nope=1"], ["--set: nope: expected a setting"]),
        (["--set", "skybox"], ["--set: expected KEY=VALUE, got 'skybox'"]),
        (["--set", "texture.levels=many"], ['--set: texture.levels: expected an integer, got "many"']),
        (["--set", "texture.table_size=1000"], ["table_size", "power of two"]),
        (["--set", "preset=paper"], ["--set: preset: expected --preset instead"]),
        (["--seed", "1", "--set", "seed=1"], ["--set: seed: expected --seed instead"]),
        (["--set", "seed=1", "--set", "seed=2"], ["--set: seed: expected it once"]),
        (["--set", "mask_mode=hide"], ["mask_mode: expected one of ignore, background, got 'hide'"]),
    ],
)
def test_bad_flags_leave_nothing_behind(scene, tmp_path, capsys, flags, words):
    run = tmp_path / "runs" / "new"
    refused(capsys, ["train", str(scene), "--run", str(run), "--device", "cpu", *flags], *words)
    assert not run.parent.exists()


def test_a_scene_on_a_background_takes_it_from_its_flag(scene, tmp_path, capsys):
    """Photos that were put on white must not be compared with renderings on another colour."""
    path = write_blender(scene, tmp_path / "blender")
    for file in path.rglob("*.png"):
        with Image.open(file) as photo:
            photo.putalpha(200)
            photo.save(file)
    flags = ["train", str(path), "--run", str(tmp_path / "run"), *FLAGS]
    refused(capsys, [*flags, "--set", "background=[0, 0, 0]"], "--set: background: expected --background instead")
    assert not (tmp_path / "run").exists()


def test_the_demo_keeps_what_makes_a_preset():
    """Its own settings are those of a short run on a CPU; the paper's texture stays the paper's."""
    train = Train(SceneSource("demo"), preset="paper")
    config, paper = train._config(), preset("paper")
    assert (config.preset, config.iterations, config.texture.levels) == ("paper", 1200, 12)
    for name in ("texture.residual", "texture.max_resolution", "losses.depth", "densify.prune_at_cap", "smooth_sh"):
        assert setting(config, name) == setting(paper, name)
    assert dataclasses.replace(train, preset="default")._config().texture.residual
