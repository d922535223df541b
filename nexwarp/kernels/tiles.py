"""Tile polygons (paper Sec. 3, after 3DGS), of which `tile_lists` makes lists. A thread is a surfel.

Written is what only culls: nothing here is differentiated.

A surfel's support, the rectangle |u| <= (2 ln 255 o)^(1/(2 g1)), likewise v, is clipped at the near plane and
projected: a convex polygon of at most five corners, the tile polygon. A tile row's slab cuts out one span of it, so the
tiles that the polygon touches are listed exactly, not those of its bounding box. The support only culls; alpha >= 1/255
decides.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from nexwarp.kernels.activate import unit
from nexwarp.kernels.shape import reach
from nexwarp.kernels.surfel import axes, intrinsics_of, rotate, translation
from nexwarp.kernels.types import Real, Vec2, Vec3, Vec4, per_real
from nexwarp.native.vector_loads import load_pair
from nexwarp.native.warp import tile_size

# Pixels added around the polygon: rounding must never cull a hit.
MARGIN = 0.01
RELATIVE_MARGIN = 1e-6
LARGEST = 1e30
HUGE = wp.constant(wp.float64(LARGEST))
SHORT_OF_NEAR = wp.constant(wp.float64(0.999))
# Of a quad that one plane clips.
MAX_CORNERS = 5
LARGEST_INT = 2**31 - 1
# Of the lists: the arrays that are sorted are twice as long, and indices are int32.
MAX_ENTRIES = 2**30 - 1


@wp.func
def pixel_of_point(x: Vec3, intrinsics: Vec4):
    """Pixel coordinates of a point in the camera frame."""
    return wp.vector(intrinsics[0] * x[0] / x[2] + intrinsics[2], intrinsics[1] * x[1] / x[2] + intrinsics[3])


@wp.func
def tile_index(x: Real, count: int):
    """Tile index of x (in tiles)."""
    # Clamped before the cast: int of a huge float is undefined.
    return int(wp.clamp(wp.floor(x), type(x)(-1.0), type(x)(float(count))))


@wp.func
def near_plane(near: Real, center: Vec3):
    """Depth at which supports are clipped."""
    plane = near * type(near)(SHORT_OF_NEAR)
    if not (plane > type(near)(0.0)):
        # With near = 0, hits closer than a millionth of the surfel's distance are given up: nothing bounds where.
        plane = wp.length(center) * type(near)(1.0e-6)
    return plane


@wp.func
def clip(i: int, quad: Any, plane: Real, intrinsics: Vec4, corners: Any):
    """Clip a quad (4, 3) at the near plane; return (number of corners, least and largest x and y, least depth)."""
    huge = type(plane)(HUGE)
    low = wp.vector(huge, huge)
    high = wp.vector(-huge, -huge)
    nearest = type(plane)(HUGE)
    count = int(0)
    for k in range(4):
        p = quad[k]
        q = quad[(k + 1) % 4]
        if p[2] >= plane:
            x = pixel_of_point(p, intrinsics)
            corners[i, count] = x
            count += 1
            low = wp.min(low, x)
            high = wp.max(high, x)
            nearest = wp.min(nearest, p[2])
        if (p[2] >= plane) != (q[2] >= plane):
            cut = p + (q - p) * ((plane - p[2]) / (q[2] - p[2]))
            cut[2] = plane
            x = pixel_of_point(cut, intrinsics)
            # Five corners at most; rounding cannot make a sixth of a convex quad.
            nearest = plane
            if count < MAX_CORNERS:
                corners[i, count] = x
                count += 1
                low = wp.min(low, x)
                high = wp.max(high, x)
    return count, low, high, nearest


@per_real()
def tile_polygon(
    first: int,
    surfels: Parameters,
    viewmats: mat44s,
    Ks: mat33s,
    near: real,
    tile_rows: int,
    # outputs
    reaches: vec2s,
    polygons: Polygons,
):
    i = first + wp.tid()
    side = real(float(tile_size()))
    # Nothing to see: no corners, and no rows.
    polygons.shapes[i] = wp.vec3i(0, 0, -1)
    polygons.margins[i] = ZERO
    extent = reach(surfels.opacities[i], surfels.gammas[i])
    reaches[i] = extent
    if not (extent[0] > ZERO):
        return
    viewmat = viewmats[0]
    intrinsics = intrinsics_of(Ks[0])
    x_axis, y_axis, _normal = axes(unit(surfels.quats[i]))
    center = rotate(viewmat, surfels.means[i]) + translation(viewmat)
    v1 = rotate(viewmat, x_axis) * (surfels.scales[i][0] * extent[0])
    v2 = rotate(viewmat, y_axis) * (surfels.scales[i][1] * extent[1])
    quad = wp.matrix(shape=(4, 3), dtype=real)
    for k in range(4):
        s1 = wp.where(k == 0 or k == 3, ONE, -ONE)
        s2 = wp.where(k < 2, ONE, -ONE)
        quad[k] = center + v1 * s1 + v2 * s2
    count, low, high, nearest = clip(i, quad, near_plane(near, center), intrinsics, polygons.corners)
    if count == 0:
        return
    size = wp.max(wp.max(wp.abs(low[0]), wp.abs(low[1])), wp.max(wp.abs(high[0]), wp.abs(high[1])))
    if not (size < LARGEST):
        # Too large for arithmetic, or not a number: list it everywhere, the walk decides.
        for k in range(4):
            x = wp.where(k == 0 or k == 3, -LARGEST, LARGEST)
            polygons.corners[i, k] = vec2(x, wp.where(k < 2, -LARGEST, LARGEST))
        polygons.shapes[i] = wp.vec3i(4, 0, tile_rows - 1)
        return
    # A corner is known to a rounding of the extent: pixels by the focal length over the depth.
    diameter = wp.length(center) + wp.length(v1) + wp.length(v2)
    blur = RELATIVE_MARGIN * diameter * wp.max(intrinsics[0], intrinsics[1]) / nearest
    margin = MARGIN + RELATIVE_MARGIN * size + blur
    # A tile's samples are its pixel centres, half a pixel inside its border.
    y0 = tile_index((low[1] - margin + HALF) / side - ONE, tile_rows)
    y1 = tile_index((high[1] + margin - HALF) / side, tile_rows)
    polygons.margins[i] = margin
    polygons.shapes[i] = wp.vec3i(count, wp.max(y0, 0), wp.min(y1, tile_rows - 1))


@wp.func
def reached(low: Real, high: Real, p: Vec2, q: Vec2, y: Real):
    """(least, largest) x with that of the edge from p to q at a height y, if it gets there."""
    if (p[1] < y) != (q[1] < y):
        x = p[0] + (q[0] - p[0]) * ((y - p[1]) / (q[1] - p[1]))
        low = wp.min(low, x)
        high = wp.max(high, x)
    return low, high


@wp.func
def span(i: int, row: int, tile_columns: int, count: int, polygons: Any):
    """First and last tile of a tile row that the tile polygon touches; first > last when none."""
    margin = polygons.margins[i]
    side = type(margin)(float(tile_size()))
    half = type(margin)(0.5)
    one = type(margin)(1.0)
    top = type(margin)(float(row)) * side + half - margin
    bottom = type(margin)(float(row + 1)) * side - half + margin
    low = type(margin)(HUGE)
    high = -type(margin)(HUGE)
    if count > 0:
        p = load_pair(polygons.corners, i, count - 1)
        for k in range(count):
            q = load_pair(polygons.corners, i, k)
            if q[1] >= top and q[1] <= bottom:
                low = wp.min(low, q[0])
                high = wp.max(high, q[0])
            low, high = reached(low, high, p, q, top)
            low, high = reached(low, high, p, q, bottom)
            p = q
    if not (low <= high):
        return wp.vec2i(0, -1)
    left = (low - margin + half) / side - one
    x0 = tile_index(left, tile_columns)
    if left > type(margin)(float(x0)):
        x0 += 1
    x1 = tile_index((high + margin - half) / side, tile_columns)
    return wp.vec2i(wp.max(x0, 0), wp.min(x1, tile_columns - 1))
