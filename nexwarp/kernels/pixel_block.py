"""Experiment: the forward collection pass written once over a pixel block, 1 pixel a thread (CUDA) or a strip (SIMD).

Read and written is what `collect` reads and writes. Nothing uses it yet; `benchmarks.bench_pixel_block` times it.

What pixels differ in is a value of `native.simd`: a scalar for width 1, a SIMD vector otherwise. What holds of a pixel
is a mask, a bool for width 1; values change by `pick` instead of an if. `any_of` of a mask is the bool itself for width
1, so that the branches around it are those of `collect`. A warp culls as in `walk`, on a CPU a warp of one thread.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.cpu.collect import strip_functions, strip_width
from nexwarp.kernels.native.simd import simd_functions
from nexwarp.kernels.native.simd.slots import slot_functions
from nexwarp.kernels.native.vector_loads import load_function
from nexwarp.kernels.native.warp import any_in_warp, ballot, from_lane, lane_index, lowest_lane, warp_size
from nexwarp.kernels.surfel import frame_functions, hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import overflowed, surfel_at, walk, walk_functions


def _scalar_block(real: type, slots: int) -> SimpleNamespace:
    reals_by_slot = wp.types.vector(length=slots, dtype=real)
    integers_by_slot = wp.types.vector(length=slots, dtype=wp.int32)

    @wp.func
    def above(a: real, b: real, or_equal: wp.bool):
        return a > b or (or_equal and a == b)

    @wp.func
    def both(a: wp.bool, b: wp.bool):
        return a and b

    @wp.func
    def either(a: wp.bool, b: wp.bool):
        return a or b

    @wp.func
    def any_of(mask: wp.bool):
        return mask

    @wp.func
    def none_of():
        return False

    @wp.func
    def whole(x: wp.int32):
        return x

    @wp.func
    def pick_integers(mask: wp.bool, a: wp.int32, b: wp.int32):
        return wp.where(mask, a, b)

    @wp.func
    def element(x: real, l: wp.int32):
        return x

    @wp.func
    def whole_element(x: wp.int32, l: wp.int32):
        return x

    @wp.func
    def reals_at(table: reals_by_slot, j: wp.int32):
        return table[j]

    @wp.func
    def integers_at(table: integers_by_slot, j: wp.int32):
        return table[j]

    @wp.func
    def with_reals(table: reals_by_slot, j: wp.int32, v: real):
        out = table
        out[j] = v
        return out

    @wp.func
    def with_integers(table: integers_by_slot, j: wp.int32, v: wp.int32):
        out = table
        out[j] = v
        return out

    @wp.func
    def empty_ids():
        return integers_by_slot(-1)

    return SimpleNamespace(
        above=above,
        both=both,
        either=either,
        any_of=any_of,
        none_of=none_of,
        whole=whole,
        pick_integers=pick_integers,
        element=element,
        whole_element=whole_element,
        reals_by_slot=reals_by_slot,
        integers_by_slot=integers_by_slot,
        reals_at=reals_at,
        integers_at=integers_at,
        with_reals=with_reals,
        with_integers=with_integers,
        empty_ids=empty_ids,
    )


def _simd_block(real: type, width: int, slots: int) -> SimpleNamespace:
    f, s = simd_functions(real, width), slot_functions(real, width, slots)
    reals, integers, integer = f.reals, f.integers, f.integer
    integers_by_slot = s.integers_by_slot

    @wp.func
    def none_of():
        return integers()

    @wp.func
    def whole(x: wp.int32):
        return integers(integer(x))

    @wp.func
    def element(x: reals, l: wp.int32):
        return x[l]

    @wp.func
    def whole_element(x: integers, l: wp.int32):
        return wp.int32(x[l])

    @wp.func
    def empty_ids():
        return integers_by_slot(integer(-1))

    return SimpleNamespace(
        above=f.above,
        both=f.both,
        either=f.either,
        any_of=f.any_of,
        none_of=none_of,
        whole=whole,
        pick_integers=f.pick_integers,
        element=element,
        whole_element=whole_element,
        empty_ids=empty_ids,
        **vars(s),
    )


@functools.cache
def block_functions(real: type, width: int, slots: int) -> SimpleNamespace:
    """Make the functions of values, masks and tables of a block: those of `simd_functions`, for width 1 too."""
    block = _scalar_block(real, slots) if width == 1 else _simd_block(real, width, slots)
    return SimpleNamespace(**(vars(simd_functions(real, width)) | vars(block)))


@functools.cache
def block_view(real: type, width: int, low_pass: bool, tile_size: int) -> SimpleNamespace:
    """Make the functions that tell a thread its pixels, its rays and the block that is culled for.

    `threads` is their number in a tile.
    """
    t = types(real)
    vec2, vec4, mat33 = t.vec2, t.vec4, t.mat33
    if width == 1:
        w = walk_functions(real, low_pass, tile_size)
        pixel_of, block_of = w.pixel_of, w.block_of

        @wp.func
        def start_of(thread: int, tile_columns: int, size: wp.vec2i, Ks: wp.array(dtype=mat33)):
            xy, inside, d, intrinsics = pixel_of(thread, tile_columns, size, Ks)
            return xy, inside, d[0], d[1], intrinsics

        return SimpleNamespace(start_of=start_of, block_of=block_of, threads=w.pixels)
    view = strip_functions(real, tile_size)
    strip_of, rays_of, middle_of, half_strip = view.strip_of, view.rays_of, view.middle_of, view.half_strip
    intrinsics_of = frame_functions(real).intrinsics_of
    f = simd_functions(real, width)
    integers, integer = f.integers, f.integer
    HALF = t.HALF

    @wp.func
    def start_of(thread: int, tile_columns: int, size: wp.vec2i, Ks: wp.array(dtype=mat33)):
        xy = strip_of(thread, tile_columns)
        intrinsics = intrinsics_of(Ks)
        dx, dy = rays_of(xy, intrinsics)
        alive = integers()
        if xy[1] < size[1]:
            for l in range(wp.static(width)):
                if xy[0] + l < size[0]:
                    alive[l] = integer(-1)
        return xy, alive, dx, dy, intrinsics

    @wp.func
    def block_of(xy: wp.vec2i, intrinsics: vec4):
        y = (real(float(xy[1])) + HALF - intrinsics[3]) / intrinsics[1]
        middle = middle_of(xy, y, intrinsics)
        half = half_strip(intrinsics)
        return vec2(middle[0], middle[1]), vec2(half[0], half[1])

    return SimpleNamespace(start_of=start_of, block_of=block_of, threads=view.strips)


@functools.cache
def collect_block_kernel(real: type, max_hits: int, low_pass: bool, tile_size: int, simd: bool) -> wp.Kernel:
    """Make the forward kernel, for one pixel a thread or for a strip of them; arguments as of `collect`."""
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    width = strip_width(tile_size) if simd else 1
    h = hit_functions(real, low_pass, width)
    load = load_function(4, real)
    f = block_functions(real, width, max(max_hits, 1))
    reals, splat, times, below, pick = f.reals, f.splat, f.times, f.below, f.pick
    above, both, either, any_of, none_of, pick_integers = (
        f.above,
        f.both,
        f.either,
        f.any_of,
        f.none_of,
        f.pick_integers,
    )
    whole, element, whole_element, empty_ids = f.whole, f.element, f.whole_element, f.empty_ids
    reals_by_slot = f.reals_by_slot
    reals_at, integers_at, with_reals, with_integers = f.reals_at, f.integers_at, f.with_reals, f.with_integers
    view = block_view(real, width, low_pass, tile_size)
    threads = view.threads
    ALPHA_MIN, TRANSMITTANCE_MIN, ONE = t.ALPHA_MIN, t.TRANSMITTANCE_MIN, t.ONE

    # Apart from the walk, by copies: what the walk works on is never indexed by a variable and stays in registers.
    @wp.func
    def write(
        xy: wp.vec2i,
        size: wp.vec2i,
        red: reals,
        green: reals,
        blue: reals,
        transmittance: reals,
        stop: f.integers if simd else wp.int32,
        buffer_red: reals_by_slot,
        buffer_green: reals_by_slot,
        buffer_blue: reals_by_slot,
        buffer_weights: reals_by_slot,
        buffer_ids: f.integers_by_slot,
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
            plain[p] = vec3(element(red, l), element(green, l), element(blue, l))
            kept = vec3()
            for j in range(wp.static(max_hits)):
                weight = element(reals_at(buffer_weights, j), l)
                kept += (
                    vec3(
                        element(reals_at(buffer_red, j), l),
                        element(reals_at(buffer_green, j), l),
                        element(reals_at(buffer_blue, j), l),
                    )
                    * weight
                )
                ids[p, j] = whole_element(integers_at(buffer_ids, j), l)
                depths[p, j] = element(reals_at(buffer_depths, j), l)
                weights[p, j] = weight
            base[p] = kept
            alphas[p] = ONE - element(transmittance, l)
            stops[p] = whole_element(stop, l)

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32 and not simd},
    )
    def collect_block(
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
        xy, alive, dx, dy, intrinsics = view.start_of(thread, tile_columns, size, Ks)
        middle, half = view.block_of(xy, intrinsics)
        focal = vec2(intrinsics[0], intrinsics[1])
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(thread // threads, tile_offsets, ends, overflow)
        one = splat(ONE)
        transmittance = splat(ONE)
        red = reals(real(0.0))
        green = reals(real(0.0))
        blue = reals(real(0.0))
        buffer_ids = empty_ids()
        buffer_weights = reals_by_slot()
        buffer_depths = reals_by_slot()
        buffer_red = reals_by_slot()
        buffer_green = reals_by_slot()
        buffer_blue = reals_by_slot()
        stop = whole(bounds[0])
        lane = lane_index()
        for batch in range(bounds[0], bounds[1], warp_size()):
            if any_in_warp(wp.where(any_of(alive), 1, 0)) == 0:
                break
            mine = int(-1)
            if batch + lane < bounds[1]:
                mine = surfel_at(batch + lane, surfel_ids, order, overflow)
                # One pixel alone tests as fast by itself.
                if warp_size() > 1 or wp.static(width > 1):
                    at = vec3()
                    if wp.static(low_pass):
                        at = centers[mine]
                    m = load(records, mine, 3)[3]
                    a = load(records, mine, 0)
                    b = load(records, mine, 1)
                    n = load(records, mine, 2)
                    if h.misses_block(a, b, n, m, reaches[mine], limits[mine], at, middle, half, focal):
                        mine = int(-1)
            left = ballot(wp.where(mine >= 0, 1, 0))
            while left != 0:
                source = lowest_lane(left)
                left = left & (left - 1)
                i = from_lane(mine, source)
                if any_of(alive):
                    ra = load(records, i, 0)
                    rb = load(records, i, 1)
                    rn = load(records, i, 2)
                    rc = load(records, i, 3)
                    center = vec3()
                    if wp.static(low_pass):
                        center = centers[i]
                    u, v, depth = h.plane(ra, rb, rn, rc[3], dx, dy)
                    alpha = reals(real(0.0))
                    if wp.static(width > 1):
                        alpha, depth = h.kernel(u, v, depth, ra, rb, rn, center, dx, dy, focal, near)
                    elif warp_size() > 1 or not h.far_outside(u, v, limits[i]):
                        alpha, depth = h.kernel(u, v, depth, ra, rb, rn, center, dx, dy, focal, near)
                    counts = both(above(alpha, splat(ALPHA_MIN), True), above(depth, splat(near), False))
                    seen = both(counts, alive)
                    if any_of(seen):
                        alpha = pick(seen, alpha, splat(real(0.0)))
                        out_weight = times(alpha, transmittance)
                        transmittance = times(transmittance, one - alpha)
                        stop = pick_integers(seen, whole(batch + source + 1), stop)
                        # Pixels without a hit insert the weight 0, which displaces nothing and adds nothing.
                        displaced = none_of()
                        out_id = whole(i)
                        out_depth = depth
                        out_red = splat(rc[0])
                        out_green = splat(rc[1])
                        out_blue = splat(rc[2])
                        for j in range(wp.static(max_hits)):
                            w_ = reals_at(buffer_weights, j)
                            displaced = either(displaced, below(w_, out_weight))
                            i_ = integers_at(buffer_ids, j)
                            d_ = reals_at(buffer_depths, j)
                            r_ = reals_at(buffer_red, j)
                            g_ = reals_at(buffer_green, j)
                            b_ = reals_at(buffer_blue, j)
                            buffer_weights = with_reals(buffer_weights, j, pick(displaced, out_weight, w_))
                            buffer_ids = with_integers(buffer_ids, j, pick_integers(displaced, out_id, i_))
                            buffer_depths = with_reals(buffer_depths, j, pick(displaced, out_depth, d_))
                            buffer_red = with_reals(buffer_red, j, pick(displaced, out_red, r_))
                            buffer_green = with_reals(buffer_green, j, pick(displaced, out_green, g_))
                            buffer_blue = with_reals(buffer_blue, j, pick(displaced, out_blue, b_))
                            out_weight = pick(displaced, w_, out_weight)
                            out_id = pick_integers(displaced, i_, out_id)
                            out_depth = pick(displaced, d_, out_depth)
                            out_red = pick(displaced, r_, out_red)
                            out_green = pick(displaced, g_, out_green)
                            out_blue = pick(displaced, b_, out_blue)
                        red += times(out_red, out_weight)
                        green += times(out_green, out_weight)
                        blue += times(out_blue, out_weight)
                        alive = both(alive, above(transmittance, splat(TRANSMITTANCE_MIN), True))
        if xy[0] >= size[0] or xy[1] >= size[1]:
            return
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

    return collect_block
