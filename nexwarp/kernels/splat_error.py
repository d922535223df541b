"""Blended error of each surfel, for densification."""

import functools

import warp as wp

from nexwarp.kernels.native.fixed_point import fixed_add
from nexwarp.kernels.native.vector_loads import load_function
from nexwarp.kernels.native.warp import (
    any_lane,
    lane,
    lane_sum,
)
from nexwarp.kernels.surfel import frame_functions, hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import overflowed, surfel_at, view_functions, walk


@functools.cache
def splat_error_kernel(real: type, low_pass: bool, tile_size: int, fixed: bool = False) -> wp.Kernel:
    """Make the kernel that gives each entry the sum over pixels of weight * error (densification, paper Sec. 3.3).

    With `fixed` the sums are pairs of integers, as those of `collect_backward_kernel`.
    """
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    intrinsics_of = frame_functions(real).intrinsics_of
    h = hit_functions(real, low_pass)
    load = load_function(4, real)
    view = view_functions(real, tile_size)
    pixels = view.pixels
    sum1, put1 = lane_sum(real), fixed_add(real)
    rows_of_sums = wp.array2d(dtype=wp.int64) if fixed else wp.array(dtype=real)
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
        rows: wp.array(dtype=wp.int32),
        stops: wp.array(dtype=wp.int32),
        errors: wp.array(dtype=real),
        # outputs
        sums: rows_of_sums,
        bad: wp.array(dtype=wp.int32),
    ):
        thread = first + wp.tid()
        tile = thread // pixels
        xy = view.pixel_of(thread, tile_columns)
        p = wp.min(xy[1], size[1] - 1) * size[0] + wp.min(xy[0], size[0] - 1)
        stop = stops[p]
        if xy[0] >= size[0] or xy[1] >= size[1]:
            stop = int(0)
        intrinsics = intrinsics_of(Ks)
        focal = vec2(intrinsics[0], intrinsics[1])
        d = view.ray_of(xy, intrinsics)
        error = errors[p]
        transmittance = real(1.0)
        me = lane()
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(tile, tile_offsets, ends, overflow)
        for k in range(bounds[0], bounds[1]):
            live = int(0)
            if k < stop:
                live = 1
            if any_lane(live) == 0:
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
            if any_lane(counts) == 0:
                continue
            share = sum1(share)
            if me == 0:
                row = int(i)
                if k < rows.shape[0]:
                    row = rows[k]
                if wp.static(fixed):
                    put1(sums, row, share, bad)
                if wp.static(not fixed):
                    wp.atomic_add(sums, row, share)

    return splat_error
