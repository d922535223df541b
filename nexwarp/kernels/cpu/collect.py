"""SIMD form of `collect` and `collect_backward`, for CPUs (paper Sec. 4.2).

A thread is a strip: `width` neighbouring pixels of one row of a tile. Read, written, differentiated and frozen is what
the two kernels read, write, differentiate and freeze, line by line, with SIMD vectors for what pixels differ in and
masks for the pixels of which something holds; a test compares the forms. What misses the whole strip is culled first.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.surfel import frame_functions, hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import overflowed, surfel_at, walk
from nexwarp.native.simd import simd_functions
from nexwarp.native.simd.slots import slot_functions


def strip_width(tile_size: int) -> int:
    """Pixels of a strip: as many float32 as an AVX-512 register holds, where tiles are that wide."""
    return 16 if tile_size % 16 == 0 else 8


@functools.cache
def strip_functions(real: type, tile_size: int) -> SimpleNamespace:
    """Make the functions that tell a thread its strip and its rays; `strips` is the number of strips of a tile."""
    t = types(real)
    vec2, vec4, HALF = t.vec2, t.vec4, t.HALF
    width = strip_width(tile_size)
    reals = simd_functions(real, width).reals
    strips = tile_size * tile_size // width
    across = tile_size // width
    # Half of the distance between the outer pixel centres, and a little.
    HALF_STRIP, SLIVER = wp.constant(real(width / 2 - 0.49)), wp.constant(real(0.01))

    @wp.func
    def strip_of(thread: int, tile_columns: int):
        """First pixel, (column, row)."""
        tile = thread // strips
        local = thread % strips
        return wp.vec2i(
            (tile % tile_columns) * tile_size + (local % across) * width,
            (tile // tile_columns) * tile_size + local // across,
        )

    @wp.func
    def rays_of(xy: wp.vec2i, intrinsics: vec4):
        """Directions of the strip's pixels: x of each, the y of all; z is 1."""
        dx = reals()
        for l in range(wp.static(width)):
            dx[l] = (real(float(xy[0] + l)) + HALF - intrinsics[2]) / intrinsics[0]
        return dx, (real(float(xy[1])) + HALF - intrinsics[3]) / intrinsics[1]

    @wp.func
    def middle_of(xy: wp.vec2i, y: real, intrinsics: vec4):
        """Direction through the middle of the strip."""
        return vec2((real(float(xy[0] + wp.static(width // 2))) - intrinsics[2]) / intrinsics[0], y)

    @wp.func
    def half_strip(intrinsics: vec4):
        return vec2(HALF_STRIP / intrinsics[0], SLIVER / intrinsics[1])

    return SimpleNamespace(
        strip_of=strip_of, rays_of=rays_of, middle_of=middle_of, half_strip=half_strip, strips=strips
    )


@functools.cache
def collect_simd_kernel(real: type, max_hits: int, low_pass: bool, tile_size: int) -> wp.Kernel:
    """Make the forward kernel."""
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    intrinsics_of = frame_functions(real).intrinsics_of
    width = strip_width(tile_size)
    h = hit_functions(real, low_pass, width)
    f = simd_functions(real, width)
    reals, integers, integer = f.reals, f.integers, f.integer
    s = slot_functions(real, width, max(max_hits, 1))
    reals_by_slot, integers_by_slot = s.reals_by_slot, s.integers_by_slot
    view = strip_functions(real, tile_size)
    strips = view.strips
    ALPHA_MIN, TRANSMITTANCE_MIN, ONE = t.ALPHA_MIN, t.TRANSMITTANCE_MIN, t.ONE

    # The loop over pixels is not unrolled, that would be most of the kernel's code. Its arguments are copies, so that
    # what the walk works on is never indexed by a variable and stays in registers.
    @wp.func
    def write(
        xy: wp.vec2i,
        size: wp.vec2i,
        red: reals,
        green: reals,
        blue: reals,
        transmittance: reals,
        stop: integers,
        buffer_red: reals_by_slot,
        buffer_green: reals_by_slot,
        buffer_blue: reals_by_slot,
        buffer_weights: reals_by_slot,
        buffer_ids: integers_by_slot,
        buffer_depths: reals_by_slot,
        plain: wp.array(dtype=vec3),
        base: wp.array(dtype=vec3),
        ids: wp.array2d(dtype=wp.int32),
        depths: wp.array2d(dtype=real),
        weights: wp.array2d(dtype=real),
        alphas: wp.array(dtype=real),
        stops: wp.array(dtype=wp.int32),
    ):
        for l in range(wp.min(width, size[0] - xy[0])):
            p = xy[1] * size[0] + xy[0] + l
            plain[p] = vec3(red[l], green[l], blue[l])
            kept = vec3()
            for j in range(wp.static(max_hits)):
                kept += vec3(buffer_red[j, l], buffer_green[j, l], buffer_blue[j, l]) * buffer_weights[j, l]
                ids[p, j] = wp.int32(buffer_ids[j, l])
                depths[p, j] = buffer_depths[j, l]
                weights[p, j] = buffer_weights[j, l]
            base[p] = kept
            alphas[p] = ONE - transmittance[l]
            stops[p] = wp.int32(stop[l])

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
    )
    def collect_simd(
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
        xy = view.strip_of(thread, tile_columns)
        if xy[0] >= size[0] or xy[1] >= size[1]:
            return
        intrinsics = intrinsics_of(Ks)
        focal = vec2(intrinsics[0], intrinsics[1])
        dx, y = view.rays_of(xy, intrinsics)
        alive = integers()
        for l in range(wp.static(width)):
            if xy[0] + l < size[0]:
                alive[l] = integer(-1)
        middle = view.middle_of(xy, y, intrinsics)
        half = view.half_strip(intrinsics)
        one = reals(ONE)
        transmittance = reals(ONE)
        red = reals()
        green = reals()
        blue = reals()
        buffer_ids = integers_by_slot(integer(-1))
        buffer_weights = reals_by_slot()
        buffer_depths = reals_by_slot()
        buffer_red = reals_by_slot()
        buffer_green = reals_by_slot()
        buffer_blue = reals_by_slot()
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(thread // strips, tile_offsets, ends, overflow)
        stop = integers(integer(bounds[0]))
        for k in range(bounds[0], bounds[1]):
            i = surfel_at(k, surfel_ids, order, overflow)
            ra = records[i, 0]
            rb = records[i, 1]
            rn = records[i, 2]
            rc = records[i, 3]
            center = vec3()
            if wp.static(low_pass):
                center = centers[i]
            if h.misses_block(ra, rb, rn, rc[3], reaches[i], limits[i], center, middle, half, focal):
                continue
            u, v, depth = h.plane(ra, rb, rn, rc[3], dx, y)
            alpha, depth = h.kernel(u, v, depth, ra, rb, rn, center, dx, y, focal, near)
            seen = f.both(f.both(f.above(alpha, reals(ALPHA_MIN), True), f.above(depth, reals(near), False)), alive)
            if not f.any_of(seen):
                continue
            alpha = f.pick(seen, alpha, reals())
            out_weight = f.times(alpha, transmittance)
            transmittance = f.times(transmittance, one - alpha)
            stop = f.pick_integers(seen, integers(integer(k + 1)), stop)
            # Pixels without a hit insert the weight 0, which displaces nothing and adds nothing.
            displaced = integers()
            out_id = integers(integer(i))
            out_depth = depth
            out_red = reals(rc[0])
            out_green = reals(rc[1])
            out_blue = reals(rc[2])
            for j in range(wp.static(max_hits)):
                w_ = s.reals_at(buffer_weights, j)
                displaced = f.either(displaced, f.below(w_, out_weight))
                i_ = s.integers_at(buffer_ids, j)
                d_ = s.reals_at(buffer_depths, j)
                r_ = s.reals_at(buffer_red, j)
                g_ = s.reals_at(buffer_green, j)
                b_ = s.reals_at(buffer_blue, j)
                buffer_weights = s.with_reals(buffer_weights, j, f.pick(displaced, out_weight, w_))
                buffer_ids = s.with_integers(buffer_ids, j, f.pick_integers(displaced, out_id, i_))
                buffer_depths = s.with_reals(buffer_depths, j, f.pick(displaced, out_depth, d_))
                buffer_red = s.with_reals(buffer_red, j, f.pick(displaced, out_red, r_))
                buffer_green = s.with_reals(buffer_green, j, f.pick(displaced, out_green, g_))
                buffer_blue = s.with_reals(buffer_blue, j, f.pick(displaced, out_blue, b_))
                out_weight = f.pick(displaced, w_, out_weight)
                out_id = f.pick_integers(displaced, i_, out_id)
                out_depth = f.pick(displaced, d_, out_depth)
                out_red = f.pick(displaced, r_, out_red)
                out_green = f.pick(displaced, g_, out_green)
                out_blue = f.pick(displaced, b_, out_blue)
            red += f.times(out_red, out_weight)
            green += f.times(out_green, out_weight)
            blue += f.times(out_blue, out_weight)
            alive = f.both(alive, f.above(transmittance, reals(TRANSMITTANCE_MIN), True))
            if not f.any_of(alive):
                break
        write(
            xy,
            size,
            red,
            green,
            blue,
            transmittance,
            stop,
            buffer_red,
            buffer_green,
            buffer_blue,
            buffer_weights,
            buffer_ids,
            buffer_depths,
            plain,
            base,
            ids,
            depths,
            weights,
            alphas,
            stops,
        )

    return collect_simd


@functools.cache
def collect_simd_backward_kernel(
    real: type, max_hits: int, low_pass: bool, tile_size: int, with_errors: bool = False
) -> wp.Kernel:
    """Make the backward kernel; with `with_errors` it also adds up weight * error a gradient slot."""
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    intrinsics_of = frame_functions(real).intrinsics_of
    width = strip_width(tile_size)
    h = hit_functions(real, low_pass, width)
    f = simd_functions(real, width)
    reals, integers, integer, inner = f.reals, f.integers, f.integer, f.inner
    s = slot_functions(real, width, max(max_hits, 1))
    reals_by_slot, integers_by_slot = s.reals_by_slot, s.integers_by_slot
    view = strip_functions(real, tile_size)
    strips = view.strips
    ALPHA_MIN, ONE = t.ALPHA_MIN, t.ONE

    # Apart from the walk for the reasons that `write` is.
    @wp.func
    def read(
        xy: wp.vec2i,
        size: wp.vec2i,
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
    ):
        stop = integers()
        last = int(0)
        grad_red = reals()
        grad_green = reals()
        grad_blue = reals()
        base_red = reals()
        base_green = reals()
        base_blue = reals()
        grad_alpha_sum = reals()
        rest = reals()
        error = reals()
        buffered_ids = integers_by_slot(integer(-1))
        gw = reals_by_slot()
        gd = reals_by_slot()
        for l in range(wp.min(width, size[0] - xy[0])):
            p = xy[1] * size[0] + xy[0] + l
            stop[l] = integer(stops[p])
            last = wp.max(last, stops[p])
            gn = grad_plain[p]
            grad_red[l] = gn[0]
            grad_green[l] = gn[1]
            grad_blue[l] = gn[2]
            gb = grad_base[p]
            base_red[l] = gb[0]
            base_green[l] = gb[1]
            base_blue[l] = gb[2]
            grad_alpha_sum[l] = grad_alphas[p]
            total = wp.dot(gn, plain[p]) + wp.dot(gb, base[p]) + grad_alphas[p] * alphas[p]
            for j in range(wp.static(max_hits)):
                buffered_ids[j, l] = integer(ids[p, j])
                gw[j, l] = grad_weights[p, j]
                gd[j, l] = grad_depths[p, j]
                total += grad_weights[p, j] * weights[p, j]
            rest[l] = total
            if wp.static(with_errors):
                error[l] = errors[p]
        return (
            stop,
            last,
            grad_red,
            grad_green,
            grad_blue,
            base_red,
            base_green,
            base_blue,
            grad_alpha_sum,
            rest,
            error,
            buffered_ids,
            gw,
            gd,
        )

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
    )
    def collect_simd_backward(
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
        grad_records: wp.array2d(dtype=vec4),
        grad_centers: wp.array(dtype=vec3),
        error_sums: wp.array(dtype=real),
    ):
        thread = first + wp.tid()
        xy = view.strip_of(thread, tile_columns)
        if xy[0] >= size[0] or xy[1] >= size[1]:
            return
        intrinsics = intrinsics_of(Ks)
        focal = vec2(intrinsics[0], intrinsics[1])
        dx, y = view.rays_of(xy, intrinsics)
        (
            stop,
            last,
            grad_red,
            grad_green,
            grad_blue,
            base_red,
            base_green,
            base_blue,
            grad_alpha_sum,
            rest,
            error,
            buffered_ids,
            gw,
            gd,
        ) = read(
            xy,
            size,
            plain,
            base,
            ids,
            weights,
            alphas,
            stops,
            grad_plain,
            grad_base,
            grad_depths,
            grad_weights,
            grad_alphas,
            errors,
        )
        middle = view.middle_of(xy, y, intrinsics)
        half = view.half_strip(intrinsics)
        one = reals(ONE)
        transmittance = reals(ONE)
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(thread // strips, tile_offsets, ends, overflow)
        for k in range(bounds[0], wp.min(bounds[1], last)):
            i = surfel_at(k, surfel_ids, order, overflow)
            ra = records[i, 0]
            rb = records[i, 1]
            rn = records[i, 2]
            rc = records[i, 3]
            center = vec3()
            if wp.static(low_pass):
                center = centers[i]
            if h.misses_block(ra, rb, rn, rc[3], reaches[i], limits[i], center, middle, half, focal):
                continue
            u, v, plane_depth = h.plane(ra, rb, rn, rc[3], dx, y)
            alpha, depth = h.kernel(u, v, plane_depth, ra, rb, rn, center, dx, y, focal, near)
            seen = f.both(f.above(alpha, reals(ALPHA_MIN), True), f.above(depth, reals(near), False))
            seen = f.both(seen, f.less_integers(integers(integer(k)), stop))
            if not f.any_of(seen):
                continue
            alpha = f.pick(seen, alpha, reals())
            weight = f.times(alpha, transmittance)
            q = grad_alpha_sum
            gt = reals()
            buffered = integers()
            for j in range(wp.static(max_hits)):
                same = f.equal_integers(s.integers_at(buffered_ids, j), integers(integer(i)))
                q += f.pick(same, s.reals_at(gw, j), reals())
                gt = f.pick(same, s.reals_at(gd, j), gt)
                buffered = f.either(buffered, same)
            red_ = f.pick(buffered, base_red, grad_red)
            green_ = f.pick(buffered, base_green, grad_green)
            blue_ = f.pick(buffered, base_blue, grad_blue)
            q += red_ * rc[0] + green_ * rc[1] + blue_ * rc[2]
            rest -= f.times(q, weight)
            grad_alpha = f.times(transmittance, q) - f.over(rest, one - alpha)
            transmittance = f.times(transmittance, one - alpha)
            # Pixels without a hit are differentiated along, by 0.
            gu, gv, gp, gm, go, g1, g2, gx, gy, gz = h.hit_gradients(
                u,
                v,
                plane_depth,
                ra,
                rb,
                rn,
                center,
                dx,
                y,
                focal,
                near,
                f.pick(seen, grad_alpha, reals()),
                f.pick(seen, gt, reals()),
            )
            slot = int(i)
            if k < gradient_slots.shape[0]:
                slot = gradient_slots[k]
            su = inner(gu, one)
            sv = inner(gv, one)
            sp = inner(gp, one)
            wp.atomic_add(grad_records, slot, 0, vec4(inner(gu, dx), su * y, su, inner(go, one)))
            wp.atomic_add(grad_records, slot, 1, vec4(inner(gv, dx), sv * y, sv, inner(g1, one)))
            wp.atomic_add(grad_records, slot, 2, vec4(inner(gp, dx), sp * y, sp, inner(g2, one)))
            colors = vec4(inner(red_, weight), inner(green_, weight), inner(blue_, weight), inner(gm, one))
            wp.atomic_add(grad_records, slot, 3, colors)
            if wp.static(low_pass):
                gc = h.center_gradient(center, focal, inner(gx, one), inner(gy, one), inner(gz, one))
                wp.atomic_add(grad_centers, slot, gc)
            if wp.static(with_errors):
                wp.atomic_add(error_sums, slot, inner(weight, error))

    return collect_simd_backward
