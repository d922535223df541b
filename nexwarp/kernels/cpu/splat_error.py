"""SIMD form of `splat_error`, for CPUs: a thread is a strip of pixels, as in `cpu.collect`.

Read and added to is what the kernel of `splat_error` reads and adds to; a test compares the forms. It uses the
arithmetic of `cpu.collect`, so a pixel's walk ends at the same entry.
"""

import functools

import warp as wp

from nexwarp.kernels.cpu.collect import strip_functions, strip_width
from nexwarp.kernels.surfel import frame_functions, hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import overflowed, surfel_at, walk
from nexwarp.native.simd import simd_functions


@functools.cache
def splat_error_simd_kernel(real: type, low_pass: bool, tile_size: int) -> wp.Kernel:
    """Make the kernel."""
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    intrinsics_of = frame_functions(real).intrinsics_of
    width = strip_width(tile_size)
    h = hit_functions(real, low_pass, width)
    f = simd_functions(real, width)
    reals, integers, integer = f.reals, f.integers, f.integer
    view = strip_functions(real, tile_size)
    strips = view.strips
    ALPHA_MIN, ONE = t.ALPHA_MIN, t.ONE

    @wp.kernel(enable_backward=False, grid_stride=False, module="unique")
    def splat_error_simd(
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
        stops: wp.array(dtype=wp.int32),
        errors: wp.array(dtype=real),
        # outputs
        sums: wp.array(dtype=real),
    ):
        thread = first + wp.tid()
        xy = view.strip_of(thread, tile_columns)
        if xy[0] >= size[0] or xy[1] >= size[1]:
            return
        intrinsics = intrinsics_of(Ks)
        focal = vec2(intrinsics[0], intrinsics[1])
        dx, y = view.rays_of(xy, intrinsics)
        stop = integers()  # 0 outside the image
        error = reals()
        last = int(0)
        for l in range(wp.static(width)):
            if xy[0] + l < size[0]:
                p = xy[1] * size[0] + xy[0] + l
                stop[l] = integer(stops[p])
                error[l] = errors[p]
                last = wp.max(last, stops[p])
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
            u, v, depth = h.plane(ra, rb, rn, rc[3], dx, y)
            alpha, depth = h.kernel(u, v, depth, ra, rb, rn, center, dx, y, focal, near)
            seen = f.both(f.above(alpha, reals(ALPHA_MIN), True), f.above(depth, reals(near), False))
            seen = f.both(seen, f.less_integers(integers(integer(k)), stop))
            if not f.any_of(seen):
                continue
            alpha = f.pick(seen, alpha, reals())
            slot = int(i)
            if k < gradient_slots.shape[0]:
                slot = gradient_slots[k]
            wp.atomic_add(sums, slot, f.inner(f.times(alpha, transmittance), error))
            transmittance = f.times(transmittance, one - alpha)

    return splat_error_simd
