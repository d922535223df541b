"""The walk along the tiles' lists (paper Sec. 4.2), as collect, collect_backward and surface share it.

A thread is a pixel. The 32 threads of a warp are a block of 8 x 4 pixels, the warps of a tile cover its pixels, and the
tiles cover the image, so that some threads lie outside of it. A warp culls the list together: each lane tests one entry
against the whole block, then all lanes walk along the entries that are left, about half of a tile's, whose records wait
in shared memory. On a CPU a warp is one thread, which tests nothing here, since the hit itself is as cheap: tiles are
smaller instead.

Read: the lists of `nexwarp.ops.Tiles`, and the records of `surfel`. Nothing here is written or differentiated; which
entries are walked is frozen for the backward pass.
"""

import warp as wp

from nexwarp.kernels.surfel import intrinsics_of, ray_through
from nexwarp.kernels.types import Real, Surfels, TileLists, Vec2, Vec4, View
from nexwarp.native.staging import stage_record
from nexwarp.native.vector_loads import record_row
from nexwarp.native.warp import ballot, lane_index, lanes_below, population, sync_warp, tile_size, warp_size

# Half of the distances between the outer pixel centres of a block, and a little.
HALF_WIDTH = wp.constant(wp.float64(3.51))
HALF_HEIGHT = wp.constant(wp.float64(1.51))
# Relative to the terms of the sums that decide whether a block of pixels is culled: float32 has a tenth of it.
SLACK = wp.constant(wp.float64(1e-6))


@wp.func
def overflowed(lists: TileLists):
    """Whether there are more entries than the lists have room for."""
    count = lists.ends.shape[0]
    if count == 0:
        return False
    return lists.ends[count - 1] > lists.surfel_ids.shape[0]


# Returns a vector and takes `overflow`: with three results the backward pass needs 8 registers more (sm_90).
@wp.func
def walk(tile: int, lists: TileLists, overflow: wp.bool):
    """(first place, end) of a tile's walk.

    The walk goes along the tile's list, or over all surfels where lists lack entries (overflow): lists only cull, so
    this is slow but right.
    """
    if overflow:
        return wp.vec2i(0, lists.ends.shape[0])
    return wp.vec2i(lists.tile_offsets[tile], lists.tile_offsets[tile + 1])


@wp.func
def surfel_at(k: int, lists: TileLists, overflow: wp.bool):
    """Surfel at place k of the walk."""
    if overflow:
        return lists.order[k]
    return lists.surfel_ids[k]


@wp.func
def tile_of(thread: int):
    """Tile that a thread's pixel is in."""
    return thread // (tile_size() * tile_size())


@wp.func
def pixel_of(thread: int, view: View):
    """(pixel's column and row, whether it is in the image, its ray)."""
    side = tile_size()
    tile = tile_of(thread)
    local = thread % (side * side)
    block = local // 32
    lane = local % 32
    blocks_across = side // 8
    xy = wp.vec2i(
        (tile % view.tile_columns) * side + (block % blocks_across) * 8 + lane % 8,
        (tile // view.tile_columns) * side + (block // blocks_across) * 4 + lane // 8,
    )
    half = type(view.near)(0.5)
    x = type(view.near)(float(xy[0])) + half
    y = type(view.near)(float(xy[1])) + half
    return xy, xy[0] < view.size[0] and xy[1] < view.size[1], ray_through(x, y, intrinsics_of(view.Ks[0]))


@wp.func
def block_of(xy: wp.vec2i, view: View):
    """(ray through the middle of the pixel's block, half of the block's extent in such coordinates)."""
    x = type(view.near)(float(xy[0] - xy[0] % 8 + 4))
    y = type(view.near)(float(xy[1] - xy[1] % 4 + 2))
    intrinsics = intrinsics_of(view.Ks[0])
    middle = ray_through(x, y, intrinsics)
    return middle, wp.vector(type(x)(HALF_WIDTH) / intrinsics[0], type(x)(HALF_HEIGHT) / intrinsics[1])


@wp.func
def beside(side: Vec4, n: Vec4, facing: Real, reach: Real, d: Vec2, half: Vec2):
    """Whether all rays of a block, d +- half, meet the plane where |coordinate| > reach, `side` being a or b.

    Where the hit lies before the camera, facing * n . d > 0, so that side . d <= reach * facing * n . d is linear
    in d: the block's corners bound it. The slack is for rounding.
    """
    x = side[0] * d[0]
    y = side[1] * d[1]
    nx = facing * reach * n[0]
    ny = facing * reach * n[1]
    across = facing * reach * n[2] + nx * d[0] + ny * d[1]
    along = x + y + side[2]
    slack = type(reach)(SLACK) * (
        wp.abs(x) + wp.abs(y) + wp.abs(side[2]) + reach * (wp.abs(n[0] * d[0]) + wp.abs(n[1] * d[1]) + wp.abs(n[2]))
    )
    above = along - across - wp.abs(side[0] - nx) * half[0] - wp.abs(side[1] - ny) * half[1]
    below = -along - across - wp.abs(side[0] + nx) * half[0] - wp.abs(side[1] + ny) * half[1]
    return above > slack or below > slack


@wp.func
def misses_block(i: int, surfels: Surfels, d: Vec2, half: Vec2):
    """Whether no ray of a block of pixels, d +- half, can hit a surfel. Only culls: conservative."""
    m = record_row(surfels.records, i, 3)[3]
    a = record_row(surfels.records, i, 0)
    b = record_row(surfels.records, i, 1)
    n = record_row(surfels.records, i, 2)
    one = type(m)(1.0)
    facing = wp.where(m < type(m)(0.0), -one, one)
    reach = surfels.reaches[i]
    return beside(a, n, facing, reach[0], d, half) or beside(b, n, facing, reach[1], d, half)


@wp.func
def stage(batch: int, end: int, surfels: Surfels, lists: TileLists, overflow: wp.bool, middle: Vec2, half: Vec2):
    """Stage up to a warp's width of surfels from place `batch` on; CUDA leaves out those that miss the whole block.

    Return (number of surfels staged, this lane's surfel, -1 if it is not staged).
    """
    k = batch + lane_index()
    i = int(-1)
    if k < end:
        i = surfel_at(k, lists, overflow)
        if warp_size() > 1:
            if misses_block(i, surfels, middle, half):
                i = int(-1)
    chosen = ballot(wp.where(i >= 0, 1, 0))
    sync_warp()  # the batch before has been read
    if i >= 0:
        stage_record(lanes_below(chosen), i, k, surfels.records)
    sync_warp()
    return population(chosen), i
