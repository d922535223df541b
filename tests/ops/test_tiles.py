"""Tile lists: what is listed, in which order, and what happens when there is no room for all of it."""

import itertools

import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.kernels import launch
from nexwarp.native.warp import tile_size_on
from tests.scenes import CAMERA_KEYS, SURFEL_KEYS, Scene, random_scene
from tests.tolerances import assert_close


def passes(scene: Scene, room: int | None) -> tuple[ops.Tiles, ops.Hits, list[torch.Tensor]]:
    surfels = nw.Surfels.from_activated(*(scene[key] for key in SURFEL_KEYS))
    camera = nw.Camera(**{key: scene[key] for key in CAMERA_KEYS})
    pinhole = ops.Pinhole(camera.K, camera.width, camera.height, camera.near)
    shape = (surfels.means, surfels.quats, surfels.scales, surfels.opacities, surfels.gammas)
    colors = ops.plain_colors(surfels.sh, surfels.means, camera.position, 3)
    projection = ops.project(*shape, colors, camera.viewmat)
    tiles = ops.intersect_tiles(shape, projection, camera.viewmat, pinhole, room=room)
    hits = ops.collect(projection, tiles, pinhole)
    total = hits.plain.square().sum() + hits.weights.sum() + hits.depths.sum() + hits.alpha.square().sum()
    return tiles, hits, list(torch.autograd.grad(total, list(surfels.parameters()), allow_unused=True))


@pytest.mark.usefixtures("restore_launch_threads")
@pytest.mark.parametrize("room", [0, 3, 10_000])
def test_too_little_or_too_much_room_changes_nothing(room: int, device: torch.device) -> None:
    # Without room, a CPU's gradients go straight to surfels: atomics are none there, so only one thread may run.
    launch.set_num_threads(1)
    scene = random_scene(60, width=70, height=40, device=device)
    tiles, hits, gradients = passes(scene, None)
    other_tiles, other_hits, other_gradients = passes(scene, room)
    assert len(other_tiles.surfel_ids) == room and int(tiles.ends[-1]) > 3
    for name in ("plain", "ids", "depths", "weights", "alpha"):
        assert torch.equal(getattr(hits, name), getattr(other_hits, name)), name
    for index, (gradient, other) in enumerate(zip(gradients, other_gradients, strict=True)):
        assert_close(other, gradient, kind="gradient", name=f"parameter {index}")


def test_lists_are_near_to_far_and_cover_every_hit(device: torch.device) -> None:
    scene = random_scene(60, width=70, height=40, device=device)
    tiles, hits, _ = passes(scene, None)
    viewmat = scene["viewmat"]
    depths = scene["means"] @ viewmat[:3, :3].T + viewmat[:3, 3]
    offsets = tiles.tile_offsets.tolist()
    side = tile_size_on(device.type == "cuda")
    for tile, (start, end) in enumerate(itertools.pairwise(offsets)):
        listed = tiles.surfel_ids[start:end].long()
        assert (depths[listed, 2].diff() >= -1e-5).all()
        assert len(listed.unique()) == len(listed)
        row, column = divmod(tile, tiles.columns)
        seen = hits.ids[row * side : (row + 1) * side, column * side : (column + 1) * side].unique()
        assert set(seen[seen >= 0].tolist()) <= set(listed.tolist())


def test_a_surfel_is_listed_in_the_tiles_of_its_quad_not_of_its_box(device: torch.device) -> None:
    """A thin diagonal bar touches about a diagonal of the tiles."""
    turn = torch.tensor([0.9238795, 0.0, 0.0, 0.3826834], device=device)  # 45 degrees about the view axis
    scene = random_scene(1, width=128, height=128, device=device)
    scene |= {
        "means": torch.tensor([[0.0, 0.0, 4.0]], device=device),
        "quats": turn[None],
        "scales": torch.tensor([[1.0, 0.005]], device=device),
        "opacities": torch.tensor([0.99], device=device),
        "gammas": torch.full((1, 2), 50.0, device=device),
        "viewmat": torch.eye(4, device=device),
        "K": torch.tensor([[320.0, 0.0, 64.0], [0.0, 320.0, 64.0], [0.0, 0.0, 1.0]], device=device),
    }
    tiles, hits, _ = passes(scene, None)
    touched = int(tiles.ends[-1])
    assert (hits.alpha > 0).any()
    diagonal = 128 // tile_size_on(device.type == "cuda")
    assert diagonal <= touched <= 3 * diagonal, f"{touched} tiles of {diagonal**2}"
