"""Collection pass, forward (paper Sec. 4.2): walk a tile's list near to far, blend, keep the K heaviest hits.

A thread is a pixel (see `walk`). Read: records, centres and limits of the surfels, and the tiles' lists. Written:

    plain    N = sum over the hits outside the buffer of weight * plain colour (paper Eq. 6)
    base     the same sum over the hits in the buffer: what they would look like without a texture
    ids, depths, weights    the K heaviest hits, heaviest first; on a tie the nearer one stays
    alphas   1 - final transmittance
    stops    end of the part of the walk that was taken

A hit counts where alpha >= 1/255 and its depth lies beyond `near`; the walk ends behind the hit that takes the
transmittance below 1e-4. `collect_backward` differentiates all outputs but ids and stops with respect to records and,
with the low-pass, centres. Frozen there: the lists, which hits count, which are in the buffer, where the walk ends.
"""

import functools

import warp as wp

from nexwarp.kernels.surfel import hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import BLOCK_DIM, buffer_types, overflowed, walk, walk_functions
from nexwarp.native.vector_loads import record_row_function
from nexwarp.native.warp import any_in_warp, lane_index, warp_size


@functools.cache
def collect_kernel(real: type, max_hits: int, low_pass: bool, tile_size: int) -> wp.Kernel:
    """Make the forward kernel."""
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    h = hit_functions(real, low_pass)
    load = record_row_function(real)
    vec, ivec, _ = buffer_types(real, max_hits)
    w = walk_functions(real, low_pass, tile_size)
    pixels = w.pixels
    ALPHA_MIN, TRANSMITTANCE_MIN, ONE = t.ALPHA_MIN, t.TRANSMITTANCE_MIN, t.ONE

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32},
        # As many blocks at once as 64 registers allow.
        launch_bounds=(BLOCK_DIM, 8) if real is wp.float32 and max_hits <= 2 else BLOCK_DIM,
    )
    def collect(
        first: wp.int32,
        records: wp.array2d(dtype=vec4),
        centers: wp.array(dtype=vec3),
        limits: wp.array(dtype=real),
        surfel_ids: wp.array(dtype=wp.int32),
        tile_offsets: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        size: wp.vec2i,
        tile_columns: wp.int32,
        Ks: wp.array(dtype=mat33),
        near: real,
        reaches: wp.array(dtype=vec2),
        # outputs
        plain: wp.array(dtype=vec3),
        base: wp.array(dtype=vec3),
        ids: wp.array2d(dtype=wp.int32),
        depths: wp.array2d(dtype=real),
        weights: wp.array2d(dtype=real),
        alphas: wp.array(dtype=real),
        stops: wp.array(dtype=wp.int32),
    ):
        thread = first + wp.tid()
        xy, inside, d, intrinsics = w.pixel_of(thread, tile_columns, size, Ks)
        middle, half = w.block_of(xy, intrinsics)
        focal = vec2(intrinsics[0], intrinsics[1])
        # Threads outside the image cull along: all lanes of a warp must reach the votes together. They hit nothing, as
        # pixels whose walk has ended: their transmittance is too low.
        transmittance = real(1.0)
        if not inside:
            transmittance = real(0.0)
        color = vec3()
        buffer_ids = ivec()
        buffer_weights = vec()
        for j in range(wp.static(max_hits)):
            buffer_ids[j] = -1
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(thread // pixels, tile_offsets, ends, overflow)
        stop = int(bounds[0])
        width = warp_size()
        lane = lane_index()
        for batch in range(bounds[0], bounds[1], width):
            if any_in_warp(wp.where(transmittance >= TRANSMITTANCE_MIN, 1, 0)) == 0:
                break
            batch_size = w.stage(
                batch + lane,
                bounds[1],
                surfel_ids,
                order,
                overflow,
                records,
                centers,
                limits,
                reaches,
                middle,
                half,
                focal,
            )
            for k in range(batch_size[0]):
                name = w.staged(k, batch_size[1], batch)
                i = name[0]
                ra = w.staged_row(k, 0, records, i)
                rb = w.staged_row(k, 1, records, i)
                rn = w.staged_row(k, 2, records, i)
                rc = w.staged_row(k, 3, records, i)
                u, v, depth = h.plane(ra, rb, rn, rc[3], d[0], d[1])
                alpha = real(0.0)
                # On a GPU some lane nearly always needs the exponentials.
                if width > 1 or not h.far_outside(u, v, limits[i]):
                    center = vec3()
                    if wp.static(low_pass):
                        center = centers[i]
                    alpha, depth = h.kernel(u, v, depth, ra, rb, rn, center, d[0], d[1], focal, near)
                if alpha >= ALPHA_MIN and depth > near and transmittance >= TRANSMITTANCE_MIN:
                    weight = alpha * transmittance
                    transmittance = transmittance * (ONE - alpha)
                    stop = name[1] + 1
                    out_id = int(i)
                    out_weight = real(weight)
                    if wp.static(max_hits > 0):
                        if weight > buffer_weights[wp.static(max_hits - 1)]:
                            # Insert into the buffer before the first lighter hit, and move that and all behind it down
                            # by one, so that of equal ones the nearer stays; what falls out is blended as plain.
                            displaced = bool(False)
                            for j in range(wp.static(max_hits)):
                                w_ = buffer_weights[j]
                                i_ = buffer_ids[j]
                                displaced = displaced or out_weight > w_
                                buffer_weights[j] = wp.where(displaced, out_weight, w_)
                                buffer_ids[j] = wp.where(displaced, out_id, i_)
                                out_weight = wp.where(displaced, w_, out_weight)
                                out_id = wp.where(displaced, i_, out_id)
                            # Its colour is read again: colours in the buffer would cost registers and moves. Out of an
                            # empty slot comes the weight 0.
                            rc = load(records, wp.max(out_id, 0), 3)
                    color += vec3(rc[0], rc[1], rc[2]) * out_weight
        if not inside:
            return
        p = xy[1] * size[0] + xy[0]
        plain[p] = color
        kept = vec3()
        for j in range(wp.static(max_hits)):
            i = buffer_ids[j]
            depth = real(0.0)
            if i >= 0:
                ra = load(records, i, 0)
                rb = load(records, i, 1)
                rn = load(records, i, 2)
                rc = load(records, i, 3)
                kept += vec3(rc[0], rc[1], rc[2]) * buffer_weights[j]
                u, v, depth = h.plane(ra, rb, rn, rc[3], d[0], d[1])
                if wp.static(low_pass):
                    _alpha, depth = h.kernel(u, v, depth, ra, rb, rn, centers[i], d[0], d[1], focal, near)
            ids[p, j] = i
            depths[p, j] = depth
            weights[p, j] = buffer_weights[j]
        base[p] = kept
        alphas[p] = ONE - transmittance
        stops[p] = stop

    return collect
