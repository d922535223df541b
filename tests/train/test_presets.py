"""A preset has its numbers, and settings that cannot be are refused."""

import dataclasses
import json

import pytest

from nexwarp.train.recipe import MIN_SURFELS, Config, DensifyConfig, LearningRates, LossWeights, TextureConfig, preset
from nexwarp.train.settings import config_from_dict
from tests.trainer_support import small


def test_paper_is_the_paper():
    """The numbers of recipe.md 3.9, spelt out."""
    p = preset("paper")
    assert (p.preset, p.iterations, p.max_hits, p.sh_degree, p.sh_every) == ("paper", 30_000, 2, 3, 1000)
    assert p.more_hits_from == 0
    assert (p.max_surfels, p.background) == (400_000, (0.0, 0.0, 0.0))
    assert (p.filter_points, p.orient_points) == (False, False)
    assert p.losses == LossWeights(dssim=0.2, alpha=0.005, texture=0.5, opacity=0.01, grid=0.01, depth=0.0)
    assert (p.mask_mode, p.footprints, p.smooth_sh) == ("ignore", False, 0.0)
    assert not p.exposures
    assert p.rates == LearningRates(
        means=(1.6e-4, 1.6e-6),
        quats=1e-3,
        scales=5e-3,
        opacities=0.025,
        gammas=1e-3,
        sh0=2.5e-3,
        shN=1.25e-4,
        grid=(1e-3, 1e-5),
        mlp=(1e-3, 1e-3),
    )
    assert p.texture == TextureConfig(
        levels=16,
        table_size=2**20,
        features=2,
        min_resolution=16.0,
        max_resolution=256.0,
        width=64,
        hidden_layers=2,
        sh_degree=None,
        residual=False,
        down_weighting=True,
    )
    assert p.densify == DensifyConfig(
        start=500,
        stop=25_000,
        every=100,
        fraction=0.05,
        prune_opacity=0.005,
        prune_at_cap=False,
        relocate=0.0,
    )


def test_default_prunes_at_the_cap_and_filters_points():
    p = preset("default")
    assert p == Config() and p.densify.prune_at_cap and p.filter_points
    assert p.texture.min_resolution is None and p.texture.max_resolution is None
    assert p.texture.residual and p.background is None and p.losses.depth > 0


def test_unknown_preset_is_refused():
    with pytest.raises(ValueError, match=r"^preset: expected one of default, paper, web, got 'papr'$"):
        preset("papr")


@pytest.mark.parametrize("config", [Config(), preset("paper"), small(background=(0.1, 0.5, 1.0), seed=3)])
def test_config_survives_json(config):
    again = config_from_dict(json.loads(json.dumps(config.as_dict())))
    assert again == config and again.as_dict() == config.as_dict()


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d | {"texture": 3},
        lambda d: d | {"iterations": "many"},
        lambda _: [],
    ],
)
def test_settings_of_another_kind_are_refused(change):
    with pytest.raises(ValueError, match=r"^config: expected the settings of a nexwarp run") as caught:
        config_from_dict(change(Config().as_dict()))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_surfels", MIN_SURFELS - 1),
        ("max_surfels", 0),
        ("iterations", 0),
        ("max_hits", 9),
        ("max_hits", -1),
        ("more_hits_from", -1),
        ("sh_degree", 7),
    ],
)
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=rf"^{name}: expected at least .*, got {value}$"):
        Config(**{name: value})


def test_runs_from_before_a_setting_keep_what_they_did():
    written = Config().as_dict()
    assert config_from_dict(written) == Config()
    del written["densify"]["relocate"]
    assert config_from_dict(written).densify == dataclasses.replace(DensifyConfig(), relocate=0.0)
    del written["skybox"]
    assert config_from_dict(written).skybox == 0
