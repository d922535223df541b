"""Backward pass of the collection pass."""

import functools

import warp as wp

from nexwarp.kernels.native.fixed_point import fixed_add, fixed_record_sum
from nexwarp.kernels.native.vector_loads import load_function
from nexwarp.kernels.native.warp import (
    any_lane,
    ballot,
    first_lane,
    from_lane,
    lane,
    lane_max,
    lane_sum,
    lanes,
    record_sum,
)
from nexwarp.kernels.surfel import frame_functions, hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import buffer_types, overflowed, surfel_at, view_functions, walk


@functools.cache
def collect_backward_kernel(
    real: type, max_hits: int, low_pass: bool, tile_size: int, watch: bool = False, fixed: bool = False
) -> wp.Kernel:
    """Make the backward kernel; with `watch` it also adds up weight * error a row, as `splat_error` does alone.

    With `fixed` the sums are pairs of integers, see `kernels.fixed`, and so do not depend on any order.
    """
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    intrinsics_of = frame_functions(real).intrinsics_of
    h = hit_functions(real, low_pass)
    load = load_function(4, real)
    hit_dot = h.hit_dot
    vec, ivec, _ = buffer_types(real, max_hits)
    view = view_functions(real, tile_size)
    pixels = view.pixels
    sum1, sum3, add_record = lane_sum(real), lane_sum(vec3), record_sum(real)
    put_record, put3, put1 = fixed_record_sum(real), fixed_add(vec3), fixed_add(real)
    pairs = wp.array2d(dtype=wp.int64)
    rows_of_records = pairs if fixed else wp.array2d(dtype=vec4)
    rows_of_centers = pairs if fixed else wp.array(dtype=vec3)
    rows_of_errors = pairs if fixed else wp.array(dtype=real)
    ALPHA_MIN, ONE, ZERO = t.ALPHA_MIN, t.ONE, t.ZERO

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32},
    )
    def collect_backward(
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
        rows: wp.array(dtype=wp.int32),
        plain: wp.array(dtype=vec3),
        base: wp.array(dtype=vec3),
        ids: wp.array2d(dtype=wp.int32),
        weights: wp.array2d(dtype=real),
        alphas: wp.array(dtype=real),
        stops: wp.array(dtype=wp.int32),
        grad_plain: wp.array(dtype=vec3),
        grad_base: wp.array(dtype=vec3),
        grad_depths: wp.array2d(dtype=real),
        grad_weights: wp.array2d(dtype=real),
        grad_alphas: wp.array(dtype=real),
        errors: wp.array(dtype=real),
        # outputs
        grad_records: rows_of_records,
        grad_centers: rows_of_centers,
        error_sums: rows_of_errors,
        bad: wp.array(dtype=wp.int32),
    ):
        thread = first + wp.tid()
        tile = thread // pixels
        xy = view.pixel_of(thread, tile_columns)
        # Lanes outside the image walk along with nothing to give: all lanes of a warp must reach the sums together.
        p = wp.min(xy[1], size[1] - 1) * size[0] + wp.min(xy[0], size[0] - 1)
        stop = stops[p]
        if xy[0] >= size[0] or xy[1] >= size[1]:
            stop = int(0)
        intrinsics = intrinsics_of(Ks)
        focal = vec2(intrinsics[0], intrinsics[1])
        d = view.ray_of(xy, intrinsics)
        middle = view.block_of(xy, intrinsics)
        half = view.half_block(intrinsics)
        gn = grad_plain[p]
        gb = grad_base[p]
        ga = grad_alphas[p]
        rest = wp.dot(gn, plain[p]) + wp.dot(gb, base[p]) + ga * alphas[p]
        gw = vec()
        gd = vec()
        slots = ivec()
        for j in range(wp.static(max_hits)):
            slots[j] = ids[p, j]
            gw[j] = grad_weights[p, j]
            gd[j] = grad_depths[p, j]
            rest += gw[j] * weights[p, j]
        error = real(0.0)
        if wp.static(watch):
            error = errors[p]
        transmittance = real(1.0)
        me = lane()
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(tile, tile_offsets, ends, overflow)
        width = lanes()
        last = wp.min(lane_max(stop), bounds[1])
        for batch in range(bounds[0], last, width):
            mine = int(-1)
            if batch + me < last:
                mine = surfel_at(batch + me, surfel_ids, order, overflow)
                if width > 1:
                    center = vec3()
                    if wp.static(low_pass):
                        center = centers[mine]
                    m = load(records, mine, 3)[3]
                    if h.misses_block(
                        load(records, mine, 0),
                        load(records, mine, 1),
                        load(records, mine, 2),
                        m,
                        reaches[mine],
                        limits[mine],
                        center,
                        middle,
                        half,
                        focal,
                    ):
                        mine = int(-1)
            left = ballot(wp.where(mine >= 0, 1, 0))
            while left != 0:
                next_lane = first_lane(left)
                left = left & (left - 1)
                i = from_lane(mine, next_lane)
                k = batch + next_lane
                ra = load(records, i, 0)
                rb = load(records, i, 1)
                rn = load(records, i, 2)
                rc = load(records, i, 3)
                center = vec3()
                if wp.static(low_pass):
                    center = centers[i]
                u, v, depth = h.plane(ra, rb, rn, rc[3], d[0], d[1])
                alpha = real(0.0)
                # Straight on, so that the compiler can use the exponentials again for the derivative.
                if width > 1 or not h.far_outside(u, v, limits[i]):
                    alpha, depth = h.kernel(u, v, depth, ra, rb, rn, center, d[0], d[1], focal, near)
                if not (k < stop and alpha >= ALPHA_MIN and depth > near):
                    alpha = ZERO
                if any_lane(wp.where(alpha > ZERO, 1, 0)) != 0:
                    g0 = vec4()
                    g1 = vec4()
                    g2 = vec4()
                    g3 = vec4()
                    gc = vec3()
                    share = real(0.0)
                    if alpha > ZERO:
                        weight = alpha * transmittance
                        share = weight * error
                        q = ga
                        gt = real(0.0)
                        g = gn
                        for j in range(wp.static(max_hits)):
                            if i == slots[j]:
                                q += gw[j]
                                gt = gd[j]
                                g = gb
                        q += g[0] * rc[0] + g[1] * rc[1] + g[2] * rc[2]
                        g3 = vec4(g[0] * weight, g[1] * weight, g[2] * weight, ZERO)
                        rest -= q * weight
                        grad_alpha = transmittance * q - rest / (ONE - alpha)
                        transmittance = transmittance * (ONE - alpha)
                        g0, g1, g2, gm, gc, _x, _y, _f, _n, _a, _t = wp.grad(hit_dot)(
                            ra, rb, rn, rc[3], center, d[0], d[1], focal, near, grad_alpha, gt
                        )
                        g3[3] = gm
                    row = int(i)
                    if k < rows.shape[0]:
                        row = rows[k]
                    if wp.static(fixed):
                        put_record(grad_records, row, g0, g1, g2, g3, bad)
                    else:
                        add_record(grad_records, row, g0, g1, g2, g3)
                    if wp.static(low_pass):
                        gc = sum3(gc)
                    if wp.static(watch):
                        share = sum1(share)
                    if me == 0:
                        if wp.static(watch and fixed):
                            put1(error_sums, row, share, bad)
                        if wp.static(watch and not fixed):
                            wp.atomic_add(error_sums, row, share)
                        if wp.static(low_pass and fixed):
                            put3(grad_centers, row, gc, bad)
                        if wp.static(low_pass and not fixed):
                            wp.atomic_add(grad_centers, row, gc)

    return collect_backward
