"""Collection pass (paper Sec. 3.2): walk a tile's list near to far, blend plain colours, keep the K heaviest hits.

One thread a pixel. The forward pass writes

    plain    N = sum over hits outside the buffer of weight * colour (paper Eq. 4)
    ids, depths, weights    the K heaviest hits, heaviest first; on a tie the nearer one stays
    alphas   1 - final transmittance
    stops    end of the part of the list that was walked

Discrete and frozen for the backward pass: the lists, which hits count, which are in the buffer, where the walk stops.
Warp's own adjoint of such a loop is silently wrong (a carried transmittance is not replayed), so the recurrence is by
hand, front to back in one pass. With q_i = dL/dw_i,

    dL/dalpha_i = T_i q_i - (sum over j > i of q_j w_j) / (1 - alpha_i)

and the sum over all i, which the walk then uses up hit by hit, is known from the outputs:

    rest = gN . N + sum_k gW_k W_k + gA A.

Each hit is differentiated by `wp.grad` of the one function that the forward pass calls.
Gradients of entry k go to row rows[k]: the surfel (CUDA: atomics after a sum over the warp) or the entry's own slot
(CPU: owned by one thread, then added up in a fixed order by `reduce_rows_kernel`).
"""

import functools

import warp as wp

from nexwarp.kernels.lanes import any_lane, lane, lane_sum
from nexwarp.kernels.surfel import hit_functions
from nexwarp.kernels.types import types

BLOCK_DIM = 128


@wp.func
def overflowed(ends: wp.array(dtype=wp.int32), surfel_ids: wp.array(dtype=wp.int32)):
    """Whether there are more entries than the lists have room for."""
    count = ends.shape[0]
    if count == 0:
        return False
    return ends[count - 1] > surfel_ids.shape[0]


@wp.func
def walk(tile: wp.int32, tile_offsets: wp.array(dtype=wp.int32), ends: wp.array(dtype=wp.int32), overflow: wp.bool):
    """Range of the walk: the tile's list, or all surfels when lists lack entries (lists only cull: slow, but right)."""
    if overflow:
        return wp.vec2i(0, ends.shape[0])
    return wp.vec2i(tile_offsets[tile], tile_offsets[tile + 1])


@wp.func
def surfel_at(k: wp.int32, listed: wp.array(dtype=wp.int32), order: wp.array(dtype=wp.int32), overflow: wp.bool):
    """Surfel (or row) at place k of the walk."""
    if overflow:
        return order[k]
    return listed[k]


@functools.cache
def pixel_function(tile_size: int) -> wp.Function:
    """(column, row) of a thread: the 32 lanes of a warp cover 8 x 4 pixels, warps cover a tile, tiles the image."""
    pixels = tile_size * tile_size
    across = tile_size // 8

    @wp.func
    def pixel_of(thread: int, tile_columns: int):
        tile = thread // pixels
        local = thread % pixels
        warp = local // 32
        lane_ = local % 32
        return wp.vec2i(
            (tile % tile_columns) * tile_size + (warp % across) * 8 + lane_ % 8,
            (tile // tile_columns) * tile_size + (warp // across) * 4 + lane_ // 8,
        )

    return pixel_of


@functools.cache
def buffer_types(real: type, max_hits: int) -> tuple[type, type]:
    """Vector types of the K-buffer: registers, of static length (one unused slot for K = 0)."""
    slots = max(max_hits, 1)
    return wp.types.vector(length=slots, dtype=real), wp.types.vector(length=slots, dtype=wp.int32)


@functools.cache
def collect_kernel(real: type, max_hits: int, low_pass: bool, tile_size: int) -> wp.Kernel:
    """Make the forward kernel."""
    t = types(real)
    vec2, vec3, vec4 = t.vec2, t.vec3, t.vec4
    h = hit_functions(real, low_pass)
    vec, ivec = buffer_types(real, max_hits)
    pixel_of = pixel_function(tile_size)
    pixels = tile_size * tile_size
    ALPHA_MIN, TRANSMITTANCE_MIN, ONE = t.ALPHA_MIN, t.TRANSMITTANCE_MIN, t.ONE

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32},
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
        intrinsics: vec4,
        near: real,
        # outputs
        plain: wp.array(dtype=vec3),
        ids: wp.array2d(dtype=wp.int32),
        depths: wp.array2d(dtype=real),
        weights: wp.array2d(dtype=real),
        alphas: wp.array(dtype=real),
        stops: wp.array(dtype=wp.int32),
    ):
        thread = first + wp.tid()
        tile = thread // pixels
        xy = pixel_of(thread, tile_columns)
        if xy[0] >= size[0] or xy[1] >= size[1]:
            return
        focal = vec2(intrinsics[0], intrinsics[1])
        d = vec3(
            (real(float(xy[0])) + real(0.5) - intrinsics[2]) / focal[0],
            (real(float(xy[1])) + real(0.5) - intrinsics[3]) / focal[1],
            ONE,
        )
        transmittance = real(1.0)
        color = vec3()
        buffer_ids = ivec()
        buffer_weights = vec()
        buffer_depths = vec()
        for j in range(wp.static(max_hits)):
            buffer_ids[j] = -1
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(tile, tile_offsets, ends, overflow)
        stop = int(bounds[0])
        for k in range(bounds[0], bounds[1]):
            i = surfel_at(k, surfel_ids, order, overflow)
            ra = records[i, 0]
            rb = records[i, 1]
            rn = records[i, 2]
            rc = records[i, 3]
            uvt = h.plane(ra, rb, rn, rc[3], d)
            if h.far_outside(uvt, limits[i]):
                continue
            center = vec3()
            if wp.static(low_pass):
                center = centers[i]
            hit = h.kernel(uvt, ra, rb, rn, center, d, focal, near)
            if hit[0] >= ALPHA_MIN and hit[1] > near:
                weight = hit[0] * transmittance
                transmittance = transmittance * (ONE - hit[0])
                stop = k + 1
                # Insert into the buffer before the first lighter hit, and move that and all behind it down by one, so
                # that of equal ones the nearer stays; what falls out is blended as plain.
                displaced = int(0)
                out_id = int(i)
                out_weight = real(weight)
                out_depth = real(hit[1])
                for j in range(wp.static(max_hits)):
                    if displaced == 1 or out_weight > buffer_weights[j]:
                        displaced = 1
                        w_ = buffer_weights[j]
                        i_ = buffer_ids[j]
                        d_ = buffer_depths[j]
                        buffer_weights[j] = out_weight
                        buffer_ids[j] = out_id
                        buffer_depths[j] = out_depth
                        out_weight = w_
                        out_id = i_
                        out_depth = d_
                if out_id >= 0:
                    if out_id != i:
                        rc = records[out_id, 3]
                    color += vec3(rc[0], rc[1], rc[2]) * out_weight
                if transmittance < TRANSMITTANCE_MIN:
                    break
        p = xy[1] * size[0] + xy[0]
        plain[p] = color
        for j in range(wp.static(max_hits)):
            ids[p, j] = buffer_ids[j]
            depths[p, j] = buffer_depths[j]
            weights[p, j] = buffer_weights[j]
        alphas[p] = ONE - transmittance
        stops[p] = stop

    return collect


@functools.cache
def collect_backward_kernel(
    real: type, max_hits: int, low_pass: bool, tile_size: int, watch: bool = False
) -> wp.Kernel:
    """Make the backward kernel; with `watch` it also adds up weight * error a row, as `splat_error` does alone."""
    t = types(real)
    vec2, vec3, vec4 = t.vec2, t.vec3, t.vec4
    h = hit_functions(real, low_pass)
    hit_dot = h.hit_dot
    vec, ivec = buffer_types(real, max_hits)
    pixel_of = pixel_function(tile_size)
    pixels = tile_size * tile_size
    sum1, sum3, sum4 = lane_sum(real), lane_sum(vec3), lane_sum(vec4)
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
        rows: wp.array(dtype=wp.int32),
        tile_offsets: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        size: wp.vec2i,
        tile_columns: wp.int32,
        intrinsics: vec4,
        near: real,
        plain: wp.array(dtype=vec3),
        ids: wp.array2d(dtype=wp.int32),
        weights: wp.array2d(dtype=real),
        alphas: wp.array(dtype=real),
        stops: wp.array(dtype=wp.int32),
        grad_plain: wp.array(dtype=vec3),
        grad_depths: wp.array2d(dtype=real),
        grad_weights: wp.array2d(dtype=real),
        grad_alphas: wp.array(dtype=real),
        errors: wp.array(dtype=real),
        # outputs
        grad_records: wp.array2d(dtype=vec4),
        grad_centers: wp.array(dtype=vec3),
        error_sums: wp.array(dtype=real),
    ):
        thread = first + wp.tid()
        tile = thread // pixels
        xy = pixel_of(thread, tile_columns)
        # Lanes outside the image walk along with nothing to give: all lanes of a warp must reach the sums together.
        p = wp.min(xy[1], size[1] - 1) * size[0] + wp.min(xy[0], size[0] - 1)
        stop = stops[p]
        if xy[0] >= size[0] or xy[1] >= size[1]:
            stop = int(0)
        focal = vec2(intrinsics[0], intrinsics[1])
        d = vec3(
            (real(float(xy[0])) + real(0.5) - intrinsics[2]) / focal[0],
            (real(float(xy[1])) + real(0.5) - intrinsics[3]) / focal[1],
            ONE,
        )
        gn = grad_plain[p]
        ga = grad_alphas[p]
        rest = wp.dot(gn, plain[p]) + ga * alphas[p]
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
        for k in range(bounds[0], bounds[1]):
            live = int(0)
            if k < stop:
                live = 1
            if any_lane(live) == 0:
                break
            i = surfel_at(k, surfel_ids, order, overflow)
            ra = records[i, 0]
            rb = records[i, 1]
            rn = records[i, 2]
            rc = records[i, 3]
            center = vec3()
            if wp.static(low_pass):
                center = centers[i]
            uvt = h.plane(ra, rb, rn, rc[3], d)
            alpha = ZERO
            if live == 1 and not h.far_outside(uvt, limits[i]):
                hit = h.kernel(uvt, ra, rb, rn, center, d, focal, near)
                if hit[0] >= ALPHA_MIN and hit[1] > near:
                    alpha = hit[0]
            counts = int(0)
            if alpha > ZERO:
                counts = 1
            if any_lane(counts) == 0:
                continue
            g0 = vec4()
            g1 = vec4()
            g2 = vec4()
            g3 = vec4()
            gc = vec3()
            share = real(0.0)
            if counts == 1:
                weight = alpha * transmittance
                share = weight * error
                q = ga
                gt = real(0.0)
                buffered = int(0)
                for j in range(wp.static(max_hits)):
                    if i == slots[j]:
                        q += gw[j]
                        gt = gd[j]
                        buffered = 1
                if buffered == 0:
                    q += gn[0] * rc[0] + gn[1] * rc[1] + gn[2] * rc[2]
                    g3 = vec4(gn[0] * weight, gn[1] * weight, gn[2] * weight, ZERO)
                rest -= q * weight
                grad_alpha = transmittance * q - rest / (ONE - alpha)
                transmittance = transmittance * (ONE - alpha)
                g0, g1, g2, gm, gc, _d, _f, _n, _a, _t = wp.grad(hit_dot)(
                    ra, rb, rn, rc[3], center, d, focal, near, grad_alpha, gt
                )
                g3[3] = gm
            row = surfel_at(k, rows, order, overflow)
            g0 = sum4(g0)
            g1 = sum4(g1)
            g2 = sum4(g2)
            g3 = sum4(g3)
            if wp.static(low_pass):
                gc = sum3(gc)
            if wp.static(watch):
                share = sum1(share)
            if me == 0:
                if wp.static(watch):
                    wp.atomic_add(error_sums, row, share)
                wp.atomic_add(grad_records, row, 0, g0)
                wp.atomic_add(grad_records, row, 1, g1)
                wp.atomic_add(grad_records, row, 2, g2)
                wp.atomic_add(grad_records, row, 3, g3)
                if wp.static(low_pass):
                    wp.atomic_add(grad_centers, row, gc)

    return collect_backward


@functools.cache
def splat_error_kernel(real: type, low_pass: bool, tile_size: int) -> wp.Kernel:
    """Make the kernel that gives each entry the sum over pixels of weight * error (densification, paper Sec. 3.3)."""
    t = types(real)
    vec2, vec3, vec4 = t.vec2, t.vec3, t.vec4
    h = hit_functions(real, low_pass)
    pixel_of = pixel_function(tile_size)
    pixels = tile_size * tile_size
    sum1 = lane_sum(real)
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
        rows: wp.array(dtype=wp.int32),
        tile_offsets: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        size: wp.vec2i,
        tile_columns: wp.int32,
        intrinsics: vec4,
        near: real,
        stops: wp.array(dtype=wp.int32),
        errors: wp.array(dtype=real),
        # outputs
        sums: wp.array(dtype=real),
    ):
        thread = first + wp.tid()
        tile = thread // pixels
        xy = pixel_of(thread, tile_columns)
        p = wp.min(xy[1], size[1] - 1) * size[0] + wp.min(xy[0], size[0] - 1)
        stop = stops[p]
        if xy[0] >= size[0] or xy[1] >= size[1]:
            stop = int(0)
        focal = vec2(intrinsics[0], intrinsics[1])
        d = vec3(
            (real(float(xy[0])) + real(0.5) - intrinsics[2]) / focal[0],
            (real(float(xy[1])) + real(0.5) - intrinsics[3]) / focal[1],
            ONE,
        )
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
            ra = records[i, 0]
            rb = records[i, 1]
            rn = records[i, 2]
            rc = records[i, 3]
            center = vec3()
            if wp.static(low_pass):
                center = centers[i]
            uvt = h.plane(ra, rb, rn, rc[3], d)
            alpha = ZERO
            if live == 1 and not h.far_outside(uvt, limits[i]):
                hit = h.kernel(uvt, ra, rb, rn, center, d, focal, near)
                if hit[0] >= ALPHA_MIN and hit[1] > near:
                    alpha = hit[0]
            share = alpha * transmittance * error
            transmittance = transmittance * (ONE - alpha)
            counts = int(0)
            if share > ZERO:
                counts = 1
            if any_lane(counts) == 0:
                continue
            share = sum1(share)
            if me == 0:
                wp.atomic_add(sums, surfel_at(k, rows, order, overflow), share)

    return splat_error


@functools.cache
def reduce_rows_kernel(dtype: type) -> wp.Kernel:
    """Make the kernel that adds up each surfel's entry slots to `sums`, one thread a surfel, in a fixed order."""

    @wp.kernel(enable_backward=False, module="unique")
    def reduce_rows(
        first: wp.int32,
        order: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        slots: wp.array2d(dtype=dtype),
        columns: wp.int32,
        # outputs
        sums: wp.array2d(dtype=dtype),
    ):
        rank = first + wp.tid()
        start = int(0)
        if rank > 0:
            start = ends[rank - 1]
        for c in range(columns):
            for e in range(start, ends[rank]):
                sums[order[rank], c] += slots[e, c]

    return reduce_rows
