"""Collection pass (paper Sec. 3.2): walk a tile's list near to far, blend plain colours, keep the K heaviest hits.

One thread a pixel. The forward pass writes

    plain    N = sum over hits outside the buffer of weight * colour (paper Eq. 4)
    base     the same sum over the hits in the buffer: what they would look like without a texture
    ids, depths, weights    the K heaviest hits, heaviest first; on a tie the nearer one stays
    alphas   1 - final transmittance
    stops    end of the part of the list that was walked

Discrete and frozen for the backward pass: the lists, which hits count, which are in the buffer, where the walk stops.
Warp's own adjoint of such a loop is silently wrong (a carried transmittance is not replayed), so the recurrence is by
hand, front to back in one pass. With q_i = dL/dw_i,

    dL/dalpha_i = T_i q_i - (sum over j > i of q_j w_j) / (1 - alpha_i)

and the sum over all i, which the walk then uses up hit by hit, is known from the outputs:

    rest = gN . N + gB . B + sum_k gW_k W_k + gA A.

Each hit is differentiated by `wp.grad` of the one function that the forward pass calls.

A warp first culls the list for its 8 x 4 pixels, one entry a lane, then walks along what is left: of the entries of a
tile about half. On a CPU a warp is one thread and one pixel, and there is nothing to share.
Gradients of entry k go to the surfel (CUDA: atomics after a sum over the warp) or, where `rows` is given, to the slot
rows[k] of its own (CPU: owned by one thread, then added up in a fixed order by `reduce_rows_kernel`).
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.fixed import fixed_add, fixed_record_sum
from nexwarp.kernels.lanes import any_lane, ballot, first_lane, from_lane, lane, lane_max, lane_sum, lanes, record_sum
from nexwarp.kernels.loads import load_function
from nexwarp.kernels.surfel import frame_functions, hit_functions
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
    """Surfel at place k of the walk."""
    if overflow:
        return order[k]
    return listed[k]


@functools.cache
def view_functions(real: type, tile_size: int) -> SimpleNamespace:
    """Which pixel a thread has, its ray, and the block of pixels that its warp has."""
    t = types(real)
    vec2, vec4, HALF = t.vec2, t.vec4, t.HALF
    # Half of the distances between the outer pixel centres of a block, and a little.
    HALF_WIDTH, HALF_HEIGHT = wp.constant(real(3.51)), wp.constant(real(1.51))
    pixels = tile_size * tile_size
    across = tile_size // 8

    @wp.func
    def pixel_of(thread: int, tile_columns: int):
        """(column, row): the 32 lanes of a warp cover 8 x 4 pixels, warps cover a tile, tiles the image."""
        tile = thread // pixels
        local = thread % pixels
        warp = local // 32
        lane_ = local % 32
        return wp.vec2i(
            (tile % tile_columns) * tile_size + (warp % across) * 8 + lane_ % 8,
            (tile // tile_columns) * tile_size + (warp // across) * 4 + lane_ // 8,
        )

    @wp.func
    def ray(x: real, y: real, intrinsics: vec4):
        """Direction through pixel coordinates; its z is 1."""
        return vec2((x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1])

    @wp.func
    def ray_of(xy: wp.vec2i, intrinsics: vec4):
        return ray(real(float(xy[0])) + HALF, real(float(xy[1])) + HALF, intrinsics)

    @wp.func
    def block_of(xy: wp.vec2i, intrinsics: vec4):
        """Ray through the middle of the 8 x 4 pixels that have pixel xy among them."""
        x = xy[0] - xy[0] % 8 + 4
        y = xy[1] - xy[1] % 4 + 2
        return ray(real(float(x)), real(float(y)), intrinsics)

    @wp.func
    def half_block(intrinsics: vec4):
        return vec2(HALF_WIDTH / intrinsics[0], HALF_HEIGHT / intrinsics[1])

    return SimpleNamespace(pixel_of=pixel_of, ray_of=ray_of, block_of=block_of, half_block=half_block, pixels=pixels)


@functools.cache
def buffer_types(real: type, max_hits: int) -> tuple[type, type, type]:
    """Types of the K-buffer's values, ids and colours: registers, of static length (one unused slot for K = 0)."""
    slots = max(max_hits, 1)
    return (
        wp.types.vector(length=slots, dtype=real),
        wp.types.vector(length=slots, dtype=wp.int32),
        wp.types.matrix(shape=(slots, 3), dtype=real),
    )


@functools.cache
def collect_kernel(real: type, max_hits: int, low_pass: bool, tile_size: int) -> wp.Kernel:
    """Make the forward kernel."""
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    intrinsics_of = frame_functions(real).intrinsics_of
    h = hit_functions(real, low_pass)
    load = load_function(4, real)
    vec, ivec, colors = buffer_types(real, max_hits)
    view = view_functions(real, tile_size)
    pixels = view.pixels
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
        tile = thread // pixels
        xy = view.pixel_of(thread, tile_columns)
        # Lanes outside the image cull along: all lanes of a warp must reach the votes together.
        done = int(0)
        if xy[0] >= size[0] or xy[1] >= size[1]:
            done = 1
        intrinsics = intrinsics_of(Ks)
        focal = vec2(intrinsics[0], intrinsics[1])
        d = view.ray_of(xy, intrinsics)
        middle = view.block_of(xy, intrinsics)
        half = view.half_block(intrinsics)
        transmittance = real(1.0)
        color = vec3()
        buffer_ids = ivec()
        buffer_weights = vec()
        buffer_depths = vec()
        buffer_colors = colors()
        for j in range(wp.static(max_hits)):
            buffer_ids[j] = -1
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(tile, tile_offsets, ends, overflow)
        stop = int(bounds[0])
        width = lanes()
        me = lane()
        for batch in range(bounds[0], bounds[1], width):
            if any_lane(1 - done) == 0:
                break
            mine = int(-1)
            if batch + me < bounds[1]:
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
                if done == 0:
                    ra = load(records, i, 0)
                    rb = load(records, i, 1)
                    rn = load(records, i, 2)
                    rc = load(records, i, 3)
                    u, v, depth = h.plane(ra, rb, rn, rc[3], d[0], d[1])
                    alpha = real(0.0)
                    # On a GPU some lane nearly always needs the exponentials.
                    if width > 1 or not h.far_outside(u, v, limits[i]):
                        center = vec3()
                        if wp.static(low_pass):
                            center = centers[i]
                        alpha, depth = h.kernel(u, v, depth, ra, rb, rn, center, d[0], d[1], focal, near)
                    if alpha >= ALPHA_MIN and depth > near:
                        weight = alpha * transmittance
                        transmittance = transmittance * (ONE - alpha)
                        stop = batch + next_lane + 1
                        # Insert into the buffer before the first lighter hit, and move that and all behind it down by
                        # one, so that of equal ones the nearer stays; what falls out is blended as plain.
                        displaced = int(0)
                        out_id = int(i)
                        out_weight = real(weight)
                        out_depth = real(depth)
                        out_color = vec3(rc[0], rc[1], rc[2])
                        for j in range(wp.static(max_hits)):
                            if displaced == 1 or out_weight > buffer_weights[j]:
                                displaced = 1
                                w_ = buffer_weights[j]
                                i_ = buffer_ids[j]
                                d_ = buffer_depths[j]
                                c_ = vec3(buffer_colors[j, 0], buffer_colors[j, 1], buffer_colors[j, 2])
                                buffer_weights[j] = out_weight
                                buffer_ids[j] = out_id
                                buffer_depths[j] = out_depth
                                buffer_colors[j, 0] = out_color[0]
                                buffer_colors[j, 1] = out_color[1]
                                buffer_colors[j, 2] = out_color[2]
                                out_weight = w_
                                out_id = i_
                                out_depth = d_
                                out_color = c_
                        # Out of an empty slot comes the weight 0.
                        color += out_color * out_weight
                        if transmittance < TRANSMITTANCE_MIN:
                            done = 1
        if xy[0] >= size[0] or xy[1] >= size[1]:
            return
        p = xy[1] * size[0] + xy[0]
        plain[p] = color
        kept = vec3()
        for j in range(wp.static(max_hits)):
            kept += vec3(buffer_colors[j, 0], buffer_colors[j, 1], buffer_colors[j, 2]) * buffer_weights[j]
            ids[p, j] = buffer_ids[j]
            depths[p, j] = buffer_depths[j]
            weights[p, j] = buffer_weights[j]
        base[p] = kept
        alphas[p] = ONE - transmittance
        stops[p] = stop

    return collect


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
