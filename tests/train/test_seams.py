"""Refinement near the seams of a merged model: what changes, what does not, and that it helps."""

import copy
import dataclasses
from typing import Any

import pytest
import torch

from nexwarp.data import Scene
from nexwarp.errors import SceneError
from nexwarp.model.merged_texture import MergedTexture
from nexwarp.model.model import Model
from nexwarp.model.surfels import PARAMETERS
from nexwarp.train import seams
from nexwarp.train.blocks import inside, merge_blocks, split_space
from nexwarp.train.seams import SeamTrainer, near_seams, seam_scene
from nexwarp.train.trainer import Trainer
from tests.narrowing import present
from tests.scenes import make_surfels, make_texture, random_scene
from tests.trainer_support import assert_same_state, small, trained

pytestmark = pytest.mark.usefixtures("one_torch_thread", "few_places")


def test_seams_are_where_cells_meet() -> None:
    points = torch.rand(4000, 3) * torch.tensor([4.0, 2.0, 1.0])
    cells = split_space(points, 2)
    cut = cells[0, 1, 0]
    assert torch.equal(near_seams(points, cells, 0.1), (points[:, 0] - cut).abs() < 0.1)
    assert not near_seams(points, split_space(points, 1), 0.1).any()  # the outer sides of space are no seams
    # Of more cells: a point is near a seam if one that is nearer than the band is in another cell.
    cells = split_space(points, 5)
    owner = torch.stack([inside(points, cell) for cell in cells]).float().argmax(dim=0)
    near = near_seams(points, cells, 0.1)
    others = torch.zeros_like(near)
    for offset in 0.0999 * (torch.rand(300, 3) * 2 - 1).sign() * torch.rand(300, 3).pow(0.2):
        moved = torch.stack([inside(points + offset, cell) for cell in cells]).float().argmax(dim=0)
        others |= moved != owner
    assert (near | ~others).all() and others.sum() > 0.9 * near.sum()


@pytest.fixture(scope="module")
def merged(tiny_scene: Scene) -> Model:
    """Two trainings of the whole scene that know nothing of each other, cut and put together."""
    models = [trained(tiny_scene, small(iterations=60, seed=seed, exposures=False)).model() for seed in (0, 1)]
    return merge_blocks(models, split_space(tiny_scene.points, 2))


def test_only_surfels_near_seams_and_textures_change(tiny_scene: Scene, merged: Model) -> None:
    model = copy.deepcopy(merged)
    trainer = SeamTrainer(tiny_scene, model, small(iterations=30, exposures=False), band=0.05)
    assert 0 < trainer.trained.sum() < len(model.surfels) and trainer.model().options == merged.options
    trainer.run()
    after = trainer.model()
    for name in PARAMETERS:
        before, now = getattr(merged.surfels, name), getattr(after.surfels, name)
        assert torch.equal(now[~trainer.trained], before[~trainer.trained]), name
        assert not torch.equal(now[trainer.trained], before[trainer.trained]) or name == "shN", name
    assert isinstance(after.texture, MergedTexture) and isinstance(merged.texture, MergedTexture)
    for part, before in zip(after.texture.textures, merged.texture.textures, strict=True):
        assert not torch.equal(part.grid, before.grid)
    assert len(trainer.finish().surfels) == len(merged.surfels)


def test_all_views_finish_the_model(tiny_scene: Scene, merged: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Views that do not see the seams too: what they alone show keeps its colours and texture."""
    monkeypatch.setattr(seams, "seam_scene", lambda scene, *_: dataclasses.replace(scene, train=scene.train[:1]))
    config = small(iterations=2, exposures=False)
    trainer = SeamTrainer(tiny_scene, copy.deepcopy(merged), config)
    assert len(trainer.scene.train) == 1
    whole = Trainer(tiny_scene, config, "cpu")
    whole.surfels, whole.texture = trainer.surfels, trainer.texture
    monkeypatch.setattr(whole, "render_options", trainer.render_options)
    found, expected = trainer.finish(), whole.finish()
    assert found.state_dict().keys() == expected.state_dict().keys()
    for name, x in expected.state_dict().items():
        assert torch.equal(found.state_dict()[name], x), name


def test_copies_of_the_blocks_trainings_go(tiny_scene: Scene, merged: Model) -> None:
    """A training of the merged model changes the grids without telling them."""
    model = copy.deepcopy(merged)
    texture = present(model.texture)
    assert isinstance(texture, MergedTexture)
    for part in texture.textures:
        part.half_copy()
    assert texture.half_copy_key() is not None
    SeamTrainer(tiny_scene, model, small(iterations=2, exposures=False))
    assert texture.half_copy_key() is None and all(part.half_copy_key() is None for part in texture.textures)


@pytest.mark.parametrize("settings", [{"refine_poses": True}, {"blur_poses": 3}])
def test_learned_poses_are_refused(tiny_scene: Scene, merged: Model, settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="refine_poses=False and blur_poses=1"):
        SeamTrainer(tiny_scene, merged, small(iterations=2, exposures=False, **settings))


def test_refinement_lowers_the_error_and_can_go_back(tiny_scene: Scene, merged: Model) -> None:
    config = small(iterations=40, exposures=False)

    def error(model: Model) -> float:
        with torch.no_grad():
            errors = [(model.render(v.camera).image - v.image / 255).abs().mean() for v in tiny_scene.train]
        return float(torch.stack(errors).mean())

    trainer = SeamTrainer(tiny_scene, copy.deepcopy(merged), config, band=0.3)
    trainer.run(until=20)
    kept = trainer.snapshot()
    trainer.run()
    assert error(trainer.model()) < error(merged)
    again = SeamTrainer(tiny_scene, copy.deepcopy(merged), config, band=0.3)
    again.load_snapshot(kept)
    again.run()
    assert_same_state(again, trainer)


def test_what_has_no_seams_is_refused(tiny_scene: Scene, merged: Model) -> None:
    alone = Model(make_surfels(random_scene(20)).float(), make_texture().float())
    with pytest.raises(TypeError, match="model: expected a merged model with a texture for each block"):
        SeamTrainer(tiny_scene, alone, small())
    with pytest.raises(SceneError, match="expected views that see the seams between the blocks, found none"):
        seam_scene(tiny_scene, split_space(tiny_scene.points, 1), 0.1)
    assert isinstance(merged.texture, MergedTexture)
    few = dataclasses.replace(tiny_scene, points=tiny_scene.points[:0])
    with pytest.raises(SceneError, match="expected views that see the seams"):
        SeamTrainer(few, merged, small())
