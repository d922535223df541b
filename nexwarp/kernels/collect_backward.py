"""Collection pass, backward (paper Sec. 4.2): the derivative of `collect`, front to back in one pass.

A thread is a pixel (see `walk`). Read: what `collect` read and wrote, and the gradients of its differentiable outputs.
Added to:

    grad_records, grad_centers    gradients of the surfels' records and, with the low-pass, centres
    error_sums                    with_errors: sum over pixels of weight * error, as `splat_error` gives

With `by_place`, gradients of the walk's place k go to gradient slot gradient_slots[k], which one CPU thread owns and
`reduce` adds up in a fixed order. Without, as on CUDA, they go to the surfel, by atomics after a sum over the warp.

Warp's own adjoint of such a loop is silently wrong, since it does not replay a carried transmittance. The recurrence
is therefore written by hand. With q_i = dL/dw_i,

    dL/dalpha_i = T_i q_i - (sum over j > i of q_j w_j) / (1 - alpha_i),

where the sum over all i is known from the outputs,

    rest = gN . N + gB . B + sum_k gW_k W_k + gA A,

and the walk subtracts its terms one by one. Of each hit, seven derivatives are computed, with respect to a . d, b . d,
n . d and the like (see `hit_gradients`); the record's follow by products with the ray and the weight. Frozen: the
lists, which hits count, which are in the buffer, where the walk ends.
"""

import functools

import warp as wp

from nexwarp.kernels.surfel import hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import BLOCK_DIM, buffer_types, overflowed, walk, walk_functions
from nexwarp.native.fixed_point import fixed_point_add, fixed_point_record_sum
from nexwarp.native.warp import (
    any_in_warp,
    lane_index,
    warp_max,
    warp_record_sum,
    warp_size,
    warp_sum,
)


@functools.cache
def collect_backward_kernel(
    real: type,
    max_hits: int,
    low_pass: bool,
    tile_size: int,
    with_errors: bool = False,
    fixed_point: bool = False,
    by_place: bool = False,
) -> wp.Kernel:
    """Make the backward kernel.

    Args:
        real: scalar type.
        max_hits: K.
        low_pass: as in `collect`.
        tile_size: pixels along a tile's side.
        with_errors: also add up weight * error.
        fixed_point: add up pairs of integers, see `native.fixed_point`, so that sums do not depend on any order.
        by_place: give each place of the walk a slot of its own, `gradient_slots[k]`, instead of one to each surfel.
    """
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    h = hit_functions(real, low_pass)
    vec, ivec, _ = buffer_types(real, max_hits)
    w = walk_functions(real, low_pass, tile_size)
    pixels = w.pixels
    sum1, sum3, add_record = warp_sum(real), warp_sum(vec3), warp_record_sum(real)
    put_record, put3, put1 = fixed_point_record_sum(real), fixed_point_add(vec3), fixed_point_add(real)
    pairs = wp.array2d(dtype=wp.int64)
    record_slots = pairs if fixed_point else wp.array2d(dtype=vec4)
    center_slots = pairs if fixed_point else wp.array(dtype=vec3)
    error_slots = pairs if fixed_point else wp.array(dtype=real)
    ALPHA_MIN, ONE, ZERO = t.ALPHA_MIN, t.ONE, t.ZERO

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32},
        launch_bounds=BLOCK_DIM,
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
        gradient_slots: wp.array(dtype=wp.int32),
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
        grad_records: record_slots,
        grad_centers: center_slots,
        error_sums: error_slots,
        bad: wp.array(dtype=wp.int32),
    ):
        thread = first + wp.tid()
        xy, inside, d, intrinsics = w.pixel_of(thread, tile_columns, size, Ks)
        middle, half = w.block_of(xy, intrinsics)
        focal = vec2(intrinsics[0], intrinsics[1])
        # Threads outside the image walk along without a hit: all lanes of a warp must reach the sums together.
        p = wp.min(xy[1], size[1] - 1) * size[0] + wp.min(xy[0], size[0] - 1)
        stop = stops[p]
        if not inside:
            stop = int(0)
        gn = grad_plain[p]
        gb = grad_base[p]
        ga = grad_alphas[p]
        rest = wp.dot(gn, plain[p]) + wp.dot(gb, base[p]) + ga * alphas[p]
        gw = vec()
        gd = vec()
        buffered_ids = ivec()
        for j in range(wp.static(max_hits)):
            buffered_ids[j] = ids[p, j]
            gw[j] = grad_weights[p, j]
            gd[j] = grad_depths[p, j]
            rest += gw[j] * weights[p, j]
        error = real(0.0)
        if wp.static(with_errors):
            error = errors[p]
        transmittance = real(1.0)
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(thread // pixels, tile_offsets, ends, overflow)
        width = warp_size()
        lane = lane_index()
        last = wp.min(warp_max(stop), bounds[1])
        for batch in range(bounds[0], last, width):
            batch_size = w.stage(
                batch + lane,
                last,
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
            for staged in range(batch_size[0]):
                name = w.staged(staged, batch_size[1], batch)
                i = name[0]
                k = name[1]
                ra = w.staged_row(staged, 0, records, i)
                rb = w.staged_row(staged, 1, records, i)
                rn = w.staged_row(staged, 2, records, i)
                rc = w.staged_row(staged, 3, records, i)
                center = vec3()
                if wp.static(low_pass):
                    center = centers[i]
                u, v, plane_depth = h.plane(ra, rb, rn, rc[3], d[0], d[1])
                depth = plane_depth
                alpha = real(0.0)
                # Straight on, so that the compiler can use the exponentials again for the derivative.
                if width > 1 or not h.far_outside(u, v, limits[i]):
                    alpha, depth = h.kernel(u, v, plane_depth, ra, rb, rn, center, d[0], d[1], focal, near)
                if not (k < stop and alpha >= ALPHA_MIN and depth > near):
                    alpha = ZERO
                if any_in_warp(wp.where(alpha > ZERO, 1, 0)) != 0:
                    gu = real(0.0)
                    gv = real(0.0)
                    gt = real(0.0)
                    gm = real(0.0)
                    go = real(0.0)
                    g1 = real(0.0)
                    g2 = real(0.0)
                    gc = vec3()
                    weight = alpha * transmittance
                    g = gn
                    if alpha > ZERO:
                        q = ga
                        for j in range(wp.static(max_hits)):
                            if i == buffered_ids[j]:
                                q += gw[j]
                                gt = gd[j]
                                g = gb
                        q += g[0] * rc[0] + g[1] * rc[1] + g[2] * rc[2]
                        rest -= q * weight
                        grad_alpha = transmittance * q - rest / (ONE - alpha)
                        gu, gv, gt, gm, go, g1, g2, gx, gy, gz = h.hit_gradients(
                            u, v, plane_depth, ra, rb, rn, center, d[0], d[1], focal, near, grad_alpha, gt
                        )
                        if wp.static(low_pass):
                            gc = h.center_gradient(center, focal, gx, gy, gz)
                    transmittance = transmittance * (ONE - alpha)
                    share = weight * error
                    r0 = vec4(gu * d[0], gu * d[1], gu, go)
                    r1 = vec4(gv * d[0], gv * d[1], gv, g1)
                    r2 = vec4(gt * d[0], gt * d[1], gt, g2)
                    r3 = vec4(g[0] * weight, g[1] * weight, g[2] * weight, gm)
                    slot = int(i)
                    if wp.static(by_place):
                        slot = gradient_slots[k]
                    if wp.static(fixed_point):
                        put_record(grad_records, slot, r0, r1, r2, r3, bad)
                    else:
                        add_record(grad_records, slot, r0, r1, r2, r3)
                    if wp.static(low_pass):
                        gc = sum3(gc)
                    if wp.static(with_errors):
                        share = sum1(share)
                    if lane == 0:
                        if wp.static(with_errors and fixed_point):
                            put1(error_sums, slot, share, bad)
                        if wp.static(with_errors and not fixed_point):
                            wp.atomic_add(error_sums, slot, share)
                        if wp.static(low_pass and fixed_point):
                            put3(grad_centers, slot, gc, bad)
                        if wp.static(low_pass and not fixed_point):
                            wp.atomic_add(grad_centers, slot, gc)

    return collect_backward
