"""The derivative of `surface`, front to back in one pass, as `collect_backward` is that of `collect`.

A thread is a pixel (see `walk`). Read: what `surface` read and wrote, and the gradients of its five outputs. Added to:

    grad_records, grad_centers    gradients of the surfels' records and, with the low-pass, centres

in the slots of `collect_backward`. With q_i = dL/dw_i, E the expected depth, W the sum of weights, N the blended
normal, S the distortion and s_i the sign of A_i t_i - D_i, the terms of a hit are

    q_i       gE (t_i - E) / W + gN . n_i + gS (|A_i t_i - D_i| + sum over j > i of w_j s_j (t_j - t_i))
    dL/dt_i   gE w_i / W + gS w_i (s_i A_i - sum over j > i of w_j s_j), and the gradients of the median and of the top
              depth where the hit is the one that they are taken from
    dL/dn_i   gN w_i

and sum of q_i w_i = gN . N + 2 gS S starts the recurrence that gives dL/dalpha_i, see `collect_backward`. The sums over
j > i are the totals that `surface` wrote, less what the walk has passed. Frozen: what is frozen for `collect_backward`,
which hits the median and the top depth are taken from, the sides of the normals, and the s_i.
"""

import functools

import warp as wp

from nexwarp.kernels.surfel import hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import overflowed, walk, walk_functions
from nexwarp.native.fixed_point import fixed_point_add, fixed_point_record_sum
from nexwarp.native.vector_loads import record_row_function
from nexwarp.native.warp import (
    any_in_warp,
    ballot,
    from_lane,
    lane_index,
    lowest_lane,
    warp_max,
    warp_record_sum,
    warp_size,
    warp_sum,
)


@functools.cache
def surface_backward_kernel(real: type, low_pass: bool, tile_size: int, fixed_point: bool = False) -> wp.Kernel:
    """Make the kernel.

    Args:
        real: scalar type.
        low_pass: as in `surface`.
        tile_size: pixels along a tile's side.
        fixed_point: add up pairs of integers, see `native.fixed_point`, so that sums do not depend on any order.
    """
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    h = hit_functions(real, low_pass)
    load = record_row_function(real)
    w = walk_functions(real, low_pass, tile_size)
    pixels = w.pixels
    sum3, add_record = warp_sum(vec3), warp_record_sum(real)
    put_record, put3 = fixed_point_record_sum(real), fixed_point_add(vec3)
    pairs = wp.array2d(dtype=wp.int64)
    record_slots = pairs if fixed_point else wp.array2d(dtype=vec4)
    center_slots = pairs if fixed_point else wp.array(dtype=vec3)
    ALPHA_MIN, ONE, TWO, ZERO = t.ALPHA_MIN, t.ONE, t.TWO, t.ZERO

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32},
    )
    def surface_backward(
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
        stops: wp.array(dtype=wp.int32),
        gradient_slots: wp.array(dtype=wp.int32),
        expected: wp.array(dtype=real),
        normals: wp.array(dtype=vec3),
        distortion: wp.array(dtype=real),
        totals: wp.array(dtype=vec3),
        picks: wp.array(dtype=wp.vec2i),
        grad_expected: wp.array(dtype=real),
        grad_median: wp.array(dtype=real),
        grad_top: wp.array(dtype=real),
        grad_normals: wp.array(dtype=vec3),
        grad_distortion: wp.array(dtype=real),
        # outputs
        grad_records: record_slots,
        grad_centers: center_slots,
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
        gn = grad_normals[p]
        gs = grad_distortion[p]
        # What is left of the sums over the hits behind.
        rest = wp.dot(gn, normals[p]) + TWO * gs * distortion[p]
        signs = totals[p][1]
        signed_depths = totals[p][2]
        mean = expected[p]
        ge = real(0.0)
        if totals[p][0] > ZERO:
            ge = grad_expected[p] / totals[p][0]
        start = real(0.0)
        weights = real(0.0)
        shifted = real(0.0)
        transmittance = real(1.0)
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(thread // pixels, tile_offsets, ends, overflow)
        width = warp_size()
        lane = lane_index()
        last = wp.min(warp_max(stop), bounds[1])
        for batch in range(bounds[0], last, width):
            mine = w.candidate(
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
            left = ballot(wp.where(mine >= 0, 1, 0))
            while left != 0:
                source = lowest_lane(left)
                left = left & (left - 1)
                i = from_lane(mine, source)
                k = batch + source
                ra = load(records, i, 0)
                rb = load(records, i, 1)
                rn = load(records, i, 2)
                rc = load(records, i, 3)
                center = vec3()
                if wp.static(low_pass):
                    center = centers[i]
                u, v, plane_depth = h.plane(ra, rb, rn, rc[3], d[0], d[1])
                depth = plane_depth
                alpha = real(0.0)
                if not h.far_outside(u, v, limits[i]):
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
                    gr = vec3()
                    if alpha > ZERO:
                        weight = alpha * transmittance
                        n = vec3(rn[0], rn[1], rn[2])
                        facing = ONE
                        if n[0] * d[0] + n[1] * d[1] + n[2] > ZERO:
                            facing = -ONE
                        gr = gn * (facing * weight)
                        if weights == ZERO:
                            start = depth
                        z = depth - start
                        gap = weights * z - shifted
                        side = wp.sign(gap)
                        if gap == ZERO:
                            side = ZERO
                        signs -= side * weight
                        signed_depths -= side * weight * z
                        q = (
                            ge * (depth - mean)
                            + facing * wp.dot(gn, n)
                            + gs * (wp.abs(gap) + signed_depths - z * signs)
                        )
                        grad_depth = ge * weight + gs * weight * (side * weights - signs)
                        if k == picks[p][0]:
                            grad_depth += grad_median[p]
                        if k == picks[p][1]:
                            grad_depth += grad_top[p]
                        weights += weight
                        shifted += weight * z
                        rest -= q * weight
                        grad_alpha = transmittance * q - rest / (ONE - alpha)
                        gu, gv, gt, gm, go, g1, g2, gx, gy, gz = h.hit_gradients(
                            u, v, plane_depth, ra, rb, rn, center, d[0], d[1], focal, near, grad_alpha, grad_depth
                        )
                        if wp.static(low_pass):
                            gc = h.center_gradient(center, focal, gx, gy, gz)
                    transmittance = transmittance * (ONE - alpha)
                    r0 = vec4(gu * d[0], gu * d[1], gu, go)
                    r1 = vec4(gv * d[0], gv * d[1], gv, g1)
                    r2 = vec4(gt * d[0] + gr[0], gt * d[1] + gr[1], gt + gr[2], g2)
                    r3 = vec4(ZERO, ZERO, ZERO, gm)
                    slot = int(i)
                    if k < gradient_slots.shape[0]:
                        slot = gradient_slots[k]
                    if wp.static(fixed_point):
                        put_record(grad_records, slot, r0, r1, r2, r3, bad)
                    else:
                        add_record(grad_records, slot, r0, r1, r2, r3)
                    if wp.static(low_pass):
                        gc = sum3(gc)
                        if lane == 0:
                            if wp.static(fixed_point):
                                put3(grad_centers, slot, gc, bad)
                            else:
                                wp.atomic_add(grad_centers, slot, gc)

    return surface_backward
