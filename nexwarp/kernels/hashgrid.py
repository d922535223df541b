"""Hash-grid lookup (paper Eq. 1 and 2): unbounded, every level hashed, features down-weighted by a pixel's footprint.

Forward one thread a (level, point), backward one thread a point and a run of levels. Features are stored level-major,
(levels * features, n): neighbouring threads write neighbouring values, and the MLP's matrix product takes the array as
it is. A point with depth 0 (an empty hit slot) gets zeros and gives no gradient.

The lookup gathers the eight corners and interpolates by the pure function that `wp.grad` differentiates, so tables may
be half precision while their gradients are summed in float32. On a CPU a launch is split by level: a level's table
belongs to one thread, and gradients of points go to a slot a level; on CUDA a thread takes all levels of its point.
"""

import functools
import math
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.loads import load_function
from nexwarp.kernels.types import types

PRIME_Y = wp.constant(wp.uint32(2654435761))
PRIME_Z = wp.constant(wp.uint32(805459861))

# Two-float atomics exist from sm_90 on; they halve the number of atomics of the backward pass.
_ADD_PAIR = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    atomicAdd(reinterpret_cast<float2*>(&wp::index(table, level, slot)), make_float2(value[0], value[1]));
#else
    wp::atomic_add(table, level, slot, value);
#endif
"""


@wp.func_native(_ADD_PAIR)
def add_pair(table: wp.array2d(dtype=wp.vec2), level: wp.int32, slot: wp.int32, value: wp.vec2):
    """Add a float pair to table[level, slot] atomically."""
    ...


# Neighbouring pixels fall into the same cell of a coarse level: the lanes of a cell add up theirs in a tree, and only
# the first of them goes on to the atomics. Absent lanes (a part-filled warp, empty hits) are left out by the mask.
_MERGE = """
#if defined(__CUDA_ARCH__)
    const unsigned active = __activemask();
    const unsigned long long xy = ((unsigned long long)(unsigned)y << 32) | (unsigned)x;
    const unsigned peers = __match_any_sync(active, xy) & __match_any_sync(active, z);
    const int lane = threadIdx.x & 31;
    int rank = __popc(peers & ((1u << lane) - 1u));
    const bool first = rank == 0;
    unsigned rest = peers & (0xfffffffeu << lane);
    while (__any_sync(active, rest != 0u)) {
        const int next = __ffs(rest) - 1;
        for (int j = 0; j < 8; ++j) {
            for (int k = 0; k < 2; ++k) {
                const float other = __shfl_sync(active, value.data[j][k], next < 0 ? lane : next);
                if (next >= 0) value.data[j][k] += other;
            }
        }
        rest &= __ballot_sync(active, (rank & 1) == 0);
        rank >>= 1;
    }
    if (!first) {
        for (int j = 0; j < 8; ++j) for (int k = 0; k < 2; ++k) value.data[j][k] = 0.0f;
    }
#endif
    return value;
"""
Corners = wp.types.matrix(shape=(8, 2), dtype=wp.float32)


@wp.func_native(_MERGE)
def merge_cells(x: wp.int32, y: wp.int32, z: wp.int32, value: Corners) -> Corners:
    """Return the sum of the values of all lanes with the cell (x, y, z) in the first of them, zeros in the others."""
    ...


@wp.func
def map_positive(i: wp.int32):
    """Fold the integers onto the non-negative ones: 0, 1, -1, 2, -2 ... -> 0, 1, 2, 3, 4 ..."""
    return wp.uint32(wp.where(i > 0, 2 * i - 1, -2 * i))


@wp.func
def hash_slot(corner: wp.vec3i, j: wp.int32, mask: wp.uint32):
    """Table slot of corner j of a cell."""
    x = map_positive(corner[0] + (j & 1))
    y = map_positive(corner[1] + ((j >> 1) & 1)) * PRIME_Y
    z = map_positive(corner[2] + (j >> 2)) * PRIME_Z
    return wp.int32((x ^ y ^ z) & mask)


@functools.cache
def hashgrid_kernels(real: type, storage: type, features: int) -> SimpleNamespace:
    """Make the forward and backward kernels.

    Args:
        real: scalar type of positions, table gradients and arithmetic.
        storage: scalar type of the table and of the features written (`real` or wp.float16).
        features: features a level, 1, 2, 4 or 8.
    """
    t = types(real)
    vec3, vec4 = t.vec3, t.vec4
    row = wp.types.vector(length=features, dtype=storage)
    vec = wp.types.vector(length=features, dtype=real)
    mat = wp.types.matrix(shape=(8, features), dtype=real)
    vec8 = wp.types.vector(length=8, dtype=real)
    ONE, ZERO = t.ONE, t.ZERO
    INVERSE_TWO_PI = wp.constant(real(1.0 / (2.0 * math.pi)))
    load = load_function(features, storage)
    pairs = features == 2 and real is wp.float32

    @wp.func
    def interpolate(f: vec3, corners: mat, scale: real, depth: real, focal: real):
        """Trilinear interpolation of the corners times 1 - exp(-(focal / (scale depth))^2 / 2 pi), paper Eq. 2."""
        gx = ONE - f[0]
        gy = ONE - f[1]
        gz = ONE - f[2]
        w = vec8(
            gx * gy * gz,
            f[0] * gy * gz,
            gx * f[1] * gz,
            f[0] * f[1] * gz,
            gx * gy * f[2],
            f[0] * gy * f[2],
            gx * f[1] * f[2],
            f[0] * f[1] * f[2],
        )
        ratio = focal / (scale * depth)
        return (w @ corners) * (ONE - wp.exp(-ratio * ratio * INVERSE_TWO_PI))

    @wp.func
    def interpolate_dot(f: vec3, corners: mat, scale: real, depth: real, focal: real, grad: vec):
        return wp.dot(interpolate(f, corners, scale, depth, focal), grad)

    @wp.func
    def cell(x: vec3):
        return vec3(wp.floor(x[0]), wp.floor(x[1]), wp.floor(x[2]))

    @wp.func
    def gather(table: wp.array2d(dtype=row), level: int, corner: wp.vec3i, mask: wp.uint32):
        corners = mat()
        for j in range(8):
            value = load(table, level, hash_slot(corner, j, mask))
            for k in range(wp.static(features)):
                corners[j, k] = real(value[k])
        return corners

    @wp.kernel(enable_backward=False, module="unique")
    def hashgrid(
        first: wp.int32,
        table: wp.array2d(dtype=row),
        positions: wp.array(dtype=vec3),
        depths: wp.array(dtype=real),
        resolutions: wp.array(dtype=real),
        focal: wp.array(dtype=real),
        mask: wp.uint32,
        # outputs
        encoded: wp.array2d(dtype=storage),
    ):
        l_, p = wp.tid()
        level = first + l_
        value = vec()
        depth = depths[p]
        if depth > ZERO:
            scale = resolutions[level]
            x = positions[p] * scale
            base = cell(x)
            corner = wp.vec3i(int(base[0]), int(base[1]), int(base[2]))
            value = interpolate(x - base, gather(table, level, corner, mask), scale, depth, focal[0])
        for k in range(wp.static(features)):
            encoded[level * features + k, p] = storage(value[k])

    @wp.kernel(enable_backward=False, module="unique")
    def hashgrid_backward(
        first: wp.int32,
        table: wp.array2d(dtype=row),
        positions: wp.array(dtype=vec3),
        depths: wp.array(dtype=real),
        resolutions: wp.array(dtype=real),
        focal: wp.array(dtype=real),
        mask: wp.uint32,
        grad_encoded: wp.array2d(dtype=storage),
        unscale: wp.array(dtype=real),
        run: wp.int32,
        # outputs
        grad_table: wp.array2d(dtype=vec),
        grad_points: wp.array2d(dtype=vec4),
    ):
        r_, p = wp.tid()
        start = (first + r_) * run
        depth = depths[p]
        if not (depth > ZERO):
            if grad_points.shape[0] > 0:
                grad_points[first + r_, p] = vec4()
            return
        total = vec4()
        for level in range(start, wp.min(start + run, resolutions.shape[0])):
            grad = vec()
            for k in range(wp.static(features)):
                grad[k] = real(grad_encoded[level * features + k, p]) * unscale[0]
            scale = resolutions[level]
            x = positions[p] * scale
            base = cell(x)
            corner = wp.vec3i(int(base[0]), int(base[1]), int(base[2]))
            gf, gc, _s, gd, _f, _g = wp.grad(interpolate_dot)(
                x - base, gather(table, level, corner, mask), scale, depth, focal[0], grad
            )
            if wp.static(pairs):
                gc = merge_cells(corner[0], corner[1], corner[2], gc)
            for j in range(8):
                part = vec()
                for k in range(wp.static(features)):
                    part[k] = gc[j, k]
                if wp.static(pairs):
                    if part[0] != real(0.0) or part[1] != real(0.0):
                        add_pair(grad_table, level, hash_slot(corner, j, mask), part)
                else:
                    wp.atomic_add(grad_table, level, hash_slot(corner, j, mask), part)
            total += vec4(gf[0] * scale, gf[1] * scale, gf[2] * scale, gd)
        if grad_points.shape[0] > 0:
            grad_points[first + r_, p] = total

    return SimpleNamespace(forward=hashgrid, backward=hashgrid_backward)
