"""A warp's culling of whole blocks of pixels, which only CUDA does, seen on a CPU too."""

import pytest
import torch
import warp as wp

import nexwarp as nw
from nexwarp import ops
from nexwarp.kernels.types import types
from tests.warp_kernels import FOCAL, HEIGHT, NEAR, WIDTH, visit_blocks

T = types(wp.float32)
BLOCKS = (WIDTH // 8) * (HEIGHT // 4)


@pytest.mark.parametrize("seed", range(6))
def test_no_block_culls_what_one_of_its_pixels_hits(seed: int) -> None:
    """Surfels of all sizes, some around the camera; of the blocks that hit nothing, nearly all are spared."""
    generator = torch.Generator().manual_seed(seed)
    count = 300
    surfels = nw.Surfels.from_activated(
        torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 1.0 + seed % 3]),
        torch.randn(count, 4, generator=generator),
        (torch.randn(count, 2, generator=generator) - 2 - 0.7 * (seed % 4)).exp(),
        torch.rand(count, generator=generator),
        1 + torch.rand(count, 2, generator=generator),
        torch.zeros(count, 1, 3),
    )
    shape = [x.detach() for x in surfels.activated()]
    K = torch.tensor([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    viewmat = torch.eye(4)
    projection = ops.project(*[*shape, torch.zeros(count, 3), viewmat])
    tiles = ops.intersect_tiles(shape, projection, viewmat, ops.Pinhole(K, WIDTH, HEIGHT, NEAR))
    argument = T.Surfels()
    argument.records = wp.from_torch(projection.records, dtype=T.vec4)
    argument.limits, argument.reaches = wp.from_torch(projection.limits), wp.from_torch(tiles.reaches, dtype=T.vec2)
    culled, hits = (wp.zeros((count, BLOCKS), dtype=wp.int32, device="cpu") for _ in range(2))
    wp.launch(visit_blocks, (count, BLOCKS), [argument], [culled, hits], device="cpu")
    spared, hit_pixels = culled.numpy().astype(bool), hits.numpy()
    assert hit_pixels.any() and not hit_pixels[spared].any() and spared.sum() > 0.95 * (hit_pixels == 0).sum()
