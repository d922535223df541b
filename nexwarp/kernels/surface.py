"""Depths and normals over all hits that `collect` blended, not only the K heaviest (not in the paper).

A thread is a pixel (see `walk`). It takes the walk that `collect` took, as far as `stops` says. Read: what `collect`
read. Written, with w = alpha * transmittance the weight (paper Sec. 4.2), t the z-depth and n the normal of a hit:

    expected    sum of w t / sum of w
    median      t of the hit that takes the transmittance to 1/2 or below; of the last hit where it stays above
    top         t of the heaviest hit, on a tie of the nearer one
    normals     sum of w n, camera frame, each n on the side that faces the camera; not normalised
    distortion  sum over i of w_i |A_i t_i - D_i|, where A_i = sum of w_j and D_i = sum of w_j t_j over j < i

All are 0 where nothing is hit. The distortion is the sum over pairs of w_i w_j |t_i - t_j| (2DGS), in linear time,
where hits come in the order of their depths; elsewhere it is less. `surface_backward` differentiates all five. It needs
`totals`, (sum of w, sum of w s, sum of w s t) with s the sign of A t - D and t less that of the first hit, and `picks`,
the places in the list of the hits of the median and the top depth, -1 where nothing is hit; both may be left out.
"""

import functools

import warp as wp

from nexwarp.kernels.surfel import hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import overflowed, walk, walk_functions
from nexwarp.native.vector_loads import record_row_function
from nexwarp.native.warp import ballot, from_lane, lane_index, lowest_lane, warp_max, warp_size


@functools.cache
def surface_kernel(real: type, low_pass: bool, tile_size: int) -> wp.Kernel:
    """Make the kernel."""
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    h = hit_functions(real, low_pass)
    load = record_row_function(real)
    w = walk_functions(real, low_pass, tile_size)
    pixels = w.pixels
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
        reaches: wp.array(dtype=vec2),
        stops: wp.array(dtype=wp.int32),
        # outputs
        expected: wp.array(dtype=real),
        median: wp.array(dtype=real),
        top: wp.array(dtype=real),
        normals: wp.array(dtype=vec3),
        distortion: wp.array(dtype=real),
        totals: wp.array(dtype=vec3),
        picks: wp.array(dtype=wp.vec2i),
    ):
        thread = first + wp.tid()
        xy, inside, d, intrinsics = w.pixel_of(thread, tile_columns, size, Ks)
        middle, half = w.block_of(xy, intrinsics)
        focal = vec2(intrinsics[0], intrinsics[1])
        stop = int(0)
        if inside:
            stop = stops[xy[1] * size[0] + xy[0]]
        transmittance = real(1.0)
        weights = real(0.0)
        depths = real(0.0)
        median_depth = real(0.0)
        heaviest = real(0.0)
        top_depth = real(0.0)
        normal = vec3()
        # Depths that are compared count from the first hit's: differences of near ones keep their digits.
        start = real(0.0)
        shifted = real(0.0)
        spread = real(0.0)
        signs = real(0.0)
        signed_depths = real(0.0)
        pick = wp.vec2i(-1, -1)
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
                if batch + source < stop:
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
                            median_depth = depth
                            pick[0] = batch + source
                        if weight > heaviest:
                            heaviest = weight
                            top_depth = depth
                            pick[1] = batch + source
                        if weights == ZERO:
                            start = depth
                        z = depth - start
                        gap = weights * z - shifted
                        side = wp.sign(gap) * weight
                        if gap == ZERO:
                            side = ZERO
                        spread += weight * wp.abs(gap)
                        signs += side
                        signed_depths += side * z
                        shifted += weight * z
                        n = vec3(rn[0], rn[1], rn[2])
                        if n[0] * d[0] + n[1] * d[1] + n[2] > ZERO:
                            n = -n
                        normal += n * weight
                        weights += weight
                        depths += weight * depth
                        transmittance = transmittance * (ONE - alpha)
        if not inside:
            return
        if weights > ZERO:
            depths = depths / weights
        p = xy[1] * size[0] + xy[0]
        expected[p] = depths
        median[p] = median_depth
        top[p] = top_depth
        normals[p] = normal
        distortion[p] = spread
        if picks:
            totals[p] = vec3(weights, signs, signed_depths)
            picks[p] = pick

    return surface
