"""Cameras of any rays: their tile lists and their collection pass (not in the paper, which has pinholes only).

A pixel has a ray (x, y, z); (0, 0, 0) is none. A surfel's record, as in `surfel`, gives

    u = (a . ray) / (n . ray)      v = (b . ray) / (n . ray)      t = (g . ray) / (n . ray)

For rays through one point, the ray is its direction, and g . ray is m, the record's own. For parallel rays it is
(x, y, 1), the ray that begins at (x, y, 0) along z; `nexwarp.ops.rays` rewrites the records and g for these.

A tile bounds its rays (x, y, 1) by a rectangle, middle and half extents, in a frame of its own, whose z is the tile's
mean ray: so any tile of less than a half space has a bound. Lists are made over blocks of tiles first, then over their
tiles. They only cull; nothing is differentiated.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.surfel import hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import buffer_types
from nexwarp.native.vector_loads import load_function

# Relative to the lengths of the vectors: what rounding may change in the sums that decide whether a tile is culled.
SLACK = 1e-5
# Half extent of a tile whose rays no rectangle bounds: it lists all surfels.
UNBOUNDED = 1e30


@functools.cache
def ray_list_kernels(real: type) -> SimpleNamespace:
    """Make the kernels that count and emit (tile, surfel) entries, one thread a surfel, in depth order."""
    t = types(real)
    vec2, vec3, vec4, mat33, ZERO, ONE = t.vec2, t.vec3, t.vec4, t.mat33, t.ZERO, t.ONE
    SLACK_ = wp.constant(real(SLACK))
    LARGE = wp.constant(real(UNBOUNDED * 0.5))

    @wp.func
    def turned(frame: mat33, x: vec4):
        return frame * vec3(x[0], x[1], x[2])

    @wp.func
    def beyond(side: vec3, across: vec3, middle: vec2, half: vec2):
        """Whether all rays of a block meet the plane where a coordinate is above its reach; see `surfel.beside`."""
        p = side - across
        above = p[0] * middle[0] + p[1] * middle[1] + p[2] - wp.abs(p[0]) * half[0] - wp.abs(p[1]) * half[1]
        size = ONE + wp.abs(middle[0]) + wp.abs(middle[1]) + half[0] + half[1]
        return above > SLACK_ * (wp.length(side) + wp.length(across)) * size

    @wp.func
    def misses(
        records: wp.array2d(dtype=vec4), i: int, facing: real, reach: vec2, frame: mat33, middle: vec2, half: vec2
    ):
        """Whether no ray of a block can hit a surfel. Where it can, facing * n . ray > 0."""
        if half[0] > LARGE:
            return False
        a = turned(frame, records[i, 0])
        b = turned(frame, records[i, 1])
        n = turned(frame, records[i, 2]) * facing
        u = n * reach[0]
        v = n * reach[1]
        out = beyond(a, u, middle, half) or beyond(-a, u, middle, half)
        out = out or beyond(b, v, middle, half) or beyond(-b, v, middle, half)
        # Behind the rays altogether: n . ray never has the sign of a hit.
        return out or beyond(-n, vec3(), middle, half)

    @wp.kernel(enable_backward=False, module="unique")
    def lists(
        first: wp.int32,
        order: wp.array(dtype=wp.int32),
        records: wp.array2d(dtype=vec4),
        facings: wp.array(dtype=real),
        reaches: wp.array(dtype=vec2),
        frames: wp.array(dtype=mat33),
        middles: wp.array(dtype=vec2),
        halves: wp.array(dtype=vec2),
        outer_frames: wp.array(dtype=mat33),
        outer_middles: wp.array(dtype=vec2),
        outer_halves: wp.array(dtype=vec2),
        grid: wp.vec2i,
        span: wp.int32,
        ends: wp.array(dtype=wp.int64),
        # outputs
        counts: wp.array(dtype=wp.int64),
        tiles: wp.array(dtype=wp.int32),
        surfels: wp.array(dtype=wp.int32),
    ):
        rank = first + wp.tid()
        i = order[rank]
        reach = reaches[i]
        facing = facings[i]
        emitting = ends.shape[0] > 0
        e = wp.int64(0)
        if emitting and rank > 0:
            e = ends[rank - 1]
        found = wp.int64(0)
        outer_columns = (grid[0] + span - 1) // span
        # A surfel that is too transparent to be hit has no reach; one without a facing side is seen edge-on by all.
        if reach[0] > ZERO and facing != ZERO:
            for block in range(outer_frames.shape[0]):
                if not misses(
                    records, i, facing, reach, outer_frames[block], outer_middles[block], outer_halves[block]
                ):
                    row0 = (block // outer_columns) * span
                    column0 = (block % outer_columns) * span
                    for row in range(row0, wp.min(row0 + span, grid[1])):
                        for column in range(column0, wp.min(column0 + span, grid[0])):
                            tile = row * grid[0] + column
                            if not misses(records, i, facing, reach, frames[tile], middles[tile], halves[tile]):
                                if emitting:
                                    tiles[e + found] = tile
                                    surfels[e + found] = i
                                found += wp.int64(1)
        if not emitting:
            counts[rank] = found

    return SimpleNamespace(lists=lists)


@functools.cache
def collect_rays_kernel(real: type, max_hits: int, tile_size: int) -> wp.Kernel:
    """Make the collection kernel: a thread is a pixel, and walks its tile's list near to far.

    Written is what `collect` writes but `stops`, and what `surface` writes, of the same hits in the same way: depths
    are t, and a normal faces the ray.
    """
    t = types(real)
    vec2, vec3, vec4 = t.vec2, t.vec3, t.vec4
    h = hit_functions(real, False)
    load = load_function(4, real)
    vec, ivec, colors = buffer_types(real, max_hits)
    ALPHA_MIN, TRANSMITTANCE_MIN, ZERO, HALF, ONE = t.ALPHA_MIN, t.TRANSMITTANCE_MIN, t.ZERO, t.HALF, t.ONE
    pixels = tile_size * tile_size

    @wp.func
    def dot(x: vec4, ray: vec3):
        return x[0] * ray[0] + x[1] * ray[1] + x[2] * ray[2]

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32},
    )
    def collect_rays(
        first: wp.int32,
        records: wp.array2d(dtype=vec4),
        planes: wp.array(dtype=vec3),
        normals_of: wp.array(dtype=vec3),
        limits: wp.array(dtype=real),
        surfel_ids: wp.array(dtype=wp.int32),
        tile_offsets: wp.array(dtype=wp.int64),
        rays: wp.array(dtype=vec3),
        size: wp.vec2i,
        tile_columns: wp.int32,
        parallel: wp.int32,
        near: real,
        # outputs
        plain: wp.array(dtype=vec3),
        base: wp.array(dtype=vec3),
        ids: wp.array2d(dtype=wp.int32),
        depths: wp.array2d(dtype=real),
        weights: wp.array2d(dtype=real),
        alphas: wp.array(dtype=real),
        expected: wp.array(dtype=real),
        median: wp.array(dtype=real),
        top: wp.array(dtype=real),
        normals: wp.array(dtype=vec3),
    ):
        thread = first + wp.tid()
        tile = thread // pixels
        local = thread % pixels
        x = (tile % tile_columns) * tile_size + local % tile_size
        y = (tile // tile_columns) * tile_size + local // tile_size
        if x >= size[0] or y >= size[1]:
            return
        p = y * size[0] + x
        ray = rays[p]
        transmittance = real(1.0)
        color = vec3()
        buffer_ids = ivec()
        buffer_weights = vec()
        buffer_depths = vec()
        buffer_colors = colors()
        for j in range(wp.static(max_hits)):
            buffer_ids[j] = -1
        total = real(0.0)
        depth_sum = real(0.0)
        median_depth = real(0.0)
        heaviest = real(0.0)
        top_depth = real(0.0)
        normal = vec3()
        k = tile_offsets[tile]
        end = tile_offsets[tile + 1]
        if ray[0] == ZERO and ray[1] == ZERO and ray[2] == ZERO:
            k = end
        while k < end:
            i = surfel_ids[k]
            k += wp.int64(1)
            ra = load(records, i, 0)
            rb = load(records, i, 1)
            rn = load(records, i, 2)
            rc = load(records, i, 3)
            inverse = ONE / dot(rn, ray)
            u = dot(ra, ray) * inverse
            v = dot(rb, ray) * inverse
            depth = rc[3] * inverse
            if parallel == 1:
                depth = wp.dot(planes[i], ray) * inverse
            alpha = real(0.0)
            if not h.far_outside(u, v, limits[i]):
                alpha, depth = h.kernel(u, v, depth, ra, rb, rn, vec3(), ZERO, ZERO, vec2(), near)
            if alpha >= ALPHA_MIN and depth > near:
                weight = alpha * transmittance
                if transmittance > HALF:
                    median_depth = depth
                if weight > heaviest:
                    heaviest = weight
                    top_depth = depth
                n = normals_of[i]
                side = wp.dot(n, ray)
                if parallel == 1:
                    side = n[2]
                if side > ZERO:
                    n = -n
                normal += n * weight
                total += weight
                depth_sum += weight * depth
                transmittance = transmittance * (ONE - alpha)
                # As in `collect`: insert before the first lighter hit; what falls out is blended as plain.
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
                color += out_color * out_weight
                if transmittance < TRANSMITTANCE_MIN:
                    k = end
        kept = vec3()
        for j in range(wp.static(max_hits)):
            kept += vec3(buffer_colors[j, 0], buffer_colors[j, 1], buffer_colors[j, 2]) * buffer_weights[j]
            ids[p, j] = buffer_ids[j]
            depths[p, j] = buffer_depths[j]
            weights[p, j] = buffer_weights[j]
        plain[p] = color
        base[p] = kept
        alphas[p] = ONE - transmittance
        expected[p] = wp.where(total > ZERO, depth_sum / total, ZERO)
        median[p] = median_depth
        top[p] = top_depth
        normals[p] = normal

    return collect_rays
