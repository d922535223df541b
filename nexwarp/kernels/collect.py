"""Collection pass, forward (paper Sec. 4.2): walk a tile's list near to far, blend, keep the K heaviest hits.

A thread is a pixel (see `walk`). Read: the surfels' records and limits, and the tiles' lists. Written:

    plain    N = sum over the hits outside the buffer of weight * plain colour (paper Eq. 6)
    base     the same sum over the hits in the buffer: what they would look like without a texture
    ids, depths, weights    the K heaviest hits, heaviest first; on a tie the nearer one stays
    alphas   1 - final transmittance
    stops    end of the part of the walk that was taken
    channels wide: as plain, of sixteen more channels

A hit counts where alpha >= 1/255 and its depth lies beyond `near`; the walk ends behind the hit that takes the
transmittance below 1e-4. `collect_backward` differentiates all outputs but ids and stops with respect to records.
Frozen there: the lists, which hits count, which are in the buffer, where the walk ends.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from nexwarp.kernels.shape import alpha_at, far_outside
from nexwarp.kernels.surfel import hit
from nexwarp.kernels.types import TileLists, func_per_real, per_real
from nexwarp.kernels.walk import block_of, overflowed, pixel_of, stage, tile_of, walk
from nexwarp.native.staging import BLOCK_DIM, staged_name, staged_record
from nexwarp.native.vector_loads import load_record, record_row
from nexwarp.native.warp import any_in_warp, warp_size


@func_per_real
def empty_buffer():
    """(ids, weights) of an empty K-buffer, registers of static length; K = 0 has one unused slot."""
    ids = wp.vector(length=wp.static(max(max_hits, 1)), dtype=wp.int32)
    for j in range(wp.static(max_hits)):
        ids[j] = -1
    return ids, wp.vector(length=wp.static(max(max_hits, 1)), dtype=real)


@func_per_real
def write_buffer(surfels: Surfels, hits: Hits, p: int, ids: Any, weights: Any, d: vec2):
    """Write the buffer of pixel p, whose ray is d; return the blended colour of its hits."""
    base = vec3()
    for j in range(wp.static(max_hits)):
        i = ids[j]
        depth = real(0.0)
        if i >= 0:
            a, b, n, c = load_record(surfels.records, i)
            base += vec3(c[0], c[1], c[2]) * weights[j]
            _u, _v, depth = hit(a, b, n, c[3], d)
        hits.ids[p, j] = i
        hits.depths[p, j] = depth
        hits.weights[p, j] = weights[j]
    return base


# The sixteen more channels of a wide walk are a mat44; of another, these functions do nothing.


@func_per_real
def load_channels(rows: vec4_rows, i: int):
    """Row i of an array of channels."""
    result = mat44()
    if wp.static(wide):
        a, b, c, d = load_record(rows, i)
        result = wp.matrix_from_rows(a, b, c, d)
    return result


@func_per_real
def store_channels(hits: Hits, p: int, total: mat44):
    """Write the channels of pixel p."""
    if wp.static(wide):
        for row in range(4):
            hits.channels[p, row] = total[row]


@func_per_real
def channel_product(rows: vec4_rows, i: int, grad: mat44):
    """Inner product of row i and a gradient."""
    result = real(0.0)
    if wp.static(wide):
        result = wp.ddot(load_channels(rows, i), grad)
    return result


@wp.func
def alpha_if_near(u: Any, v: Any, limit: Any, opacity: Any, g1: Any, g2: Any):
    """`alpha_at`, on a CPU 0 far outside; on a GPU some lane nearly always needs the exponentials."""
    alpha = type(u)(0.0)
    if warp_size() > 1 or not far_outside(u, v, limit):
        alpha = alpha_at(u, v, opacity, g1, g2)
    return alpha


def _launch_bounds(real: type, max_hits: int, wide: bool) -> int | tuple[int, int]:
    """Where registers are few, as many blocks at once as 64 registers allow."""
    return (BLOCK_DIM, 8) if real is wp.float32 and max_hits <= 2 and not wide else BLOCK_DIM


@per_real("max_hits", "wide", grid_stride=False, fast_math=True, launch_bounds=_launch_bounds)
def collect(first: int, surfels: Surfels, lists: TileLists, view: View, hits: Hits):
    thread = first + wp.tid()
    xy, inside, d = pixel_of(thread, view)
    middle, half = block_of(xy, view)
    # Threads outside the image cull along: all lanes of a warp must reach the votes together. They hit nothing, as
    # pixels whose walk has ended: their transmittance is too low.
    transmittance = wp.where(inside, ONE, ZERO)
    color = vec3()
    more = mat44()
    ids, weights = empty_buffer()
    overflow = overflowed(lists)
    bounds = walk(tile_of(thread), lists, overflow)
    stop = int(bounds[0])
    for batch in range(bounds[0], bounds[1], warp_size()):
        if any_in_warp(wp.where(transmittance >= TRANSMITTANCE_MIN, 1, 0)) == 0:
            break
        count, mine = stage(batch, bounds[1], surfels, lists, overflow, middle, half)
        for slot in range(count):
            i, k = staged_name(slot, mine, batch)
            a, b, n, c = staged_record(slot, surfels.records, i)
            u, v, depth = hit(a, b, n, c[3], d)
            alpha = alpha_if_near(u, v, surfels.limits[i], a[3], b[3], n[3])
            if alpha >= ALPHA_MIN and depth > view.near and transmittance >= TRANSMITTANCE_MIN:
                weight = alpha * transmittance
                transmittance = transmittance * (ONE - alpha)
                stop = k + 1
                if wp.static(max_hits > 0):
                    if weight > weights[wp.static(max_hits - 1)]:
                        # Insert the hit before the first lighter one, and move that and all behind it down by one,
                        # so that of equal ones the nearer stays; what falls out is blended as plain. As a function
                        # of the buffer it would take 15 registers more for K = 4 (sm_90).
                        displaced = bool(False)
                        for j in range(wp.static(max_hits)):
                            w_ = weights[j]
                            i_ = ids[j]
                            displaced = displaced or weight > w_
                            weights[j] = wp.where(displaced, weight, w_)
                            ids[j] = wp.where(displaced, i, i_)
                            weight = wp.where(displaced, w_, weight)
                            i = wp.where(displaced, i_, i)
                        # Its colour is read again: colours in the buffer would cost registers and moves. Out of an
                        # empty slot comes the weight 0.
                        c = record_row(surfels.records, wp.max(i, 0), 3)
                color += vec3(c[0], c[1], c[2]) * weight
                if wp.static(wide):
                    more += load_channels(surfels.channels, wp.max(i, 0)) * weight
    if not inside:
        return
    p = xy[1] * view.size[0] + xy[0]
    hits.base[p] = write_buffer(surfels, hits, p, ids, weights, d)
    hits.plain[p] = color
    hits.alphas[p] = ONE - transmittance
    hits.stops[p] = stop
    store_channels(hits, p, more)
