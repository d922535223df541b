"""Blended error of each surfel, for densification (paper Sec. 4.3).

A thread is a pixel (see `walk`). It takes the walk that `collect` took, as far as `stops` says. Read: what `collect`
read, and the error of each pixel. Added to:

    sums    sum over pixels of weight * error, by gradient slot or by surfel, as `collect_backward` adds gradients

Nothing is differentiable. `collect_backward` adds up the same on its way, at hardly any cost.
"""

import functools

import warp as wp

from nexwarp.kernels.surfel import hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import overflowed, surfel_at, walk, walk_functions
from nexwarp.native.fixed_point import fixed_point_add
from nexwarp.native.vector_loads import record_row_function
from nexwarp.native.warp import any_in_warp, lane_index, warp_sum


@functools.cache
def splat_error_kernel(real: type, low_pass: bool, tile_size: int, fixed_point: bool = False) -> wp.Kernel:
    """Make the kernel; with `fixed_point` the sums are pairs of integers, as those of `collect_backward_kernel`."""
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    h = hit_functions(real, low_pass)
    load = record_row_function(real)
    w = walk_functions(real, low_pass, tile_size)
    pixels = w.pixels
    sum1, put1 = warp_sum(real), fixed_point_add(real)
    slots = wp.array2d(dtype=wp.int64) if fixed_point else wp.array(dtype=real)
    ALPHA_MIN, ONE, ZERO = t.ALPHA_MIN, t.ONE, t.ZERO

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32},
    )
    def splat_error(
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
        gradient_slots: wp.array(dtype=wp.int32),
        stops: wp.array(dtype=wp.int32),
        errors: wp.array(dtype=real),
        # outputs
        sums: slots,
        bad: wp.array(dtype=wp.int32),
    ):
        thread = first + wp.tid()
        xy, inside, d, intrinsics = w.pixel_of(thread, tile_columns, size, Ks)
        focal = vec2(intrinsics[0], intrinsics[1])
        # Threads outside the image walk along without a hit: all lanes of a warp must reach the sums together.
        p = wp.min(xy[1], size[1] - 1) * size[0] + wp.min(xy[0], size[0] - 1)
        stop = stops[p]
        if not inside:
            stop = int(0)
        error = errors[p]
        transmittance = real(1.0)
        lane = lane_index()
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(thread // pixels, tile_offsets, ends, overflow)
        for k in range(bounds[0], bounds[1]):
            live = int(0)
            if k < stop:
                live = 1
            if any_in_warp(live) == 0:
                break
            i = surfel_at(k, surfel_ids, order, overflow)
            ra = load(records, i, 0)
            rb = load(records, i, 1)
            rn = load(records, i, 2)
            rc = load(records, i, 3)
            center = vec3()
            if wp.static(low_pass):
                center = centers[i]
            u, v, depth = h.plane(ra, rb, rn, rc[3], d[0], d[1])
            alpha = real(0.0)
            if live == 1 and not h.far_outside(u, v, limits[i]):
                alpha, depth = h.kernel(u, v, depth, ra, rb, rn, center, d[0], d[1], focal, near)
            if not (alpha >= ALPHA_MIN and depth > near):
                alpha = ZERO
            share = alpha * transmittance * error
            transmittance = transmittance * (ONE - alpha)
            counts = int(0)
            if share > ZERO:
                counts = 1
            if any_in_warp(counts) == 0:
                continue
            share = sum1(share)
            if lane == 0:
                slot = int(i)
                if k < gradient_slots.shape[0]:
                    slot = gradient_slots[k]
                if wp.static(fixed_point):
                    put1(sums, slot, share, bad)
                if wp.static(not fixed_point):
                    wp.atomic_add(sums, slot, share)

    return splat_error
