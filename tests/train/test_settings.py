"""Settings by name, and what training makes of masks, backgrounds and the frame's edge."""

import dataclasses
import re
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.data import Scene, View
from nexwarp.run.evaluate import Evaluation, evaluate
from nexwarp.train.recipe import PRESETS, Config, TextureConfig, preset
from nexwarp.train.settings import config_from_dict, with_settings
from nexwarp.train.trainer import Trainer
from nexwarp.train.views import mean_color
from tests.tolerances import assert_close

pytestmark = pytest.mark.usefixtures("one_torch_thread")

TEXTURE = TextureConfig(levels=4, table_size=2**10, width=16)


@pytest.fixture(scope="session")
def scene(tiny_scene: Scene) -> Scene:
    return tiny_scene


def make_trainer(scene: Scene, **settings) -> Trainer:
    values: dict[str, Any] = {"iterations": 12, "max_surfels": 120, "texture": TEXTURE} | settings
    return Trainer(scene, Config(**values), "cpu")


# Settings by name


def test_settings_reach_into_parts() -> None:
    config = with_settings(Config(), {"max_hits": 3, "texture.residual": False, "rates.mlp": [1e-3, 1e-3]})
    expected = dataclasses.replace(
        Config(),
        max_hits=3,
        texture=dataclasses.replace(Config().texture, residual=False),
        rates=dataclasses.replace(Config().rates, mlp=(1e-3, 1e-3)),
    )
    assert config == expected
    assert config_from_dict(config.as_dict()) == config


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_settings_of_an_older_version_are_completed_from_their_preset(name: str) -> None:
    """What it did not know is not what another preset has: a run of the paper's stays the paper's."""
    full = preset(name).as_dict()
    assert config_from_dict({"preset": name}) == preset(name)
    older = {key: value for key, value in full.items() if key != "smooth_sh"}
    older["texture"] = {"levels": 5, "table_size": 2**8}
    found = config_from_dict(older)
    assert found == with_settings(preset(name), {"texture.levels": 5, "texture.table_size": 2**8})
    assert config_from_dict({"preset": "of mine", "seed": 3}) == dataclasses.replace(Config(), preset="of mine", seed=3)


@pytest.mark.parametrize("name", ["texture.residul", "texture.levels.x", "colour", "seed.x", "losses.", ".residual"])
def test_unknown_settings_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^{re.escape(name)}: expected a setting, such as "):
        with_settings(Config(), {name: 3})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mask_mode": "hide"}, "mask_mode: expected one of ignore, background, got 'hide'"),
        ({"losses.depth": -1.0}, "losses.depth: expected at least 0, got -1.0"),
        ({"texture.levels": 0}, "texture.levels: expected at least 1 and at most 64, got 0"),
        ({"texture.table_size": 1000}, "texture.table_size: expected a power of two, got 1000"),
        ({"texture.sh_degree": 4}, "texture.sh_degree: expected at least 0 and at most 3, got 4"),
    ],
)
def test_values_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        with_settings(Config(), settings)


# The camera of a window


def test_a_window_sees_what_the_camera_sees_there(scene: Scene) -> None:
    camera = scene.train[0].camera
    window = camera.crop(5, -3, 20, 30)
    assert (window.width, window.height, window.near) == (20, 30, camera.near)
    pixels, depths = camera.project(scene.points)
    shifted, same = window.project(scene.points)
    assert_close(shifted, pixels - torch.tensor([5.0, -3.0]), kind="value", name="pixels")
    assert torch.equal(depths, same)
    again = nw.Camera(window.viewmat, window.K, 20, 30, camera.near)
    assert (again.cx, again.cy, again.fx) == pytest.approx((window.cx, window.cy, window.fx))
    assert camera.crop(0, 0, camera.width, camera.height).cx == camera.cx


# Backgrounds


def test_background_is_the_given_one_the_scenes_or_the_mean(scene: Scene) -> None:
    photos = torch.stack([view.image for view in scene.train]).double() / 255
    assert mean_color(scene.train) == pytest.approx(photos.mean((0, 1, 2)).tolist(), abs=1e-9)
    assert make_trainer(scene).render_options().background == mean_color(scene.train)
    black = make_trainer(scene, background=(0.0, 0.0, 0.0))
    assert black.render_options().background == (0.0, 0.0, 0.0)
    white = dataclasses.replace(scene, background=(1.0, 1.0, 1.0))
    assert make_trainer(white).render_options().background == (1.0, 1.0, 1.0)


def test_random_backgrounds_go_behind_photo_and_rendering_alike(scene: Scene) -> None:
    alpha = torch.full((36, 48), 255, dtype=torch.uint8)
    alpha[:10] = 51
    views = [dataclasses.replace(v, alpha=alpha) for v in scene.train]
    random = dataclasses.replace(scene, train=views, background=(1.0, 1.0, 1.0), random_background=True)
    trainer = make_trainer(random)
    seen = [trainer.targets.from_view(0) for _ in range(3)]
    colors = [torch.as_tensor(view.background) for view in seen]
    assert len({tuple(color.tolist()) for color in colors}) == 3
    photo = views[0].image.float() / 255
    for view, color in zip(seen, colors, strict=True):
        expected = photo[:10] + 0.8 * (color - 1.0)
        assert_close(view.photo[:10], expected, kind="value", name="transparent")
        assert_close(view.photo[10:], photo[10:], kind="value", name="opaque")
    assert trainer.render_options().background == (1.0, 1.0, 1.0)


# Masks

SQUARE = slice(10, 26), slice(14, 34)


def with_intruder(scene: Scene, masked: bool) -> Scene:
    """A red square before every training photo, and masks that leave it out."""
    mask = torch.ones(36, 48, dtype=torch.bool)
    mask[SQUARE] = False

    def spoilt(view: View) -> View:
        image = view.image.clone()
        image[SQUARE] = torch.tensor([255, 0, 0], dtype=torch.uint8)
        return dataclasses.replace(view, image=image, mask=mask if masked else None)

    return dataclasses.replace(scene, train=[spoilt(view) for view in scene.train])


def redness(trainer: Trainer) -> float:
    """How much redder than their photos the test views are, in the middle, 0 to 1."""
    views = trainer.scene.test
    with torch.no_grad():
        images = [out.image for out in trainer.model().render([view.camera for view in views])]
    pairs = [(image[SQUARE], view.image[SQUARE] / 255) for image, view in zip(images, views, strict=True)]
    return sum(((a[..., 0] - a[..., 2]) - (b[..., 0] - b[..., 2])).mean().item() for a, b in pairs) / len(pairs)


@pytest.mark.timeout(120)
def test_what_masks_leave_out_does_not_appear(scene: Scene) -> None:
    """An intruder that moves with the camera, before every photo; learnt without masks, left out with them."""
    settings = {"iterations": 120, "max_surfels": 400}
    results = []
    for masked in (False, True):
        trainer = make_trainer(with_intruder(scene, masked), **settings)
        trainer.run()
        results.append(redness(trainer))
    without, with_masks = results
    assert without > 0.08
    assert abs(with_masks) < 0.2 * without


def test_a_mask_as_background_empties_what_it_leaves_out(scene: Scene) -> None:
    mask = torch.zeros(36, 48, dtype=torch.bool)
    mask[:, :24] = True
    views = [dataclasses.replace(view, mask=mask) for view in scene.train]
    halves = dataclasses.replace(scene, train=views)
    alphas = {}
    for mode in ("ignore", "background"):
        trainer = make_trainer(halves, iterations=60, mask_mode=mode)
        trainer.run()
        with torch.no_grad():
            view = trainer.targets.from_view(0)
            outs = trainer.model().render([v.camera for v in scene.train])
        alphas[mode] = torch.stack([out.alpha[:, 30:] for out in outs]).mean().item()
        if mode == "background":
            assert (view.photo[:, 24:] == torch.tensor(trainer.background)).all()
            assert view.counts is None and view.empty is not None and torch.equal(view.empty, ~mask)
    assert alphas["background"] < 0.75 * alphas["ignore"]


def test_masks_take_part_in_the_judgement(scene: Scene) -> None:
    trainer = make_trainer(scene)
    mask = torch.zeros(36, 48, dtype=torch.bool)
    mask[:, :24] = True
    view = dataclasses.replace(scene.test[0], mask=mask)
    spoilt = dataclasses.replace(view, image=torch.where(mask[..., None], view.image, 255 - view.image))
    model = trainer.model()

    def judge(*views: View, mode: str = "ignore") -> Evaluation:
        metrics = ("psnr", "ssim", "flip")
        return evaluate(model, views, mask_mode=mode, metrics=metrics)

    one, other = judge(view), judge(spoilt)
    assert one["psnr"] == other["psnr"]
    assert judge(view, mode="background")["psnr"] == judge(spoilt, mode="background")["psnr"] != one["psnr"]
    with pytest.raises(ValueError, match=r"^metrics: expected some of psnr, ssim, flip, lpips, got 'mse'$"):
        evaluate(model, [view], metrics=("mse",))
