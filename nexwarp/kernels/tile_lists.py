"""Tile lists (paper Sec. 3, after 3DGS): entries (tile, surfel), counted and emitted in depth order.

A thread is a surfel. Written are integers: nothing here is differentiated.

The threads of a warp share the tile rows of their 32 surfels, 32 rows at once: most surfels cover one to three rows,
near ones hundreds. They share the entries of these rows, too, and write them in order.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from nexwarp.kernels.tiles import LARGEST_INT, span
from nexwarp.kernels.types import ints, per_real
from nexwarp.native.warp import from_lane, lane_index, owner_lane, warp_running_sum, warp_size

# A typed constant: a bare literal of this size would be an int32.
SIGN = wp.constant(wp.uint32(2147483648))
LARGEST_END = wp.constant(wp.int64(LARGEST_INT))


@per_real()
def depth_keys(first: int, centers: vec3s, keys: wp.array(dtype=wp.uint32), indices: ints):
    """Sortable uint32 keys of signed centre depths."""
    i = first + wp.tid()
    # Adding 0 makes -0 and 0 tie, as they do in any comparison of floats.
    bits = wp.cast(wp.float32(centers[i][2]) + wp.float32(0.0), wp.uint32)
    keys[i] = wp.where((bits & SIGN) != wp.uint32(0), ~bits, bits | SIGN)
    indices[i] = i


@wp.func
def shared_row(place: int, rows: int, i: int, start: int, tile_columns: int, polygons: Any):
    """(surfel, tile row, first tile, number of tiles) of one of the warp's `rows` rows.

    A lane's surfel is i, and its rows begin at the place `start`.
    """
    owner = owner_lane(start, place)
    surfel = from_lane(i, owner)
    row = place - from_lane(start, owner)
    s = wp.vec2i(0, -1)
    if place < rows:
        shape = polygons.shapes[surfel]
        row += shape[1]
        s = span(surfel, row, tile_columns, shape[0], polygons)
    return surfel, row, s[0], wp.max(s[1] - s[0] + 1, 0)


@wp.func
def rows_of(thread: int, order: ints, polygons: Any):
    """(surfel, its number of tile rows) of a thread."""
    i = int(0)
    rows = int(0)
    if thread < order.shape[0]:
        i = order[thread]
        shape = polygons.shapes[i]
        rows = wp.max(shape[2] - shape[1] + 1, 0)
    return i, rows


@per_real(grid_stride=False)
def count(first: int, order: ints, polygons: Polygons, grid: wp.vec2i, counts: wp.array(dtype=wp.int64)):
    """Number of each surfel's entries, a thread a surfel in depth order."""
    thread = first + wp.tid()
    i, rows = rows_of(thread, order, polygons)
    end = warp_running_sum(rows)
    start = end - rows
    width = warp_size()
    all_rows = from_lane(end, width - 1)
    total = int(0)
    for batch in range(0, all_rows, width):
        _surfel, _row, _left, tiles = shared_row(batch + lane_index(), all_rows, i, start, grid[0], polygons)
        sums = warp_running_sum(tiles)
        # Those of this lane's rows that are in the batch.
        low = wp.clamp(start - batch, 0, width)
        high = wp.clamp(end - batch, 0, width)
        before = from_lane(sums, wp.max(low - 1, 0))
        upto = from_lane(sums, wp.max(high - 1, 0))
        if high > low:
            total += upto
            if low > 0:
                total -= before
    if thread < order.shape[0]:
        counts[thread] = wp.int64(total)


@per_real(grid_stride=False)
def emit(  # noqa: PLR0913  # a kernel entry point
    first: int,
    order: ints,
    polygons: Polygons,
    grid: wp.vec2i,
    totals: wp.array(dtype=wp.int64),
    threads: int,
    no_tile: int,
    # outputs
    ends: ints,
    tiles: ints,
    entries: ints,
    surfels: ints,
):
    """The (tile, surfel) entries, a thread a surfel in depth order.

    Read are the sums of the counts along the order, `totals`, and repeated as `ends`, where a number that an int32
    cannot hold is the largest int32. `entries` gets each entry's own index, and `surfels` its surfel; without
    `surfels`, a null array, `entries` gets the surfel. Places of the lists behind the last entry get the tile
    `no_tile`.
    """
    thread = first + wp.tid()
    surfel_count = order.shape[0]
    lane = lane_index()
    width = warp_size()
    if thread < surfel_count:
        ends[thread] = int(wp.min(totals[thread], LARGEST_END))
    room = wp.int64(entries.shape[0])
    # The lists may be too short (see `nexwarp.ops.tiles`): nothing is written behind their ends.
    e = int(0)
    if thread > lane:
        e = int(wp.min(totals[thread - lane - 1], room))
    end = int(wp.min(totals[wp.min(thread - lane + width, surfel_count) - 1], room))
    i, rows = rows_of(thread, order, polygons)
    start = warp_running_sum(rows)
    all_rows = from_lane(start, width - 1)
    start -= rows
    if e >= end:
        all_rows = int(0)
    for batch in range(0, all_rows, width):
        surfel, row, left, number = shared_row(batch + lane, all_rows, i, start, grid[0], polygons)
        begin = warp_running_sum(number)
        all_tiles = from_lane(begin, width - 1)
        begin -= number
        left += row * grid[0] - begin
        for part in range(0, all_tiles, width):
            place = part + lane
            owner = owner_lane(begin, place)
            tile = from_lane(left, owner) + place
            owned = from_lane(surfel, owner)
            at = e + place
            # A compiler may round here otherwise than in `count`: the next warp's entries begin at `end`.
            if place < all_tiles and at < end:
                tiles[at] = tile
                if surfels:
                    entries[at] = at
                    surfels[at] = owned
                else:
                    entries[at] = owned
        e = wp.min(e + all_tiles, end)
    for at in range(e + lane, end, width):
        tiles[at] = no_tile
        entries[at] = 0
    for at in range(int(wp.min(totals[surfel_count - 1], room)) + thread, entries.shape[0], threads):
        tiles[at] = no_tile
        entries[at] = 0
