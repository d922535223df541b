"""SIMD form, for CPUs, of the hash-grid features H(x) (paper Eq. 2), down-weighted by Delta (paper Eq. 4).

A thread is a level, backward a run of levels, of `WIDTH` neighbouring points. Read, written and differentiated is what
`hashgrid` reads, writes and differentiates; a test compares the two. Only reading and writing the table go point by
point. A launch is split by levels, so that a level's table belongs to one thread.

A whole training step of the demo takes 19 % longer without it (2 cores, Xeon with AVX-512). The scalar form with the
table read and written by native code, and even without its exponentials, was still 1.5 times as slow in lookups alone.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.hashgrid import interpolation_functions
from nexwarp.kernels.types import types
from nexwarp.native.simd import simd_functions

WIDTH = 8

# Slots of the eight corners of each point's cell: see `hashgrid.hash_slot`. Elements of vectors are read and written by
# constant indices, so that they stay in registers: a wide load after narrow stores would wait for memory.
_SLOTS = """
    typedef REAL real_t __attribute__((ext_vector_type(WIDTH)));
    typedef unsigned words_t __attribute__((ext_vector_type(WIDTH)));
    typedef int int_t __attribute__((ext_vector_type(WIDTH)));
    const wp::vec_t<WIDTH, REAL>* axes[3] = {&x, &y, &z};
    const unsigned primes[3] = {1u, 2654435761u, 805459861u};
    words_t parts[3][2];
    for (int a = 0; a < 3; ++a) {
        real_t v;
        __builtin_memcpy(&v, axes[a], sizeof(v));
        const int_t i = __builtin_convertvector(v, int_t);
        for (int b = 0; b < 2; ++b) {
            const int_t c = i + b;
            parts[a][b] = (words_t)(c > 0 ? 2 * c - 1 : -2 * c) * primes[a];
        }
    }
    auto* entries = &wp::index(table, level, 0);
    #pragma unroll
    for (int j = 0; j < 8; ++j) {
        const words_t slots = (parts[0][j & 1] ^ parts[1][(j >> 1) & 1] ^ parts[2][j >> 2]) & mask;
        EACH
    }
"""

_GATHER = (
    """
    wp::mat_t<8 * FEATURES, WIDTH, REAL> corners;
"""
    + _SLOTS.replace(
        "EACH",
        """
        real_t values[FEATURES];
        #pragma unroll
        for (int l = 0; l < WIDTH; ++l) {
            const auto value = entries[slots[l]];
            for (int k = 0; k < FEATURES; ++k) values[k][l] = value.c[k];
        }
        for (int k = 0; k < FEATURES; ++k) __builtin_memcpy(corners.data[j * FEATURES + k], &values[k], sizeof(real_t));
""",
    )
    + """
    return corners;
"""
)

_SCATTER = _SLOTS.replace(
    "EACH",
    """
        real_t values[FEATURES];
        for (int k = 0; k < FEATURES; ++k) __builtin_memcpy(&values[k], corners.data[j * FEATURES + k], sizeof(real_t));
        #pragma unroll
        for (int l = 0; l < WIDTH; ++l) {
            for (int k = 0; k < FEATURES; ++k) entries[slots[l]].c[k] += values[k][l];
        }
""",
)

_FLOOR = """
    typedef REAL real_t __attribute__((ext_vector_type(WIDTH)));
    real_t x;
    __builtin_memcpy(&x, &v, sizeof(x));
    x = __builtin_elementwise_floor(x);
    __builtin_memcpy(&v, &x, sizeof(x));
    return v;
"""


@functools.cache
def hashgrid_simd_kernels(real: type, storage: type, features: int) -> SimpleNamespace:
    """Make the forward and backward kernels; see `hashgrid.hashgrid_kernels`."""
    t = types(real)
    vec3, vec4 = t.vec3, t.vec4
    row = wp.types.vector(length=features, dtype=storage)
    vec = wp.types.vector(length=features, dtype=real)
    f = interpolation_functions(real, features, WIDTH)
    corners_type, values_type, interpolate, interpolate_dot = f.corners, f.values, f.interpolate, f.interpolate_dot
    reals = simd_functions(real, WIDTH).reals
    flags = wp.types.vector(length=WIDTH, dtype=wp.int32)
    ONE, ZERO = t.ONE, t.ZERO

    def snippet(text: str) -> str:
        name = "float" if real is wp.float32 else "double"
        return text.replace("WIDTH", str(WIDTH)).replace("FEATURES", str(features)).replace("REAL", name)

    @wp.func_native(snippet(_FLOOR))
    def floor_of(v: reals) -> reals: ...

    @wp.func_native(snippet(_GATHER))
    def gather(
        table: wp.array2d(dtype=row), level: wp.int32, x: reals, y: reals, z: reals, mask: wp.uint32
    ) -> corners_type: ...

    @wp.func_native(snippet(_SCATTER))
    def scatter(
        table: wp.array2d(dtype=vec),
        level: wp.int32,
        x: reals,
        y: reals,
        z: reals,
        mask: wp.uint32,
        corners: corners_type,
    ): ...

    @wp.struct
    class Points:
        x: reals
        y: reals
        z: reals
        depth: reals
        there: flags

    @wp.func
    def points_at(start: int, positions: wp.array(dtype=vec3), depths: wp.array(dtype=real), scale: real):
        """Scaled positions; points that are not there, or to be skipped, are at the origin and at depth 1."""
        out = Points()
        out.depth = reals(ONE)
        for l in range(wp.static(WIDTH)):
            p = start + l
            if p < depths.shape[0]:
                if depths[p] > ZERO:
                    x = positions[p]
                    out.x[l] = x[0] * scale
                    out.y[l] = x[1] * scale
                    out.z[l] = x[2] * scale
                    out.depth[l] = depths[p]
                    out.there[l] = 1
        return out

    @wp.kernel(enable_backward=False, module="unique")
    def hashgrid_simd(
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
        l_, group = wp.tid()
        level = first + l_
        scale = resolutions[level]
        points = points_at(group * WIDTH, positions, depths, scale)
        x = floor_of(points.x)
        y = floor_of(points.y)
        z = floor_of(points.z)
        corners = gather(table, level, x, y, z, mask)
        value = interpolate(points.x - x, points.y - y, points.z - z, corners, scale, points.depth, focal[0])
        for l in range(wp.static(WIDTH)):
            p = group * WIDTH + l
            if p < depths.shape[0]:
                for k in range(wp.static(features)):
                    encoded[level * features + k, p] = storage(wp.where(points.there[l] != 0, value[k, l], ZERO))

    @wp.kernel(enable_backward=False, module="unique")
    def hashgrid_simd_backward(
        first: wp.int32,
        table: wp.array2d(dtype=row),
        positions: wp.array(dtype=vec3),
        depths: wp.array(dtype=real),
        resolutions: wp.array(dtype=real),
        focal: wp.array(dtype=real),
        mask: wp.uint32,
        grad_encoded: wp.array2d(dtype=storage),
        unscale: wp.array(dtype=real),
        levels_per_thread: wp.int32,
        # outputs
        grad_table: wp.array2d(dtype=vec),
        grad_points: wp.array2d(dtype=vec4),
    ):
        r_, group = wp.tid()
        start = (first + r_) * levels_per_thread
        tx = reals()
        ty = reals()
        tz = reals()
        td = reals()
        for level in range(start, wp.min(start + levels_per_thread, resolutions.shape[0])):
            scale = resolutions[level]
            points = points_at(group * WIDTH, positions, depths, scale)
            x = floor_of(points.x)
            y = floor_of(points.y)
            z = floor_of(points.z)
            grad = values_type()
            for l in range(wp.static(WIDTH)):
                if points.there[l] != 0:
                    for k in range(wp.static(features)):
                        grad[k, l] = real(grad_encoded[level * features + k, group * WIDTH + l]) * unscale[0]
            gx, gy, gz, gc, _s, gd, _f, _g = wp.grad(interpolate_dot)(
                points.x - x,
                points.y - y,
                points.z - z,
                gather(table, level, x, y, z, mask),
                scale,
                points.depth,
                focal[0],
                grad,
            )
            # Points that are not there add 0.
            scatter(grad_table, level, x, y, z, mask, gc)
            tx += gx * scale
            ty += gy * scale
            tz += gz * scale
            td += gd
        if grad_points.shape[0] > 0:
            for l in range(wp.static(WIDTH)):
                p = group * WIDTH + l
                if p < depths.shape[0]:
                    grad_points[first + r_, p] = vec4(tx[l], ty[l], tz[l], td[l])

    return SimpleNamespace(forward=hashgrid_simd, backward=hashgrid_simd_backward)
