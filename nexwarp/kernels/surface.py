"""Depths and normals over all hits that `collect` blended, not only the K heaviest (not in the paper).

A thread is a pixel (see `walk`). It takes the walk that `collect` took, as far as `stops` says. Read: what `collect`
read. Written, with w = alpha * transmittance the weight (paper Sec. 4.2), t the z-depth and n the normal of a hit:

    expected    sum of w t / sum of w
    median      t of the hit that takes the transmittance to 1/2 or below; of the last hit where it stays above
    top         t of the heaviest hit, on a tie of the nearer one
    normals     sum of w n, camera frame, each n on the side that faces the camera; not normalised

All are 0 where nothing is hit. `surface_backward` differentiates all four. It needs `totals`, the sum of w, and
`picks`, the places in the list of the hits of the median and the top depth, -1 where nothing is hit; both may be left
out.

`surface_backward` is the derivative, front to back in one pass, as `collect_backward` is that of `collect`. It adds
gradients to the surfels' records, in the slots of `collect_backward`. With q_i = dL/dw_i, E the expected depth, W the
sum of weights and N the blended normal, the terms of a hit are

    q_i       gE (t_i - E) / W + gN . n_i
    dL/dt_i   gE w_i / W, and the gradients of the median and of the top depth where the hit is the one that they are
              taken from
    dL/dn_i   gN w_i

and sum of q_i w_i = gN . N starts the recurrence that gives dL/dalpha_i, see `collect_backward`. Frozen: what is frozen
for `collect_backward`, which hits the median and the top depth are taken from, and the sides of the normals.
"""

from __future__ import annotations

import warp as wp

from nexwarp.kernels.collect import alpha_if_near
from nexwarp.kernels.collect_backward import add
from nexwarp.kernels.surfel import facing_side, hit, hit_gradients, record_gradients
from nexwarp.kernels.types import FixedSums, TileLists, ints, per_real
from nexwarp.kernels.walk import block_of, overflowed, pixel_of, stage, tile_of, walk
from nexwarp.native.staging import BLOCK_DIM, staged_name, staged_record
from nexwarp.native.warp import any_in_warp, warp_max, warp_size


@per_real(grid_stride=False, fast_math=True, launch_bounds=BLOCK_DIM)
def surface(first: int, surfels: Surfels, lists: TileLists, view: View, stops: ints, surface: Surface):
    thread = first + wp.tid()
    xy, inside, d = pixel_of(thread, view)
    middle, half = block_of(xy, view)
    stop = int(0)
    if inside:
        stop = stops[xy[1] * view.size[0] + xy[0]]
    transmittance = real(1.0)
    total = real(0.0)
    depths = real(0.0)
    median_depth = real(0.0)
    heaviest = real(0.0)
    top_depth = real(0.0)
    normals = vec3()
    pick = wp.vec2i(-1, -1)
    overflow = overflowed(lists)
    bounds = walk(tile_of(thread), lists, overflow)
    last = wp.min(warp_max(stop), bounds[1])
    for batch in range(bounds[0], last, warp_size()):
        count, mine = stage(batch, last, surfels, lists, overflow, middle, half)
        for slot in range(count):
            i, k = staged_name(slot, mine, batch)
            if k < stop:
                a, b, n, c = staged_record(slot, surfels.records, i)
                u, v, depth = hit(a, b, n, c[3], d)
                alpha = alpha_if_near(u, v, surfels.limits[i], a[3], b[3], n[3])
                if alpha >= ALPHA_MIN and depth > view.near:
                    weight = alpha * transmittance
                    if transmittance > HALF:
                        median_depth = depth
                        pick[0] = k
                    if weight > heaviest:
                        heaviest = weight
                        top_depth = depth
                        pick[1] = k
                    normals += vec3(n[0], n[1], n[2]) * (facing_side(n, d) * weight)
                    total += weight
                    depths += weight * depth
                    transmittance = transmittance * (ONE - alpha)
    if not inside:
        return
    if total > ZERO:
        depths = depths / total
    p = xy[1] * view.size[0] + xy[0]
    surface.expected[p] = depths
    surface.median[p] = median_depth
    surface.top[p] = top_depth
    surface.normals[p] = normals
    if surface.picks:
        surface.totals[p] = total
        surface.picks[p] = pick


@per_real("fixed_point", "by_place", grid_stride=False, fast_math=True, launch_bounds=BLOCK_DIM)
def surface_backward(
    first: int,
    surfels: Surfels,
    lists: TileLists,
    view: View,
    stops: ints,
    surface: Surface,
    grads: Surface,
    sums: FixedSums if fixed_point else Sums,
):
    thread = first + wp.tid()
    xy, inside, d = pixel_of(thread, view)
    middle, half = block_of(xy, view)
    # Threads outside the image walk along without a hit: all lanes of a warp must reach the sums together.
    p = wp.min(xy[1], view.size[1] - 1) * view.size[0] + wp.min(xy[0], view.size[0] - 1)
    stop = stops[p]
    if not inside:
        stop = int(0)
    grad_normals = grads.normals[p]
    # What is left of the sum over the hits behind.
    rest = wp.dot(grad_normals, surface.normals[p])
    mean = surface.expected[p]
    grad_mean = real(0.0)
    if surface.totals[p] > ZERO:
        grad_mean = grads.expected[p] / surface.totals[p]
    transmittance = real(1.0)
    overflow = overflowed(lists)
    bounds = walk(tile_of(thread), lists, overflow)
    last = wp.min(warp_max(stop), bounds[1])
    for batch in range(bounds[0], last, warp_size()):
        count, mine = stage(batch, last, surfels, lists, overflow, middle, half)
        for slot in range(count):
            i, k = staged_name(slot, mine, batch)
            a, b, n, c = staged_record(slot, surfels.records, i)
            u, v, depth = hit(a, b, n, c[3], d)
            alpha = alpha_if_near(u, v, surfels.limits[i], a[3], b[3], n[3])
            if not (k < stop and alpha >= ALPHA_MIN and depth > view.near):
                alpha = ZERO
            if any_in_warp(wp.where(alpha > ZERO, 1, 0)) != 0:
                grad = vec7()
                grad_normal = vec3()
                if alpha > ZERO:
                    weight = alpha * transmittance
                    normal = vec3(n[0], n[1], n[2])
                    facing = facing_side(n, d)
                    grad_normal = grad_normals * (facing * weight)
                    q = grad_mean * (depth - mean) + facing * wp.dot(grad_normals, normal)
                    grad_depth = grad_mean * weight
                    if k == surface.picks[p][0]:
                        grad_depth += grads.median[p]
                    if k == surface.picks[p][1]:
                        grad_depth += grads.top[p]
                    rest -= q * weight
                    grad_alpha = transmittance * q - rest / (ONE - alpha)
                    grad = hit_gradients(a, b, n, c[3], d, grad_alpha, grad_depth)
                transmittance = transmittance * (ONE - alpha)
                row_a, row_b, row_n = record_gradients(grad, d)
                row_n += vec4(grad_normal[0], grad_normal[1], grad_normal[2], ZERO)
                row_c = vec4(ZERO, ZERO, ZERO, grad[3])
                add(sums, i, k, row_a, row_b, row_n, row_c)
