"""Tile lists: which surfels may be seen in which tile of the image, near to far."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from nexwarp.kernels.tiles import depth_keys_kernel, list_kernels, surfel_ids_kernel, tile_offsets_kernel
from nexwarp.kernels.types import types
from nexwarp.ops._interop import array, launch, real_of, stream_of
from nexwarp.ops.pinhole import Pinhole
from nexwarp.ops.project import Projection

TILE_SIZE = 16


@dataclass(frozen=True)
class Tiles:
    """Lists of (tile, surfel) entries. Integers, so nothing here is differentiable.

    Attributes:
        order: (N,) int32, surfels by signed z-depth of their centres (as float32), ties by index.
        ends: (N,) int32, end of the entries of the surfel order[rank] in emission order.
        surfel_ids: (M,) int32, surfels by tile, and near to far within a tile.
        entries: (M,) int32, emission index of each of those.
        tile_offsets: (tiles + 1,) int32, half-open ranges of `surfel_ids` by tile, row by row.
        tile_size: pixels along a tile's side.
        columns: tiles in a row.
    """

    order: torch.Tensor
    ends: torch.Tensor
    surfel_ids: torch.Tensor
    entries: torch.Tensor
    tile_offsets: torch.Tensor
    tile_size: int
    columns: int


def intersect_tiles(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    gammas: torch.Tensor,
    projection: Projection,
    viewmat: torch.Tensor,
    camera: Pinhole,
    *,
    low_pass: bool = False,
    tile_size: int = TILE_SIZE,
) -> Tiles:
    """List, for each tile, the surfels whose support touches it (arguments as for `project`).

    Args:
        means, quats, scales, opacities, gammas: activated surfels.
        projection: of the same surfels.
        viewmat: (4, 4) world to camera.
        camera: the image plane.
        low_pass: whether supports include the screen-space low-pass.
        tile_size: pixels along a tile's side, a multiple of 8.
    """
    if tile_size % 8 or tile_size < 8:
        raise ValueError(f"tile_size: expected a multiple of 8, got {tile_size}")
    tensors = [x.detach().contiguous() for x in (means, quats, scales, opacities, gammas)]
    real, count = real_of(means), len(means)
    t = types(real)
    columns, rows = -(-camera.width // tile_size), -(-camera.height // tile_size)
    order = _depth_order(projection.centers.detach(), t)
    kernels = list_kernels(real, low_pass, tile_size)
    dtypes = (t.vec3, t.vec4, t.vec2, real, t.vec2)
    arguments = [
        array(order, wp.int32),
        *(array(x, dtype) for x, dtype in zip(tensors, dtypes, strict=True)),
        array(viewmat.contiguous()[None], t.mat44),
        t.vec4(*camera.intrinsics),
        camera.near,
        wp.vec2i(columns, rows),
    ]
    ends = torch.zeros(count, dtype=torch.int32, device=means.device)
    launch(means, kernels.count, count, arguments, [array(ends, wp.int32)])
    total = _scan(ends)
    entries, tile_ids, surfels = _pairs(total, means.device)
    emitted = [array(x, wp.int32) for x in (tile_ids, entries, surfels)]
    launch(means, kernels.emit, count, [*arguments, array(ends, wp.int32)], emitted)
    _sort(tile_ids, entries, total, (columns * rows).bit_length())
    surfel_ids = torch.empty(total, dtype=torch.int32, device=means.device)
    launch(means, surfel_ids_kernel, total, emitted[1:], [array(surfel_ids, wp.int32)])
    offsets = torch.empty(columns * rows + 1, dtype=torch.int32, device=means.device)
    launch(means, tile_offsets_kernel, len(offsets), [emitted[0], total], [array(offsets, wp.int32)])
    return Tiles(order, ends, surfel_ids, entries[:total], offsets, tile_size, columns)


def _depth_order(centers: torch.Tensor, t: Any) -> torch.Tensor:
    """Indices of surfels by signed depth, ties by index (the sort is stable)."""
    count = len(centers)
    # The sort takes the second half of its arrays as scratch.
    keys, order = (torch.empty(2 * count, dtype=torch.int32, device=centers.device) for _ in range(2))
    outputs = [array(keys, wp.uint32), array(order, wp.int32)]
    launch(centers, depth_keys_kernel(t.real), count, [array(centers.contiguous(), t.vec3)], outputs)
    _sort(keys, order, count, 32)
    return order[:count]


def _pairs(total: int, device: torch.device) -> list[torch.Tensor]:
    return [torch.empty(2 * total, dtype=torch.int32, device=device) for _ in range(3)]


def _sort(keys: torch.Tensor, values: torch.Tensor, count: int, bits: int) -> None:
    """Sort the first `count` pairs by the low `bits` bits of their keys, stably, in place."""
    if count == 0:
        return
    arrays = [wp.from_torch(keys, dtype=wp.uint32), wp.from_torch(values, dtype=wp.int32)]
    with wp.ScopedStream(stream_of(keys)):
        wp.utils.radix_sort_pairs(*arrays, count, end_bit=bits)


def _scan(counts: torch.Tensor) -> int:
    """Turn counts into ends in place and return the total, which sizes the lists: the one wait of a frame on CUDA."""
    if len(counts) == 0:
        return 0
    ends = wp.from_torch(counts, dtype=wp.int32)
    with wp.ScopedStream(stream_of(counts)):
        wp.utils.array_scan(ends, ends, inclusive=True)
    return int(counts[-1])
