"""Collection pass, backward (paper Sec. 4.2): the derivative of `collect`, front to back in one pass.

A thread is a pixel (see `walk`). Read: what `collect` read and wrote, and the gradients of its differentiable outputs.
Added to:

    records    gradients of the surfels' records
    channels   wide: gradients of their sixteen more channels
    errors     with_errors: sum over pixels of weight * error, for densification (paper Sec. 4.3)

With `by_place`, gradients of the walk's place k go to gradient slot slots[k], which one CPU thread owns and `reduce`
adds up in a fixed order. Without, as on CUDA, they go to the surfel, by atomics after a sum over the warp.

Warp's own adjoint of such a loop is silently wrong, since it does not replay a carried transmittance. The recurrence
is therefore written by hand. With q_i = dL/dw_i,

    dL/dalpha_i = T_i q_i - (sum over j > i of q_j w_j) / (1 - alpha_i),

where the sum over all i is known from the outputs,

    rest = gN . N + gB . B + sum_k gW_k W_k + gA A

(N with the channels of a wide kernel),

and the walk subtracts its terms one by one. Of each hit, seven derivatives are computed, with respect to a . d, b . d,
n . d and the like (see `hit_gradients`); the record's follow by products with the ray and the weight. Frozen: the
lists, which hits count, which are in the buffer, where the walk ends.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from nexwarp.kernels.collect import channel_product, load_channels
from nexwarp.kernels.shape import alpha_at, far_outside
from nexwarp.kernels.surfel import hit, hit_gradients, record_gradients
from nexwarp.kernels.types import FixedSums, TileLists, func_per_real, ints, per_real
from nexwarp.kernels.walk import block_of, overflowed, pixel_of, stage, tile_of, walk
from nexwarp.native.fixed_point import fixed_point_add, fixed_point_record_sum
from nexwarp.native.staging import BLOCK_DIM, staged_name, staged_record
from nexwarp.native.warp import any_in_warp, lane_index, warp_max, warp_record_sum, warp_size, warp_sum


@func_per_real
def add_rows(rows: Any, slot: int, a: vec4, b: vec4, n: vec4, c: vec4, bad: ints):
    """Add the sum over a warp of four rows to those of a slot."""
    if wp.static(fixed_point):
        fixed_point_record_sum(rows, slot, a, b, n, c, bad)
    else:
        warp_record_sum(rows, slot, a, b, n, c)


@func_per_real
def add(sums: Any, i: int, k: int, a: vec4, b: vec4, n: vec4, c: vec4):
    """Add records' gradients to the slot of place k, or of surfel i; return the slot."""
    slot = int(i)
    if wp.static(by_place):
        slot = sums.slots[k]
    add_rows(sums.records, slot, a, b, n, c, sums.bad)
    return slot


@func_per_real
def add_channels(sums: Any, slot: int, grad: mat44):
    """Add channels' gradients to a slot, in a wide walk."""
    if wp.static(wide):
        add_rows(sums.channels, slot, grad[0], grad[1], grad[2], grad[3], sums.bad)


@func_per_real
def add_error(sums: Any, slot: int, error: real):
    """Add the sum of errors over a warp to a slot, where they are asked for."""
    if wp.static(with_errors):
        total = warp_sum(error)
        if lane_index() == 0:
            if wp.static(fixed_point):
                fixed_point_add(sums.errors, slot, total, sums.bad)
            else:
                wp.atomic_add(sums.errors, slot, total)


@func_per_real
def buffered_gradients(i: int, ids: Any, grad_weights: Any, grad_depths: Any):
    """Gradients of a hit's weight and depth, and whether the buffer holds it."""
    grad_weight = real(0.0)
    grad_depth = real(0.0)
    buffered = bool(False)
    for j in range(wp.static(max_hits)):
        if i == ids[j]:
            grad_weight = grad_weights[j]
            grad_depth = grad_depths[j]
            buffered = True
    return grad_weight, grad_depth, buffered


@per_real("dtype")
def reduce_slots(
    first: int, order: ints, ends: ints, slots: wp.array2d(dtype=dtype), columns: int, sums: wp.array2d(dtype=dtype)
):
    """The second half of a backward pass on a CPU: the sums of each surfel's gradient slots. A thread is a surfel.

    `slots` (M, columns) are in the order of emission, in which the entries of the surfel order[rank] lie together and
    end at ends[rank]. They are added to `sums` (N, columns) in a fixed order.
    """
    rank = first + wp.tid()
    start = int(0)
    if rank > 0:
        start = ends[rank - 1]
    for c in range(columns):
        for e in range(start, ends[rank]):
            sums[order[rank], c] += slots[e, c]


NAMES = ("max_hits", "with_errors", "fixed_point", "by_place", "wide")


@per_real(*NAMES, grid_stride=False, fast_math=True, launch_bounds=BLOCK_DIM)
def collect_backward(
    first: int,
    surfels: Surfels,
    lists: TileLists,
    view: View,
    hits: Hits,
    grads: HitGradients,
    sums: FixedSums if fixed_point else Sums,
):
    thread = first + wp.tid()
    xy, inside, d = pixel_of(thread, view)
    middle, half = block_of(xy, view)
    # Threads outside the image walk along without a hit: all lanes of a warp must reach the sums together.
    p = wp.min(xy[1], view.size[1] - 1) * view.size[0] + wp.min(xy[0], view.size[0] - 1)
    stop = hits.stops[p]
    if not inside:
        stop = int(0)
    grad_plain = grads.plain[p]
    grad_base = grads.base[p]
    grad_total = grads.alphas[p]
    rest = wp.dot(grad_plain, hits.plain[p]) + wp.dot(grad_base, hits.base[p]) + grad_total * hits.alphas[p]
    grad_channels = load_channels(grads.channels, p)
    rest += channel_product(hits.channels, p, grad_channels)
    ids = wp.vector(length=wp.static(max(max_hits, 1)), dtype=wp.int32)
    grad_weights = wp.vector(length=wp.static(max(max_hits, 1)), dtype=real)
    grad_depths = wp.vector(length=wp.static(max(max_hits, 1)), dtype=real)
    for j in range(wp.static(max_hits)):
        ids[j] = hits.ids[p, j]
        grad_weights[j] = grads.weights[p, j]
        grad_depths[j] = grads.depths[p, j]
        rest += grad_weights[j] * hits.weights[p, j]
    error = real(0.0)
    if wp.static(with_errors):
        error = grads.errors[p]
    transmittance = real(1.0)
    overflow = overflowed(lists)
    bounds = walk(tile_of(thread), lists, overflow)
    width = warp_size()
    last = wp.min(warp_max(stop), bounds[1])
    for batch in range(bounds[0], last, width):
        count, mine = stage(batch, last, surfels, lists, overflow, middle, half)
        for slot in range(count):
            i, k = staged_name(slot, mine, batch)
            a, b, n, c = staged_record(slot, surfels.records, i)
            u, v, depth = hit(a, b, n, c[3], d)
            # A CPU skips at once what certainly does not count. Behind that, alpha is computed straight on, so that
            # the compiler uses its exponentials again for the derivative.
            if width == 1 and (k >= stop or far_outside(u, v, surfels.limits[i])):
                continue
            alpha = alpha_at(u, v, a[3], b[3], n[3])
            if not (k < stop and alpha >= ALPHA_MIN and depth > view.near):
                alpha = ZERO
            if any_in_warp(wp.where(alpha > ZERO, 1, 0)) != 0:
                grad = vec7()
                weight = alpha * transmittance
                plain_weight = weight
                grad_color = grad_plain
                if alpha > ZERO:
                    grad_weight, grad_depth, buffered = buffered_gradients(i, ids, grad_weights, grad_depths)
                    if buffered:
                        grad_color = grad_base
                        plain_weight = ZERO
                    q = grad_total + grad_weight
                    q += grad_color[0] * c[0] + grad_color[1] * c[1] + grad_color[2] * c[2]
                    q += wp.where(buffered, ZERO, channel_product(surfels.channels, i, grad_channels))
                    rest -= q * weight
                    grad_alpha = transmittance * q - rest / (ONE - alpha)
                    grad = hit_gradients(a, b, n, c[3], d, grad_alpha, grad_depth)
                transmittance = transmittance * (ONE - alpha)
                row_a, row_b, row_n = record_gradients(grad, d)
                row_c = vec4(grad_color[0] * weight, grad_color[1] * weight, grad_color[2] * weight, grad[3])
                target = add(sums, i, k, row_a, row_b, row_n, row_c)
                add_error(sums, target, weight * error)
                add_channels(sums, target, grad_channels * plain_weight)
