"""Depth and normals of each pixel, over all hits that the collection pass blended, not only the K heaviest.

One thread a pixel walks the part of its tile's list that the collection pass walked, and writes

    expected    sum of weight * t / sum of weights
    median      t of the hit that takes the transmittance to 1/2, of the last hit where it stays above
    top         t of the heaviest hit
    normals     sum of weight * n, camera frame, each n on the side that faces the camera; not normalised

All are 0 where nothing is hit. Nothing is differentiable.
"""

import functools

import warp as wp

from nexwarp.kernels.native.vector_loads import load_function
from nexwarp.kernels.surfel import frame_functions, hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import overflowed, surfel_at, view_functions, walk


@functools.cache
def surface_kernel(real: type, low_pass: bool, tile_size: int) -> wp.Kernel:
    """Make the kernel."""
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    intrinsics_of = frame_functions(real).intrinsics_of
    h = hit_functions(real, low_pass)
    load = load_function(4, real)
    view = view_functions(real, tile_size)
    pixels = view.pixels
    ALPHA_MIN, ZERO, HALF, ONE = t.ALPHA_MIN, t.ZERO, t.HALF, t.ONE

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32},
    )
    def surface(
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
        stops: wp.array(dtype=wp.int32),
        # outputs
        expected: wp.array(dtype=real),
        median: wp.array(dtype=real),
        top: wp.array(dtype=real),
        normals: wp.array(dtype=vec3),
    ):
        thread = first + wp.tid()
        tile = thread // pixels
        xy = view.pixel_of(thread, tile_columns)
        if xy[0] >= size[0] or xy[1] >= size[1]:
            return
        p = xy[1] * size[0] + xy[0]
        stop = stops[p]
        intrinsics = intrinsics_of(Ks)
        focal = vec2(intrinsics[0], intrinsics[1])
        d = view.ray_of(xy, intrinsics)
        transmittance = real(1.0)
        weights = real(0.0)
        depths = real(0.0)
        middle = real(0.0)
        heaviest = real(0.0)
        heaviest_depth = real(0.0)
        normal = vec3()
        overflow = overflowed(ends, surfel_ids)
        bounds = walk(tile, tile_offsets, ends, overflow)
        for k in range(bounds[0], bounds[1]):
            if k >= stop:
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
            if not h.far_outside(u, v, limits[i]):
                alpha, depth = h.kernel(u, v, depth, ra, rb, rn, center, d[0], d[1], focal, near)
            if alpha >= ALPHA_MIN and depth > near:
                weight = alpha * transmittance
                if transmittance > HALF:
                    middle = depth
                if weight > heaviest:
                    heaviest = weight
                    heaviest_depth = depth
                n = vec3(rn[0], rn[1], rn[2])
                if n[0] * d[0] + n[1] * d[1] + n[2] > ZERO:
                    n = -n
                normal += n * weight
                weights += weight
                depths += weight * depth
                transmittance = transmittance * (ONE - alpha)
        if weights > ZERO:
            depths = depths / weights
        expected[p] = depths
        median[p] = middle
        top[p] = heaviest_depth
        normals[p] = normal

    return surface
