"""Blocks of space: cells fill space, blocks keep to them, and merged models render what their parts do."""

import json
from pathlib import Path

import pytest
import torch

import nexwarp as nw
from benchmarks import blocks
from nexwarp.data import Scene
from nexwarp.errors import SceneError
from nexwarp.model.detail_limits import DetailLimits
from nexwarp.model.merged_texture import MergedTexture, make_texture
from nexwarp.model.model import Model
from nexwarp.train.blocks import FAR, BlockTrainer, block_scene, grown, inside, merge_blocks, split_space
from nexwarp.train.densify import DensifyConfig
from nexwarp.train.finish.order import ordered
from tests.scenes import make_camera, make_surfels, random_scene
from tests.scenes import make_texture as random_texture
from tests.tolerances import assert_close
from tests.trainer_support import small

pytestmark = pytest.mark.usefixtures("one_torch_thread", "few_places")


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_cells_fill_space_and_share_the_points(count: int) -> None:
    points = torch.randn(1000, 3) * torch.tensor([5.0, 1.0, 3.0])
    cells = split_space(points, count)
    assert cells.shape == (count, 2, 3)
    held = torch.stack([inside(points, cell) for cell in cells])
    assert (held.sum(0) == 1).all()  # each point is in one cell
    assert held.sum(1).max() <= 2 * held.sum(1).min() + 2
    anywhere = 100 * torch.randn(2000, 3)
    assert (torch.stack([inside(anywhere, cell) for cell in cells]).sum(0) == 1).all()
    if count == 2:
        assert cells[0, 1].tolist() == [
            pytest.approx(points[:, 0].median().item()),
            pytest.approx(FAR),
            pytest.approx(FAR),
        ]
    with pytest.raises(ValueError, match="count: expected 1 to 1000 cells"):
        split_space(points, 0)


def test_a_model_cut_into_cells_and_merged_renders_the_same(tmp_path: Path) -> None:
    """Both blocks are the whole model: each cell takes its own surfels and points, and nothing is lost or doubled."""
    scene = random_scene(60)
    camera, surfels, texture = make_camera(scene), make_surfels(scene), random_texture()
    surfels, texture, camera = surfels.float(), texture.float(), camera
    limits = DetailLimits(torch.zeros(len(surfels)), torch.full((len(surfels),), 1e3))
    model = Model(surfels, texture, detail_limits=limits)
    cells = split_space(surfels.means.detach(), 3)
    merged = merge_blocks([model] * 3, cells)
    assert len(merged.surfels) == len(surfels) and isinstance(merged.texture, MergedTexture)
    assert_close(merged.render(camera).image, model.render(camera).image, kind="value", name="image")
    # A file keeps it; grid and MLP in half precision, as those of other models.
    file = merged.save(tmp_path)
    loaded, again = nw.load(file), nw.load(model.save(tmp_path / "whole"))
    assert isinstance(loaded.texture, MergedTexture)
    assert_close(loaded.render(camera).image, again.render(camera).image, kind="value", name="loaded image")
    positions = torch.randn(50, 3)
    depths = torch.ones(50)
    assert torch.equal(merged.texture(positions, depths, 100.0), texture(positions, depths, 100.0))


def test_a_merged_model_has_details_once_it_is_ordered(tmp_path: Path) -> None:
    scene = random_scene(40)
    camera, model = make_camera(scene), Model(make_surfels(scene).float(), random_texture().float())
    cells = split_space(model.surfels.means.detach(), 2)
    merged = merge_blocks([ordered(model, [camera])] * 2, cells)
    with pytest.raises(ValueError, match="detail: expected a model with surfels in the order"):
        merged.at_detail(0.5)
    whole = ordered(merged, [camera])
    coarse, file = whole.at_detail(0.5), whole.save(tmp_path)
    assert len(coarse.surfels) == 20 and isinstance(coarse.texture, MergedTexture)
    read = nw.load(file, detail=0.5)
    assert torch.equal(read.surfels.means, coarse.surfels.means) and isinstance(read.texture, MergedTexture)


def test_points_have_the_texture_of_their_cell() -> None:
    parts = [random_texture().float() for _ in range(2)]
    with torch.no_grad():
        parts[1].grid.add_(1.0)
    cells = split_space(torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]]), 2)
    merged = MergedTexture(parts, cells)
    positions = torch.randn(40, 3)
    right = positions[:, 0] >= cells[1, 0, 0]
    told, (one, other) = merged(positions, torch.ones(40), 100.0), (p(positions, torch.ones(40), 100.0) for p in parts)
    assert torch.equal(told, torch.where(right[:, None, None], other, one)) and not torch.equal(one, other)


def test_what_cannot_be_merged_is_named(tmp_path: Path) -> None:
    scene = random_scene(20)
    model = Model(make_surfels(scene).float(), random_texture().float())
    cells = split_space(model.surfels.means.detach(), 2)
    with pytest.raises(ValueError, match="models: expected one for each of 2 cells, got 1"):
        merge_blocks([model], cells)
    other = Model(model.surfels, model.texture, options=model.options.changed(max_hits=1))
    with pytest.raises(ValueError, match=r"models\[1\]: expected the options of the first one"):
        merge_blocks([model, other], cells)
    with pytest.raises(ValueError, match="models: expected textures in all models or in none"):
        merge_blocks([model, Model(model.surfels, None)], cells)
    with pytest.raises(ValueError, match="texture: expected 1 to 1024 parts, got"):
        make_texture({"parts": []})


def test_a_block_keeps_to_its_cell(tiny_scene: Scene) -> None:
    cells = split_space(tiny_scene.points, 2)
    for cell in cells:
        part = block_scene(tiny_scene, cell, overlap=0.1, context=0.3)
        near = inside(part.points, grown(cell, 0.1 * tiny_scene.scale))
        assert near.sum() == inside(tiny_scene.points, grown(cell, 0.1 * tiny_scene.scale)).sum()
        assert 0 < (~near).sum() < 0.6 * (len(tiny_scene.points) - near.sum())
    often = small(iterations=12, max_surfels=120, densify=DensifyConfig(every=3))
    trainer = BlockTrainer(part, often, "cpu", cell, overlap=0.1)
    trainer.run(until=2)
    errors, reached = trainer.densifier.errors, inside(trainer.surfels.means.detach(), trainer.reach)
    assert (errors[reached] > 0).any() and (errors[~reached] == 0).all() and not reached.all()
    behind = torch.tensor([[1e3] * 3, [2e3] * 3])
    with pytest.raises(SceneError, match="expected views that see the block, found none"):
        block_scene(tiny_scene, behind)


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_merged_blocks_of_the_demo_have_no_seam(capsys: pytest.CaptureFixture[str]) -> None:
    assert blocks.main([]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    refined, alone = found["refined"], found["one training"]
    assert found["surfels"][1] <= found["surfels"][0]
    for name in ("psnr", "psnr at the seam"):
        assert refined[name] >= alone[name] - 0.2, found
