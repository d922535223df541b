import dataclasses
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.run.evaluate import evaluate
from nexwarp.train.target import mean_color
from tests.tolerances import assert_close
from tests.trainer_support import small


def make_trainer(scene: nw.Scene, **settings: Any) -> nw.Trainer:
    return nw.Trainer(scene, small(**settings), "cpu")


def test_background_is_the_given_one_the_scenes_or_the_mean(scene: nw.Scene) -> None:
    photos = torch.stack([view.image for view in scene.train]).double() / 255
    assert mean_color(scene.train) == pytest.approx(photos.mean((0, 1, 2)).tolist(), abs=1e-9)
    assert make_trainer(scene).render_options().background == mean_color(scene.train)
    assert make_trainer(scene, background=(0.0, 0.0, 0.0)).render_options().background == (0.0, 0.0, 0.0)
    white = dataclasses.replace(scene, background=(1.0, 1.0, 1.0))
    assert make_trainer(white).render_options().background == (1.0, 1.0, 1.0)


def test_random_backgrounds_go_behind_photo_and_rendering_alike(scene: nw.Scene) -> None:
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


def test_a_mask_as_background_empties_what_it_leaves_out(scene: nw.Scene) -> None:
    mask = torch.zeros(36, 48, dtype=torch.bool)
    mask[:, :24] = True
    halves = dataclasses.replace(scene, train=[dataclasses.replace(view, mask=mask) for view in scene.train])
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


def test_masks_take_part_in_the_judgement(scene: nw.Scene) -> None:
    trainer = make_trainer(scene)
    mask = torch.zeros(36, 48, dtype=torch.bool)
    mask[:, :24] = True
    view = dataclasses.replace(scene.test[0], mask=mask)
    spoilt = dataclasses.replace(view, image=torch.where(mask[..., None], view.image, 255 - view.image))
    model = trainer.model()

    def judge(*views: nw.View, mode: str = "ignore") -> dict[str, Any]:
        return evaluate(model, views, mask_mode=mode, metrics=("psnr", "ssim", "flip"))

    one, other = judge(view), judge(spoilt)
    assert one["psnr"] == other["psnr"]
    assert judge(view, mode="background")["psnr"] == judge(spoilt, mode="background")["psnr"] != one["psnr"]
    with pytest.raises(ValueError, match=r"^metrics: expected some of psnr, ssim, flip, lpips, got 'mse'$"):
        evaluate(model, [view], metrics=("mse",))
