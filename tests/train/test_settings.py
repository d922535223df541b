import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from nexwarp.cli import main as cli
from nexwarp.cli.train import Train
from nexwarp.data.scene import SceneSource
from nexwarp.train import recipe
from nexwarp.train.recipe import PRESETS, Config, config_from_dict, parse_settings, preset, setting, with_settings
from tests.cli.support import refused
from tests.scene_writers import write_blender

SHAPE = ["--set", "texture.levels=4", "--set", "texture.table_size=256", "--set", "texture.width=16"]
FLAGS = [*SHAPE, "--iterations", "2", "--max-surfels", "50", "--device", "cpu"]


@pytest.fixture(scope="module")
def run(tiny_folder, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    extra = ["--set", "mask_mode=background", "--set", "rates.means=[1e-4, 1e-6]", "--set", "skybox=90"]
    assert cli.main(["train", str(tiny_folder), "--run", str(run), *FLAGS, *extra]) == 0
    return run


def test_every_setting_can_be_set_to_what_it_is():
    """By its name, through JSON, for all presets: the same config, with the same types."""
    for config in PRESETS.values():
        data = json.loads(json.dumps(config.as_dict()))
        assert config_from_dict(data) == config
        parts = {name: value for name, value in data.items() if isinstance(value, dict)}
        flat = {name: value for name, value in data.items() if name not in parts}
        flat |= {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
        texts = [f"{name}={json.dumps(value)}" for name, value in flat.items()]
        again = with_settings(Config(), parse_settings(texts))
        assert again == config and repr(again) == repr(config)
        assert all(setting(again, name) == setting(config, name) for name in flat)
    whole = with_settings(Config(), {"texture.max_resolution": 1024, "background": [0, 0, 1]})  # integers for numbers
    assert type(whole.texture.max_resolution) is float and whole.background == (0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("max_resolution=1", "max_resolution: expected a setting, such as texture.max_resolution"),
        ("texture.nope=1", "texture.nope: expected a setting, such as texture."),
        ("texture.__init__=1", "texture.__init__: expected a setting"),
        ("texture.levels=16.0", "texture.levels: expected an integer, got 16.0"),
        ("texture.residual=1", "texture.residual: expected true or false, got 1"),
        ("texture.max_resolution=NaN", "texture.max_resolution: expected a number or null, got NaN"),
        (f"iterations=1{'0' * 4000}", "iterations: expected an integer, got 1000"),
        ("mask_mode=both", "mask_mode: expected one of ignore, background, got 'both'"),
        ("rates.means=[1e-3]", "rates.means: expected a number or a list of 2 numbers, got [0.001]"),
        ("rates.means=[0.1, 0]", "rates.means: expected rates > 0, or 0 throughout, got (0.1, 0.0)"),
        ("background=[0, 0, 2]", "background: expected at least 0 and at most 1, got 2"),
        ("densify.every=0", "densify.every: expected at least 1, got 0"),
        ("skybox", "expected KEY=VALUE, got 'skybox'"),
        ("max_surfels=15", "max_surfels: expected at least 16, got 15"),
        ("max_hits=9", "max_hits: expected at least 0 and at most 8, got 9"),
        ("texture.levels=0", "texture.levels: expected at least 1 and at most 64, got 0"),
        ("texture.table_size=1000", "texture.table_size: expected a power of two, got 1000"),
        ("coarse=0.4", "coarse: expected a setting, got one that was removed"),
    ],
)
def test_refused(text, message):
    with pytest.raises(ValueError) as caught:
        with_settings(Config(), parse_settings([text]))
    assert str(caught.value).startswith(message) and len(str(caught.value)) < 200


def test_paper_is_the_paper():
    """The numbers of recipe.md 3.9, spelt out."""
    p = preset("paper")
    assert (p.preset, p.iterations, p.max_hits, p.sh_degree, p.sh_every) == ("paper", 30_000, 2, 3, 1000)
    assert (p.max_surfels, p.background, p.more_hits_from, p.mask_mode) == (400_000, (0.0, 0.0, 0.0), 0, "ignore")
    assert not any((p.filter_points, p.orient_points, p.footprints, p.smooth_sh, p.exposures)) and p.least_gamma == 1
    zero = {"depth": 0.0, "depth_maps": 0.0}
    assert p.losses == recipe.LossWeights(dssim=0.2, alpha=0.005, texture=0.5, opacity=0.01, grid=0.01, **zero)
    constant = {"quats": 1e-3, "scales": 5e-3, "opacities": 0.025, "gammas": 1e-3, "sh0": 2.5e-3, "shN": 1.25e-4}
    assert p.rates == recipe.LearningRates(means=(1.6e-4, 1.6e-6), grid=(1e-3, 1e-5), mlp=1e-3, **constant)
    sizes = {"levels": 16, "table_size": 2**20, "features": 2, "width": 64, "hidden_layers": 2, "sh_degree": None}
    ends = {"min_resolution": 16.0, "max_resolution": 256.0}
    assert dataclasses.asdict(p.texture) == sizes | ends | {"residual": False, "down_weighting": True}
    rounds = {"start": 500, "stop": 25_000, "every": 100, "fraction": 0.05}
    pruning = {"prune_opacity": 0.005, "prune_at_cap": False, "relocate": 0.0}
    assert dataclasses.asdict(p.densify) == rounds | pruning


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_settings_of_an_older_version_are_completed_from_their_preset(name: str) -> None:
    """What it did not know is not what another preset has: a run of the paper's stays the paper's."""
    full = preset(name).as_dict()
    assert config_from_dict({"preset": name}) == preset(name)
    older = {key: value for key, value in full.items() if key != "smooth_sh"}
    older["texture"] = {"levels": 5, "table_size": 2**8}
    assert config_from_dict(older) == with_settings(preset(name), {"texture.levels": 5, "texture.table_size": 2**8})
    assert config_from_dict({"preset": "of mine", "seed": 3}) == dataclasses.replace(Config(), preset="of mine", seed=3)


def test_runs_from_before_a_setting_keep_what_they_did():
    written = Config().as_dict()
    assert config_from_dict(written) == Config()
    del written["densify"]["relocate"]
    assert config_from_dict(written).densify == dataclasses.replace(recipe.DensifyConfig(), relocate=0.0)
    del written["skybox"], written["teachers"], written["least_gamma"]
    found = config_from_dict(written)
    assert (found.skybox, found.teachers, Config().teachers, found.least_gamma) == (0, 0, None, 1.0)


@pytest.mark.parametrize("change", [lambda d: d | {"texture": 3}, lambda d: d | {"iterations": "many"}, lambda _: []])
def test_settings_of_another_kind_are_refused(change):
    with pytest.raises(ValueError, match=r"^config: expected the settings of a nexwarp run") as caught:
        config_from_dict(change(Config().as_dict()))
    assert "\n" not in str(caught.value)


def test_resume_agrees_or_is_refused(run, tiny_folder, capsys):
    resume = ["train", str(tiny_folder), "--run", str(run), "--resume", "--device", "cpu"]
    assert cli.main([*resume, "--set", "texture.levels=4", "--set", "mask_mode=background"]) == 0
    # What shapes no number may change.
    assert cli.main([*resume, "--set", "cuda_graphs=false"]) == 0
    before = (run / "config.json").read_bytes()
    expected = "--set: texture.levels: expected 4 as in the run to resume, got 8"
    refused(capsys, [*resume, "--set", "texture.levels=8"], expected)
    assert (run / "config.json").read_bytes() == before


def test_a_scene_on_a_background_takes_it_from_its_flag(tiny_folder, tmp_path, capsys):
    """Photos that were put on white must not be compared with renderings on another colour."""
    path = write_blender(tiny_folder, tmp_path / "blender")
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
    assert (config.preset, config.iterations, config.texture.levels) == ("paper", 700, 12)
    for name in ("texture.residual", "texture.max_resolution", "losses.depth", "densify.prune_at_cap", "smooth_sh"):
        assert setting(config, name) == setting(paper, name)
    assert dataclasses.replace(train, preset="default")._config().texture.residual


def test_a_value_of_another_type_names_its_field() -> None:
    given: tuple[dict[str, Any], ...] = ({"iterations": "x"}, {"background": (0.0, 1.0)}, {"densify": {}})
    for changes in given:
        with pytest.raises(ValueError, match=f"{next(iter(changes))}: expected (an integer|a list of 3|DensifyConfig)"):
            Config(**changes)
