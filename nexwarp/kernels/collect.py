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

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from nexwarp.kernels.shape import alpha_at, far_outside
from nexwarp.kernels.surfel import hit
from nexwarp.kernels.types import TileLists, types
from nexwarp.kernels.walk import block_of, overflowed, pixel_of, stage, tile_of, walk
from nexwarp.native.staging import BLOCK_DIM, staged_name, staged_record
from nexwarp.native.vector_loads import load_record, record_row
from nexwarp.native.warp import any_in_warp, lane_index, warp_size


@functools.cache
def hit_buffer(real: type, max_hits: int) -> SimpleNamespace:
    """Make the types `reals` and `integers` of the K-buffer, registers of static length, and its functions."""
    slots = max(max_hits, 1)  # one unused slot for K = 0
    reals = wp.types.vector(length=slots, dtype=real)
    integers = wp.types.vector(length=slots, dtype=wp.int32)
    t = types(real)

    @wp.func
    def empty():
        """(ids, weights) of an empty buffer."""
        ids = integers()
        for j in range(wp.static(max_hits)):
            ids[j] = -1
        return ids, reals()

    @wp.func
    def write(surfels: t.Surfels, hits: t.Hits, p: int, ids: integers, weights: reals, d: t.vec2):
        """Write the buffer of pixel p, whose ray is d; return the blended colour of its hits."""
        base = t.vec3()
        for j in range(wp.static(max_hits)):
            i = ids[j]
            depth = real(0.0)
            if i >= 0:
                a, b, n, c = load_record(surfels.records, i)
                base += t.vec3(c[0], c[1], c[2]) * weights[j]
                _u, _v, depth = hit(a, b, n, c[3], d)
            hits.ids[p, j] = i
            hits.depths[p, j] = depth
            hits.weights[p, j] = weights[j]
        return base

    return SimpleNamespace(reals=reals, integers=integers, empty=empty, write=write)


@functools.cache
def channel_functions(real: type, wide: bool) -> SimpleNamespace:
    """Make the functions of the sixteen more channels of a wide walk, a mat44; others do nothing."""
    t = types(real)
    mat44, Surfels, Hits = t.mat44, t.Surfels, t.Hits

    @wp.func
    def load(rows: wp.array2d(dtype=t.vec4), i: int):
        """Row i of an array of channels."""
        result = mat44()
        if wp.static(wide):
            a, b, c, d = load_record(rows, i)
            result = wp.matrix_from_rows(a, b, c, d)
        return result

    @wp.func
    def blend(surfels: Surfels, i: int, weight: real, total: mat44):
        """Add weight times the channels of surfel i; i = -1 has the weight 0."""
        return total + load(surfels.channels, wp.max(i, 0)) * weight

    @wp.func
    def store(hits: Hits, p: int, total: mat44):
        """Write the channels of pixel p."""
        if wp.static(wide):
            for row in range(4):
                hits.channels[p, row] = total[row]

    @wp.func
    def product(rows: wp.array2d(dtype=t.vec4), i: int, grad: mat44):
        """Inner product of row i and a gradient."""
        result = real(0.0)
        if wp.static(wide):
            result = wp.ddot(load(rows, i), grad)
        return result

    return SimpleNamespace(load=load, blend=blend, store=store, product=product)


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


@functools.cache
def collect_kernel(real: type, max_hits: int, wide: bool = False) -> wp.Kernel:
    """Make the forward kernel; a wide one blends sixteen more channels."""
    t = types(real)
    vec3 = t.vec3
    buffer, channels = hit_buffer(real, max_hits), channel_functions(real, wide)
    ALPHA_MIN, TRANSMITTANCE_MIN, ZERO, ONE = t.ALPHA_MIN, t.TRANSMITTANCE_MIN, t.ZERO, t.ONE

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32},
        launch_bounds=_launch_bounds(real, max_hits, wide),
    )
    def collect(first: int, surfels: t.Surfels, lists: TileLists, view: t.View, hits: t.Hits):
        thread = first + wp.tid()
        xy, inside, d = pixel_of(thread, view)
        middle, half = block_of(xy, view)
        # Threads outside the image cull along: all lanes of a warp must reach the votes together. They hit nothing, as
        # pixels whose walk has ended: their transmittance is too low.
        transmittance = wp.where(inside, ONE, ZERO)
        color = vec3()
        more = t.mat44()
        ids, weights = buffer.empty()
        overflow = overflowed(lists)
        bounds = walk(tile_of(thread), lists, overflow)
        stop = int(bounds[0])
        width = warp_size()
        lane = lane_index()
        for batch in range(bounds[0], bounds[1], width):
            if any_in_warp(wp.where(transmittance >= TRANSMITTANCE_MIN, 1, 0)) == 0:
                break
            staged = stage(batch + lane, bounds[1], surfels, lists, overflow, middle, half)
            for slot in range(staged[0]):
                name = staged_name(slot, staged[1], batch)
                i = name[0]
                a, b, n, c = staged_record(slot, surfels.records, i)
                u, v, depth = hit(a, b, n, c[3], d)
                alpha = alpha_if_near(u, v, surfels.limits[i], a[3], b[3], n[3])
                if alpha >= ALPHA_MIN and depth > view.near and transmittance >= TRANSMITTANCE_MIN:
                    weight = alpha * transmittance
                    transmittance = transmittance * (ONE - alpha)
                    stop = name[1] + 1
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
                        more = channels.blend(surfels, i, weight, more)
        if not inside:
            return
        p = xy[1] * view.size[0] + xy[0]
        hits.base[p] = buffer.write(surfels, hits, p, ids, weights, d)
        hits.plain[p] = color
        hits.alphas[p] = ONE - transmittance
        hits.stops[p] = stop
        channels.store(hits, p, more)

    return collect
