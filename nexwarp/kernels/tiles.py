"""Tile lists: which surfels may be seen in which tile, near to far. Integers only, nothing here is differentiable.

A surfel's support, the rectangle |u| <= (2 ln 255 o)^(1/(2 g1)), likewise v, is clipped at the near plane and
projected: a convex polygon of at most five corners. A tile row's slab cuts out one span of it, so the tiles that the
polygon touches are listed exactly, not those of its bounding box. The support only culls; alpha >= 1/255 decides.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.surfel import frame_functions
from nexwarp.kernels.types import types

# Pixels added around the polygon: rounding must never cull a hit.
MARGIN = 0.01
RELATIVE_MARGIN = 1e-6
# A typed constant: a bare literal of this size would be an int32.
SIGN = wp.constant(wp.uint32(2147483648))


@functools.cache
def footprint_functions(real: type, low_pass: bool, tile_size: int) -> SimpleNamespace:
    """The projected support as a polygon, and its span of tiles in a tile row."""
    t = types(real)
    vec2, vec3, vec4, mat44 = t.vec2, t.vec3, t.vec4, t.mat44
    mat52 = wp.types.matrix(shape=(5, 2), dtype=real)
    mat43 = wp.types.matrix(shape=(4, 3), dtype=real)
    f = frame_functions(real)
    ZERO, HALF, ONE, TWO = t.ZERO, t.HALF, t.ONE, t.TWO
    HUGE = wp.constant(real(1e30))
    SIZE = wp.constant(real(tile_size))
    RELATIVE = wp.constant(real(RELATIVE_MARGIN))

    @wp.struct
    class Footprint:
        corners: mat52  # pixels
        count: wp.int32  # corners in use, 0 when nothing is visible
        center: vec2  # pixels
        radius: real  # of the low-pass disc, pixels; 0 without one
        margin: real  # pixels
        rows: wp.vec2i  # first and last tile row

    @wp.func
    def pixel(x: vec3, intrinsics: vec4):
        return vec2(intrinsics[0] * x[0] / x[2] + intrinsics[2], intrinsics[1] * x[1] / x[2] + intrinsics[3])

    @wp.func
    def index(x: real, count: int):
        """Tile index of x (in tiles), clamped before the cast: int of a huge float is undefined."""
        return int(wp.clamp(wp.floor(x), real(-1.0), real(float(count))))

    @wp.func
    def footprint(
        mean: vec3,
        quat: vec4,
        scale: vec2,
        opacity: real,
        gamma: vec2,
        viewmat: mat44,
        intrinsics: vec4,
        near: real,
        tile_rows: int,
    ):
        out = Footprint()
        # 0.1 % beyond the support, so that rounding in log and pow cannot cull a hit.
        limit = TWO * wp.log(real(255.0) * real(1.001) * opacity)
        if not (limit > ZERO):
            return out
        axes = f.rotation(quat)
        center = f.rotate(viewmat, mean) + f.translation(viewmat)
        v1 = f.rotate(viewmat, vec3(axes[0, 0], axes[1, 0], axes[2, 0]))
        v2 = f.rotate(viewmat, vec3(axes[0, 1], axes[1, 1], axes[2, 1]))
        v1 = v1 * (scale[0] * wp.pow(limit, HALF / gamma[0]))
        v2 = v2 * (scale[1] * wp.pow(limit, HALF / gamma[1]))
        reach = wp.length(center) + wp.length(v1) + wp.length(v2)
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
                out.corners[count, 0] = x[0]
                out.corners[count, 1] = x[1]
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
                if count < 5:
                    out.corners[count, 0] = x[0]
                    out.corners[count, 1] = x[1]
                    count += 1
                    low = wp.min(low, x)
                    high = wp.max(high, x)
        if wp.static(low_pass):
            if center[2] > near:
                x = pixel(center, intrinsics)
                out.center = x
                out.radius = wp.sqrt(wp.max(HALF * limit, ZERO))
                low = wp.min(low, x - vec2(out.radius, out.radius))
                high = wp.max(high, x + vec2(out.radius, out.radius))
        if count == 0 and not (out.radius > ZERO):
            return out
        size = wp.max(wp.max(wp.abs(low[0]), wp.abs(low[1])), wp.max(wp.abs(high[0]), wp.abs(high[1])))
        if not (size < HUGE):
            # Too large for arithmetic, or not a number: list it everywhere, the walk decides.
            for k in range(4):
                out.corners[k, 0] = wp.where(k == 0 or k == 3, -HUGE, HUGE)
                out.corners[k, 1] = wp.where(k < 2, -HUGE, HUGE)
            out.count = 4
            out.rows = wp.vec2i(0, tile_rows - 1)
            return out
        out.count = count
        # A corner is known to a rounding of the reach: pixels by the focal length over the depth.
        blur = RELATIVE * reach * wp.max(intrinsics[0], intrinsics[1]) / nearest
        out.margin = real(MARGIN) + RELATIVE * size + wp.where(count > 0, blur, ZERO)
        # A tile's samples are its pixel centres, half a pixel inside its border.
        y0 = index((low[1] - out.margin + HALF) / SIZE - ONE, tile_rows)
        y1 = index((high[1] + out.margin - HALF) / SIZE, tile_rows)
        out.rows = wp.vec2i(wp.max(y0, 0), wp.min(y1, tile_rows - 1))
        return out

    @wp.func
    def span(shape: Footprint, row: int, tile_columns: int):
        """First and last tile of a tile row that the footprint touches; first > last when none."""
        top = real(float(row)) * SIZE + HALF - shape.margin
        bottom = real(float(row + 1)) * SIZE - HALF + shape.margin
        low = real(HUGE)
        high = real(-HUGE)
        for k in range(shape.count):
            j = k + 1
            if j == shape.count:
                j = 0
            px = shape.corners[k, 0]
            py = shape.corners[k, 1]
            qx = shape.corners[j, 0]
            qy = shape.corners[j, 1]
            if py >= top and py <= bottom:
                low = wp.min(low, px)
                high = wp.max(high, px)
            if (py < top) != (qy < top):
                x = px + (qx - px) * ((top - py) / (qy - py))
                low = wp.min(low, x)
                high = wp.max(high, x)
            if (py > bottom) != (qy > bottom):
                x = px + (qx - px) * ((bottom - py) / (qy - py))
                low = wp.min(low, x)
                high = wp.max(high, x)
        if wp.static(low_pass):
            if shape.radius > ZERO:
                if shape.center[1] + shape.radius >= top and shape.center[1] - shape.radius <= bottom:
                    low = wp.min(low, shape.center[0] - shape.radius)
                    high = wp.max(high, shape.center[0] + shape.radius)
        if not (low <= high):
            return wp.vec2i(0, -1)
        left = (low - shape.margin + HALF) / SIZE - ONE
        x0 = index(left, tile_columns)
        if left > real(float(x0)):
            x0 += 1
        x1 = index((high + shape.margin - HALF) / SIZE, tile_columns)
        return wp.vec2i(wp.max(x0, 0), wp.min(x1, tile_columns - 1))

    return SimpleNamespace(Footprint=Footprint, footprint=footprint, span=span)


@functools.cache
def depth_keys_kernel(real: type) -> wp.Kernel:
    """Make the kernel that turns signed centre depths into sortable uint32 keys."""
    vec3 = types(real).vec3

    @wp.kernel(enable_backward=False, module="unique")
    def depth_keys(
        first: wp.int32,
        centers: wp.array(dtype=vec3),
        # outputs
        keys: wp.array(dtype=wp.uint32),
        indices: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        # Adding 0 makes -0 and 0 tie, as they do in any comparison of floats.
        bits = wp.cast(wp.float32(centers[i][2]) + wp.float32(0.0), wp.uint32)
        keys[i] = wp.where((bits & SIGN) != wp.uint32(0), ~bits, bits | SIGN)
        indices[i] = i

    return depth_keys


@functools.cache
def list_kernels(real: type, low_pass: bool, tile_size: int) -> SimpleNamespace:
    """Make the kernels that count and emit (tile, surfel) entries, one thread a surfel in depth order."""
    t = types(real)
    vec2, vec3, vec4, mat44 = t.vec2, t.vec3, t.vec4, t.mat44
    f = footprint_functions(real, low_pass, tile_size)

    @wp.kernel(enable_backward=False, module="unique")
    def count(
        first: wp.int32,
        order: wp.array(dtype=wp.int32),
        means: wp.array(dtype=vec3),
        quats: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec2),
        opacities: wp.array(dtype=real),
        gammas: wp.array(dtype=vec2),
        viewmats: wp.array(dtype=mat44),
        intrinsics: vec4,
        near: real,
        grid: wp.vec2i,
        # outputs
        counts: wp.array(dtype=wp.int32),
    ):
        rank = first + wp.tid()
        i = order[rank]
        shape = f.footprint(
            means[i], quats[i], scales[i], opacities[i], gammas[i], viewmats[0], intrinsics, near, grid[1]
        )
        total = int(0)
        if shape.count > 0 or shape.radius > real(0.0):
            for row in range(shape.rows[0], shape.rows[1] + 1):
                s = f.span(shape, row, grid[0])
                total += wp.max(s[1] - s[0] + 1, 0)
        counts[rank] = total

    @wp.kernel(enable_backward=False, module="unique")
    def emit(
        first: wp.int32,
        order: wp.array(dtype=wp.int32),
        means: wp.array(dtype=vec3),
        quats: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec2),
        opacities: wp.array(dtype=real),
        gammas: wp.array(dtype=vec2),
        viewmats: wp.array(dtype=mat44),
        intrinsics: vec4,
        near: real,
        grid: wp.vec2i,
        ends: wp.array(dtype=wp.int32),
        # outputs
        tiles: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=wp.int32),
        surfels: wp.array(dtype=wp.int32),
    ):
        rank = first + wp.tid()
        e = int(0)
        if rank > 0:
            e = ends[rank - 1]
        end = ends[rank]
        if e == end:
            return
        i = order[rank]
        shape = f.footprint(
            means[i], quats[i], scales[i], opacities[i], gammas[i], viewmats[0], intrinsics, near, grid[1]
        )
        for row in range(shape.rows[0], shape.rows[1] + 1):
            s = f.span(shape, row, grid[0])
            for column in range(s[0], s[1] + 1):
                # Lists may be too short (see `nexwarp.ops.tiles`), and a compiler may round here otherwise than in
                # `count`: never write past the list's or the surfel's own end.
                if e < end and e < entries.shape[0]:
                    tiles[e] = row * grid[0] + column
                    entries[e] = e
                    surfels[e] = i
                e += 1

    return SimpleNamespace(count=count, emit=emit)


@wp.kernel(enable_backward=False, module="unique")
def tile_offsets_kernel(
    first: wp.int32,
    tiles: wp.array(dtype=wp.int32),
    total: wp.int32,
    # outputs
    offsets: wp.array(dtype=wp.int32),
):
    """Start of each tile's entries in the sorted list, by binary search: one thread a tile, and one for the end."""
    tile = first + wp.tid()
    low = int(0)
    high = int(total)
    while low < high:
        middle = (low + high) // 2
        if tiles[middle] < tile:
            low = middle + 1
        else:
            high = middle
    offsets[tile] = low


@wp.kernel(enable_backward=False, module="unique")
def surfel_ids_kernel(
    first: wp.int32,
    entries: wp.array(dtype=wp.int32),
    surfels: wp.array(dtype=wp.int32),
    # outputs
    surfel_ids: wp.array(dtype=wp.int32),
):
    """Surfel of each sorted entry."""
    k = first + wp.tid()
    surfel_ids[k] = surfels[entries[k]]
