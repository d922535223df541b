import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.model.graphs import _kind
from nexwarp.train.recipe import LossWeights
from nexwarp.train.target import TrainingViews
from tests.narrowing import present
from tests.tolerances import assert_close
from tests.trainer_support import assert_resumed_alike, assert_same_state, small, trained

OFF = LossWeights(depth_maps=0.0)


def at(view: nw.View, depth: float) -> nw.View:
    return dataclasses.replace(view, depth=torch.full(view.image.shape[:2], depth).half())


@pytest.fixture
def mapped(scene: nw.Scene) -> nw.Scene:
    """A scene whose photos have maps, but for one."""
    return dataclasses.replace(scene, train=[scene.train[0], *(at(view, 3.0) for view in scene.train[1:])])


def test_without_maps_the_loss_changes_no_bit(scene: nw.Scene, mapped: nw.Scene) -> None:
    plain = trained(scene, small(losses=OFF))
    assert_same_state(trained(scene, small()), plain)
    assert_same_state(trained(mapped, small(losses=OFF)), plain)
    trainer = nw.Trainer(scene, small(), "cpu")
    assert trainer.targets.make(0, 1).depth is None and "depth_maps" not in trainer.step().losses


def test_photos_without_a_map_have_the_same_kind_of_step(mapped: nw.Scene) -> None:
    """So that one CUDA graph serves all, those with a teacher's picture too: zeros, which count nowhere."""
    trainer = nw.Trainer(mapped, small(losses=LossWeights(depth=0.0)), "cpu")
    bare, full = (trainer.targets.make(index, 1) for index in (0, 1))
    assert _kind(bare) == _kind(full) and not present(bare.depth).any() and bool((present(full.depth) == 3).all())
    teacher = trained(mapped, small(seed=1)).finish()
    student = nw.Trainer(mapped, small(losses=LossWeights(depth=0.0)), "cpu", teachers=[teacher])
    taught = student.targets.make(1, 2)
    assert _kind(taught) == _kind(full) and not present(taught.depth).any()


@pytest.mark.parametrize("mode", ["ignore", "background"])
def test_masked_pixels_have_no_depth(mapped: nw.Scene, mode: str) -> None:
    view = mapped.train[1]
    mask = torch.rand(view.image.shape[:2]) < 0.5
    scene = dataclasses.replace(mapped, train=[dataclasses.replace(view, mask=mask), *mapped.train[2:]])
    trainer = nw.Trainer(scene, small(mask_mode=mode), "cpu")
    depth = trainer.targets.make(0, 1).depth
    assert torch.equal(present(depth), 3.0 * mask)


def test_maps_draw_the_surfels(mapped: nw.Scene) -> None:
    """Half as deep as the scene is: their error falls, and without the loss it does not."""
    scene = dataclasses.replace(mapped, train=[at(view, 1.5) for view in mapped.train])

    def error(losses: LossWeights) -> float:
        trainer = trained(scene, small(iterations=60, losses=losses, exposures=False))
        with torch.no_grad():
            depths = [trainer.model().render(view.camera).expected_depth for view in scene.train]
        return float(np.mean([(depth / 1.5 - 1).abs().mean().item() for depth in depths]))

    assert error(LossWeights(depth=0.0, depth_maps=3.0)) < 0.9 * error(LossWeights(depth=0.0, depth_maps=0.0))


def test_a_run_with_maps_resumes_and_other_maps_are_another_scene(mapped: nw.Scene, tmp_path: Path) -> None:
    assert_resumed_alike(trained(mapped, small()), tmp_path)
    other = dataclasses.replace(mapped, train=[mapped.train[0], *(at(view, 4.0) for view in mapped.train[1:])])
    with pytest.raises(nw.errors.CheckpointError, match="photos, masks, depth maps or points have changed"):
        nw.Trainer(other, small(), "cpu").restore(tmp_path)


@pytest.mark.cuda
@pytest.mark.parametrize("share", [1.0, 0.0])
def test_maps_are_the_same_wherever_they_lie(mapped: nw.Scene, monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    monkeypatch.setattr(sys.modules["nexwarp.train.target"], "PHOTO_SHARE", share)  # nexwarp.train is a function, too
    views = TrainingViews(mapped.train, torch.device("cuda"))
    for index, view in enumerate(mapped.train):
        expected = torch.zeros(view.image.shape[:2]) if view.depth is None else view.depth.float()
        assert_close(present(views.depth(index)).cpu(), expected, kind="value", name="depth")
