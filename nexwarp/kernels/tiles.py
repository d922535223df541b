"""Tile lists (paper Sec. 3, after 3DGS): which surfels may be seen in which tile, near to far.

Here a surfel's tile polygon and where a tile row cuts it; `tile_lists` makes the lists of them. A thread is a surfel.
Written is what only culls: nothing here is differentiated.

A surfel's support, the rectangle |u| <= (2 ln 255 o)^(1/(2 g1)), likewise v, is clipped at the near plane and
projected: a convex polygon of at most five corners, the tile polygon. A tile row's slab cuts out one span of it, so the
tiles that the polygon touches are listed exactly, not those of its bounding box. The support only culls; alpha >= 1/255
decides.
"""

import functools

import warp as wp

from nexwarp.kernels.surfel import frame_functions
from nexwarp.kernels.types import types
from nexwarp.native.vector_loads import load_function

# Pixels added around the polygon: rounding must never cull a hit.
MARGIN = 0.01
RELATIVE_MARGIN = 1e-6
LARGEST = 1e30
# Of a quad that one plane clips.
MAX_CORNERS = 5
LARGEST_INT = 2**31 - 1
# Of the lists: the arrays that are sorted are twice as long, and indices are int32.
MAX_ENTRIES = 2**30 - 1


def check_entries(total: int, count: int, tiles: int) -> int:
    """Return the number of (tile, surfel) entries; ValueError when lists cannot be as long.

    Args:
        total: entries; LARGEST_INT stands for any larger number too.
        count: surfels, for the message.
        tiles: of the image, for the message.
    """
    if total > MAX_ENTRIES:
        found = f"{total:,}{' or more' if total >= LARGEST_INT else ''}"
        raise ValueError(
            f"surfels: expected at most {MAX_ENTRIES:,} (tile, surfel) entries, got {found}, of {count:,} surfels and "
            f"{tiles:,} tiles; render fewer or smaller surfels, or the image in parts (Camera.crop)"
        )
    return total


@functools.cache
def tile_polygon_kernel(real: type, low_pass: bool, tile_size: int) -> wp.Kernel:
    """Make the kernel that projects supports to polygons, one thread a surfel."""
    t = types(real)
    vec2, vec3, vec4, mat33, mat44 = t.vec2, t.vec3, t.vec4, t.mat33, t.mat44
    mat43 = wp.types.matrix(shape=(4, 3), dtype=real)
    f = frame_functions(real)
    ZERO, HALF, ONE, TWO = t.ZERO, t.HALF, t.ONE, t.TWO
    HUGE = wp.constant(real(LARGEST))
    SIZE = wp.constant(real(tile_size))
    RELATIVE = wp.constant(real(RELATIVE_MARGIN))
    index = index_function(real)

    @wp.func
    def pixel(x: vec3, intrinsics: vec4):
        return vec2(intrinsics[0] * x[0] / x[2] + intrinsics[2], intrinsics[1] * x[1] / x[2] + intrinsics[3])

    @wp.kernel(enable_backward=False, module="unique")
    def tile_polygon(
        first: wp.int32,
        means: wp.array(dtype=vec3),
        quats: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec2),
        opacities: wp.array(dtype=real),
        gammas: wp.array(dtype=vec2),
        viewmats: wp.array(dtype=mat44),
        Ks: wp.array(dtype=mat33),
        near: real,
        tile_rows: wp.int32,
        # outputs
        reaches: wp.array(dtype=vec2),
        corners: wp.array2d(dtype=vec2),
        shapes: wp.array(dtype=wp.vec3i),
        margins: wp.array(dtype=real),
        discs: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        # Nothing to see: no corners, and no rows.
        reaches[i] = vec2()
        shapes[i] = wp.vec3i(0, 0, -1)
        margins[i] = ZERO
        if wp.static(low_pass):
            discs[i] = vec3()
        # 0.1 % beyond the support, so that rounding in log and pow cannot cull a hit.
        limit = TWO * wp.log(real(255.0) * real(1.001) * opacities[i])
        if not (limit > ZERO):
            return
        reach = vec2(wp.pow(limit, HALF / gammas[i][0]), wp.pow(limit, HALF / gammas[i][1]))
        reaches[i] = reach
        viewmat = viewmats[0]
        intrinsics = f.intrinsics_of(Ks)
        axes = f.rotation(quats[i])
        center = f.rotate(viewmat, means[i]) + f.translation(viewmat)
        v1 = f.rotate(viewmat, vec3(axes[0, 0], axes[1, 0], axes[2, 0])) * (scales[i][0] * reach[0])
        v2 = f.rotate(viewmat, vec3(axes[0, 1], axes[1, 1], axes[2, 1])) * (scales[i][1] * reach[1])
        extent = wp.length(center) + wp.length(v1) + wp.length(v2)
        plane = near * real(0.999)
        if not (plane > ZERO):
            # With near = 0, hits closer than a millionth of the surfel's distance are given up: nothing bounds where.
            plane = wp.length(center) * real(1.0e-6)
        quad = mat43()
        for k in range(4):
            s1 = wp.where(k == 0 or k == 3, ONE, -ONE)
            s2 = wp.where(k < 2, ONE, -ONE)
            c = center + v1 * s1 + v2 * s2
            quad[k, 0] = c[0]
            quad[k, 1] = c[1]
            quad[k, 2] = c[2]
        low = vec2(HUGE, HUGE)
        high = vec2(-HUGE, -HUGE)
        nearest = real(HUGE)
        count = int(0)
        for k in range(4):
            j = (k + 1) % 4
            p = vec3(quad[k, 0], quad[k, 1], quad[k, 2])
            q = vec3(quad[j, 0], quad[j, 1], quad[j, 2])
            if p[2] >= plane:
                x = pixel(p, intrinsics)
                corners[i, count] = x
                count += 1
                low = wp.min(low, x)
                high = wp.max(high, x)
                nearest = wp.min(nearest, p[2])
            if (p[2] >= plane) != (q[2] >= plane):
                cut = p + (q - p) * ((plane - p[2]) / (q[2] - p[2]))
                cut[2] = plane
                x = pixel(cut, intrinsics)
                # Five corners at most; rounding cannot make a sixth of a convex quad.
                nearest = plane
                if count < MAX_CORNERS:
                    corners[i, count] = x
                    count += 1
                    low = wp.min(low, x)
                    high = wp.max(high, x)
        radius = ZERO
        if wp.static(low_pass):
            if center[2] > near:
                x = pixel(center, intrinsics)
                radius = wp.sqrt(HALF * limit)
                discs[i] = vec3(x[0], x[1], radius)
                low = wp.min(low, x - vec2(radius, radius))
                high = wp.max(high, x + vec2(radius, radius))
        if count == 0 and not (radius > ZERO):
            return
        size = wp.max(wp.max(wp.abs(low[0]), wp.abs(low[1])), wp.max(wp.abs(high[0]), wp.abs(high[1])))
        if not (size < HUGE):
            # Too large for arithmetic, or not a number: list it everywhere, the walk decides.
            for k in range(4):
                corners[i, k] = vec2(wp.where(k == 0 or k == 3, -HUGE, HUGE), wp.where(k < 2, -HUGE, HUGE))
            margins[i] = ZERO
            shapes[i] = wp.vec3i(4, 0, tile_rows - 1)
            return
        # A corner is known to a rounding of the extent: pixels by the focal length over the depth.
        blur = RELATIVE * extent * wp.max(intrinsics[0], intrinsics[1]) / nearest
        margin = real(MARGIN) + RELATIVE * size + wp.where(count > 0, blur, ZERO)
        # A tile's samples are its pixel centres, half a pixel inside its border.
        y0 = index((low[1] - margin + HALF) / SIZE - ONE, tile_rows)
        y1 = index((high[1] + margin - HALF) / SIZE, tile_rows)
        margins[i] = margin
        shapes[i] = wp.vec3i(count, wp.max(y0, 0), wp.min(y1, tile_rows - 1))

    return tile_polygon


@functools.cache
def index_function(real: type) -> wp.Function:
    """Make the function that gives the tile index of x (in tiles)."""

    @wp.func
    def index(x: real, count: int):
        # Clamped before the cast: int of a huge float is undefined.
        return int(wp.clamp(wp.floor(x), real(-1.0), real(float(count))))

    return index


@functools.cache
def span_function(real: type, low_pass: bool, tile_size: int) -> wp.Function:
    """Make the function that cuts a tile polygon with the slab of a tile row."""
    t = types(real)
    vec2, vec3 = t.vec2, t.vec3
    HALF, ONE, ZERO = t.HALF, t.ONE, t.ZERO
    HUGE = wp.constant(real(LARGEST))
    SIZE = wp.constant(real(tile_size))
    index, load = index_function(real), load_function(2, real)

    @wp.func
    def span(
        i: int,
        row: int,
        tile_columns: int,
        count: int,
        corners: wp.array2d(dtype=vec2),
        margin: real,
        discs: wp.array(dtype=vec3),
    ):
        """First and last tile of a tile row that the tile polygon touches; first > last when none."""
        top = real(float(row)) * SIZE + HALF - margin
        bottom = real(float(row + 1)) * SIZE - HALF + margin
        low = real(HUGE)
        high = real(-HUGE)
        if count > 0:
            p = load(corners, i, count - 1)
            for k in range(count):
                q = load(corners, i, k)
                if q[1] >= top and q[1] <= bottom:
                    low = wp.min(low, q[0])
                    high = wp.max(high, q[0])
                if (p[1] < top) != (q[1] < top):
                    x = p[0] + (q[0] - p[0]) * ((top - p[1]) / (q[1] - p[1]))
                    low = wp.min(low, x)
                    high = wp.max(high, x)
                if (p[1] > bottom) != (q[1] > bottom):
                    x = p[0] + (q[0] - p[0]) * ((bottom - p[1]) / (q[1] - p[1]))
                    low = wp.min(low, x)
                    high = wp.max(high, x)
                p = q
        if wp.static(low_pass):
            disc = discs[i]
            if disc[2] > ZERO and disc[1] + disc[2] >= top and disc[1] - disc[2] <= bottom:
                low = wp.min(low, disc[0] - disc[2])
                high = wp.max(high, disc[0] + disc[2])
        if not (low <= high):
            return wp.vec2i(0, -1)
        left = (low - margin + HALF) / SIZE - ONE
        x0 = index(left, tile_columns)
        if left > real(float(x0)):
            x0 += 1
        x1 = index((high + margin - HALF) / SIZE, tile_columns)
        return wp.vec2i(wp.max(x0, 0), wp.min(x1, tile_columns - 1))

    return span
