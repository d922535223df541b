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
from typing import Any

import warp as wp

from nexwarp.kernels.collect import hit_buffer
from nexwarp.kernels.shape import reach
from nexwarp.kernels.surfel import hit_alpha
from nexwarp.kernels.types import Mat33, Real, Vec2, Vec3, Vec4, types
from nexwarp.kernels.walk import tile_of
from nexwarp.native.vector_loads import load_record, record_row
from nexwarp.native.warp import tile_size

# Relative to the lengths of the vectors: what rounding may change in the sums that decide whether a tile is culled.
SLACK = wp.constant(wp.float64(1e-5))
# Half extent of a tile whose rays no rectangle bounds: it lists all surfels.
UNBOUNDED = 1e30
LARGE = wp.constant(wp.float64(UNBOUNDED * 0.5))


@wp.func
def turned(frame: Mat33, x: Vec4):
    """Row of a record in a tile's frame."""
    return frame * wp.vector(x[0], x[1], x[2])


@wp.func
def beyond(side: Vec3, across: Vec3, middle: Vec2, half: Vec2):
    """Whether all rays of a block meet the plane where a coordinate is above its reach; see `walk.beside`."""
    p = side - across
    above = p[0] * middle[0] + p[1] * middle[1] + p[2] - wp.abs(p[0]) * half[0] - wp.abs(p[1]) * half[1]
    size = p.dtype(1.0) + wp.abs(middle[0]) + wp.abs(middle[1]) + half[0] + half[1]
    return above > p.dtype(SLACK) * (wp.length(side) + wp.length(across)) * size


@wp.func
def misses(records: Any, i: int, facing: Real, extent: Vec2, bounds: Any, block: int):
    """Whether no ray of a block can hit a surfel. Where it can, facing * n . ray > 0."""
    half = bounds.halves[block]
    middle = bounds.middles[block]
    frame = bounds.frames[block]
    if half[0] > type(facing)(LARGE):
        return False
    a = turned(frame, records[i, 0])
    b = turned(frame, records[i, 1])
    n = turned(frame, records[i, 2]) * facing
    u = n * extent[0]
    v = n * extent[1]
    out = beyond(a, u, middle, half) or beyond(-a, u, middle, half)
    out = out or beyond(b, v, middle, half) or beyond(-b, v, middle, half)
    # Behind the rays altogether: n . ray never has the sign of a hit.
    return out or beyond(-n, type(n)(), middle, half)


@functools.cache
def ray_list_kernel(real: type) -> wp.Kernel:
    """Make the kernel that counts or emits entries, one thread a surfel in depth order."""
    t = types(real)
    vec2, vec4, ZERO = t.vec2, t.vec4, t.ZERO

    @wp.kernel(enable_backward=False, module="unique")
    def ray_lists(  # noqa: PLR0913  # a kernel entry point
        first: wp.int32,
        order: wp.array(dtype=wp.int32),
        records: wp.array2d(dtype=vec4),
        facings: wp.array(dtype=real),
        tiles: t.Bounds,
        blocks: t.Bounds,
        grid: wp.vec2i,
        span: wp.int32,
        ends: wp.array(dtype=wp.int64),
        # outputs
        counts: wp.array(dtype=wp.int64),
        tile_ids: wp.array(dtype=wp.int32),
        surfels: wp.array(dtype=wp.int32),
    ):
        rank = first + wp.tid()
        i = order[rank]
        extent = reach(records[i, 0][3], vec2(records[i, 1][3], records[i, 2][3]))
        facing = facings[i]
        emitting = ends.shape[0] > 0
        at = wp.int64(0)
        if emitting and rank > 0:
            at = ends[rank - 1]
        start = at
        columns = (grid[0] + span - 1) // span
        # A surfel that is too transparent to be hit has no reach; one without a facing side is seen edge-on by all.
        if extent[0] > ZERO and facing != ZERO:
            for block in range(blocks.frames.shape[0]):
                if not misses(records, i, facing, extent, blocks, block):
                    row0 = (block // columns) * span
                    column0 = (block % columns) * span
                    for row in range(row0, wp.min(row0 + span, grid[1])):
                        for column in range(column0, wp.min(column0 + span, grid[0])):
                            tile = row * grid[0] + column
                            if not misses(records, i, facing, extent, tiles, tile):
                                if emitting:
                                    tile_ids[at] = tile
                                    surfels[at] = i
                                at += wp.int64(1)
        if not emitting:
            counts[rank] = at - start

    return ray_lists


@wp.func
def product(row: Vec4, ray: Vec3):
    """Product of a record's row, without its last scalar, and a ray."""
    return row[0] * ray[0] + row[1] * ray[1] + row[2] * ray[2]


@wp.func
def ray_hit(surfels: Any, i: int, a: Vec4, b: Vec4, n: Vec4, m: Real, ray: Vec3):
    """(u, v, t) where a ray meets the surfel's plane."""
    inverse = type(m)(1.0) / product(n, ray)
    if surfels.planes:
        m = wp.dot(surfels.planes[i], ray)
    return product(a, ray) * inverse, product(b, ray) * inverse, m * inverse


@wp.func
def facing_normal(surfels: Any, i: int, ray: Vec3):
    """Normal of the side that faces the ray; parallel rays go along z."""
    n = surfels.normals[i]
    side = wp.dot(n, ray)
    if surfels.planes:
        side = n[2]
    if side > type(side)(0.0):
        return -n
    return n


@functools.cache
def collect_rays_kernel(real: type, max_hits: int) -> wp.Kernel:
    """Make the collection kernel: a thread is a pixel, and walks its tile's list.

    Written is what `collect` writes but `stops`, and what `surface` writes, of the same hits in the same way: depths
    are t, and a normal faces the ray.
    """
    t = types(real)
    vec3 = t.vec3
    buffer = hit_buffer(real, max_hits)
    ALPHA_MIN, TRANSMITTANCE_MIN, ZERO, HALF, ONE = t.ALPHA_MIN, t.TRANSMITTANCE_MIN, t.ZERO, t.HALF, t.ONE

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": real is wp.float32},
    )
    def collect_rays(
        first: wp.int32,
        surfels: t.RaySurfels,
        surfel_ids: wp.array(dtype=wp.int32),
        tile_offsets: wp.array(dtype=wp.int64),
        rays: wp.array(dtype=vec3),
        view: t.View,
        hits: t.Hits,
        surface: t.Surface,
    ):
        thread = first + wp.tid()
        side = tile_size()
        tile = tile_of(thread)
        local = thread % (side * side)
        x = (tile % view.tile_columns) * side + local % side
        y = (tile // view.tile_columns) * side + local // side
        if x >= view.size[0] or y >= view.size[1]:
            return
        p = y * view.size[0] + x
        ray = rays[p]
        transmittance = real(1.0)
        color = vec3()
        ids, weights = buffer.empty()
        total = real(0.0)
        depths = real(0.0)
        median = real(0.0)
        heaviest = real(0.0)
        top = real(0.0)
        normals = vec3()
        k = tile_offsets[tile]
        end = tile_offsets[tile + 1]
        if ray[0] == ZERO and ray[1] == ZERO and ray[2] == ZERO:
            k = end
        while k < end:
            i = surfel_ids[k]
            k += wp.int64(1)
            a, b, n, c = load_record(surfels.records, i)
            u, v, depth = ray_hit(surfels, i, a, b, n, c[3], ray)
            alpha = hit_alpha(a, b, n, u, v, surfels.limits[i])
            if alpha >= ALPHA_MIN and depth > view.near:
                weight = alpha * transmittance
                if transmittance > HALF:
                    median = depth
                if weight > heaviest:
                    heaviest = weight
                    top = depth
                normals += facing_normal(surfels, i, ray) * weight
                total += weight
                depths += weight * depth
                transmittance = transmittance * (ONE - alpha)
                # Insert it into the buffer and take out the lightest, as `collect` does.
                displaced = bool(False)
                for j in range(wp.static(max_hits)):
                    w_ = weights[j]
                    i_ = ids[j]
                    displaced = displaced or weight > w_
                    weights[j] = wp.where(displaced, weight, w_)
                    ids[j] = wp.where(displaced, i, i_)
                    weight = wp.where(displaced, w_, weight)
                    i = wp.where(displaced, i_, i)
                c = record_row(surfels.records, wp.max(i, 0), 3)
                color += vec3(c[0], c[1], c[2]) * weight
                if transmittance < TRANSMITTANCE_MIN:
                    k = end
        base = vec3()
        for j in range(wp.static(max_hits)):
            i = ids[j]
            depth = real(0.0)
            if i >= 0:
                a, b, n, c = load_record(surfels.records, i)
                base += vec3(c[0], c[1], c[2]) * weights[j]
                u, v, depth = ray_hit(surfels, i, a, b, n, c[3], ray)
            hits.ids[p, j] = i
            hits.depths[p, j] = depth
            hits.weights[p, j] = weights[j]
        hits.plain[p] = color
        hits.base[p] = base
        hits.alphas[p] = ONE - transmittance
        surface.expected[p] = wp.where(total > ZERO, depths / total, ZERO)
        surface.median[p] = median
        surface.top[p] = top
        surface.normals[p] = normals

    return collect_rays
