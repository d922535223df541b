import itertools

import pytest
import torch

from nexwarp.kernels import launch
from nexwarp.native.warp import tile_size_on
from tests.render_support import Passes
from tests.scenes import facing_scene, random_scene
from tests.tolerances import assert_close


@pytest.mark.usefixtures("restore_threads")
@pytest.mark.parametrize("room", [0, 3, 10_000])
def test_too_little_or_too_much_room_changes_nothing(room: int, device: torch.device) -> None:
    # Without room, walks go over all surfels, and a CPU's gradients straight to these, without atomics: by one thread.
    launch.set_num_threads(1)
    scene = random_scene(60, width=70, height=40, device=device)
    usual, other = Passes(scene), Passes(scene, room=room)
    assert len(other.tiles.surfel_ids) == room and int(usual.tiles.ends[-1]) > 3
    for name, buffer in usual.buffers().items():
        assert torch.equal(buffer, other.buffers()[name]), name
    gradients = other.gradients()
    for name, gradient in usual.gradients().items():
        assert_close(gradients[name], gradient, kind="gradient", name=name)


def test_lists_are_near_to_far_and_cover_every_hit(device: torch.device) -> None:
    scene = random_scene(60, width=70, height=40, device=device)
    passes = Passes(scene)
    tiles, hits = passes.tiles, passes.hits
    viewmat = scene["viewmat"]
    depths = scene["means"] @ viewmat[:3, :3].T + viewmat[:3, 3]
    offsets = tiles.tile_offsets.tolist()
    side = tile_size_on(device.type == "cuda")
    for tile, (start, end) in enumerate(itertools.pairwise(offsets)):
        listed = tiles.surfel_ids[start:end].long()
        assert (depths[listed, 2].diff() >= -1e-5).all() and len(listed.unique()) == len(listed)
        row, column = divmod(tile, tiles.columns)
        seen = hits.ids[row * side : (row + 1) * side, column * side : (column + 1) * side].unique()
        assert set(seen[seen >= 0].tolist()) <= set(listed.tolist())


def test_a_surfel_is_listed_in_the_tiles_of_its_quad_not_of_its_box(device: torch.device) -> None:
    turn = torch.tensor([0.9238795, 0.0, 0.0, 0.3826834], device=device)  # 45 degrees about the view axis
    scene = facing_scene((4.0, 0.99), gamma=50.0, size=(128, 128), focal=320.0, device=device)
    scene |= {"quats": turn[None], "scales": torch.tensor([[1.0, 0.005]], device=device)}
    passes = Passes(scene)
    tiles, hits = passes.tiles, passes.hits
    touched = int(tiles.ends[-1])
    assert (hits.alpha > 0).any()
    diagonal = 128 // tile_size_on(device.type == "cuda")
    assert diagonal <= touched <= 3 * diagonal, f"{touched} tiles of {diagonal**2}"
