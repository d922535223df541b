"""Lookup in the hash grid (paper Eq. 2), its features down-weighted by the pixel's size (Delta, paper Eq. 4).

Every level is hashed, so the field is unbounded. Forward, a thread is a (level, point); backward, a thread is a (run of
`levels_per_thread` levels, point). Read: the table (L, T) of F features, the points (n) and their z-depths; a point of
depth 0, an empty hit slot, gets zeros and gives no gradient. Written:

    encoded        (L * F, n), level-major: neighbouring threads write neighbouring values, and the MLP's matrix product
                   takes the array as it is
    grad_table     added to, by atomics on CUDA. A CPU has none: there a thread owns the tables of its run of levels
    grad_points    (runs, n) gradients of position and depth, one for each run of levels

The lookup gathers the eight corners and interpolates by the pure function that `wp.grad` differentiates, so that tables
may be half precision while their gradients are summed in float32. Resolutions and focal length are not differentiated;
the cell of a point is frozen. The fixed-point form adds up integers, one for each entry and feature (L, T * F), in
units that the caller chooses: the same bits in whatever order.
"""

import functools
import math
from types import SimpleNamespace
from typing import Any

import warp as wp

from nexwarp.kernels.types import ints, types
from nexwarp.native.fixed_point import fixed_point_units
from nexwarp.native.vector_loads import load_function

PRIME_Y = wp.constant(wp.uint32(2654435761))
PRIME_Z = wp.constant(wp.uint32(805459861))
INVERSE_TWO_PI = wp.constant(wp.float64(1.0 / (2.0 * math.pi)))

# Atomics of two and of four floats exist from sm_90 on: as many fewer in the backward pass.
_ADD = """
    bool there = false;
    for (int k = 0; k < FEATURES; ++k) there = there || value[k] != 0.0f;
    if (!there) return;
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    atomicAdd(reinterpret_cast<floatFEATURES*>(&wp::index(table, level, slot)), make_floatFEATURES(VALUES));
#else
    wp::atomic_add(table, level, slot, value);
#endif
"""

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
            for (int k = 0; k < FEATURES; ++k) {
                const float other = __shfl_sync(active, value.data[j][k], next < 0 ? lane : next);
                if (next >= 0) value.data[j][k] += other;
            }
        }
        rest &= __ballot_sync(active, (rank & 1) == 0);
        rank >>= 1;
    }
    if (!first) {
        for (int j = 0; j < 8; ++j) for (int k = 0; k < FEATURES; ++k) value.data[j][k] = 0.0f;
    }
#endif
    return value;
"""


@functools.cache
def merge_functions(features: int) -> SimpleNamespace:
    """Make `merge_cells` and `add_row` for tables of rows of 2 or 4 floats."""
    row = wp.types.vector(length=features, dtype=wp.float32)
    corners = wp.types.matrix(shape=(8, features), dtype=wp.float32)
    values = ", ".join(f"value[{k}]" for k in range(features))

    def filled(text: str) -> str:
        return text.replace("FEATURES", str(features)).replace("VALUES", values)

    @wp.func_native(filled(_MERGE))
    def merge_cells(x: wp.int32, y: wp.int32, z: wp.int32, value: corners) -> corners:
        """Return the sum over all lanes with the cell (x, y, z) in the first of them, zeros in the others."""
        ...

    @wp.func_native(filled(_ADD))
    def add_row(table: wp.array2d(dtype=row), level: wp.int32, slot: wp.int32, value: row):
        """Add to table[level, slot] atomically, unless there is nothing to add."""
        ...

    return SimpleNamespace(merge_cells=merge_cells, add_row=add_row)


@wp.func
def map_positive(i: int):
    """Fold the integers onto the non-negative ones: 0, 1, -1, 2, -2 ... -> 0, 1, 2, 3, 4 ..."""
    return wp.uint32(wp.where(i > 0, 2 * i - 1, -2 * i))


@wp.func
def hash_slot(corner: wp.vec3i, j: int, mask: wp.uint32):
    """Table slot of corner j of a cell."""
    x = map_positive(corner[0] + (j & 1))
    y = map_positive(corner[1] + ((j >> 1) & 1)) * PRIME_Y
    z = map_positive(corner[2] + (j >> 2)) * PRIME_Z
    return wp.int32((x ^ y ^ z) & mask)


@wp.func
def floor_of(x: Any):
    """The corner of a point's cell with the lowest coordinates."""
    return type(x)(wp.floor(x[0]), wp.floor(x[1]), wp.floor(x[2]))


@wp.func
def interpolate(fraction: Any, corners: Any, scale: Any, depth: Any, focal: Any):
    """Trilinear interpolation of the corners' rows times 1 - exp(-(focal / (scale depth))^2 / 2 pi), paper Eq. 4."""
    one = type(depth)(1.0)
    gx = one - fraction[0]
    gy = one - fraction[1]
    gz = one - fraction[2]
    ratio = focal / (scale * depth)
    fade = one - wp.exp(-type(depth)(INVERSE_TWO_PI) * (ratio * ratio))
    front = gx * gy * corners[0] + fraction[0] * gy * corners[1]
    front += gx * fraction[1] * corners[2] + fraction[0] * fraction[1] * corners[3]
    back = gx * gy * corners[4] + fraction[0] * gy * corners[5]
    back += gx * fraction[1] * corners[6] + fraction[0] * fraction[1] * corners[7]
    return gz * fade * front + fraction[2] * fade * back


@wp.func
def interpolate_dot(fraction: Any, corners: Any, scale: Any, depth: Any, focal: Any, grad: Any):
    """Contraction of `interpolate` with the gradient of its result, for `wp.grad`."""
    return wp.dot(interpolate(fraction, corners, scale, depth, focal), grad)


@functools.cache
def gather_function(real: type, storage: type, features: int) -> wp.Function:
    """Make the function that reads the rows of a cell's eight corners."""
    row = wp.types.vector(length=features, dtype=storage)
    mat = wp.types.matrix(shape=(8, features), dtype=real)
    load = load_function(features, storage)

    @wp.func
    def gather(table: wp.array2d(dtype=row), level: int, corner: wp.vec3i, mask: wp.uint32):
        corners = mat()
        for j in range(8):
            value = load(table, level, hash_slot(corner, j, mask))
            for k in range(wp.static(features)):
                corners[j, k] = real(value[k])
        return corners

    return gather


@functools.cache
def scatter_function(real: type, features: int, fixed_point: bool) -> wp.Function:
    """Make the function that adds gradients to the rows of a cell's eight corners; in fixed point to their integers."""
    vec = wp.types.vector(length=features, dtype=real)
    mat = wp.types.matrix(shape=(8, features), dtype=real)
    if fixed_point:
        # The lanes of a cell do not add up theirs first: which ones come together may change.

        @wp.func
        def scatter(
            sums: wp.array2d(dtype=wp.int64),
            level: int,
            corner: wp.vec3i,
            mask: wp.uint32,
            grads: mat,
            units: wp.array(dtype=wp.float64),
            bad: ints,
        ):
            for j in range(8):
                first = int(hash_slot(corner, j, mask)) * wp.static(features)
                for k in range(wp.static(features)):
                    fixed_point_units(sums, level, first + k, grads[j, k], units[0], bad)

        return scatter
    merged = features in (2, 4) and real is wp.float32
    merge = merge_functions(features) if merged else SimpleNamespace(merge_cells=None, add_row=None)
    merge_cells, add_row = merge.merge_cells, merge.add_row

    @wp.func
    def scatter(
        sums: wp.array2d(dtype=vec),
        level: int,
        corner: wp.vec3i,
        mask: wp.uint32,
        grads: mat,
        units: wp.array(dtype=wp.float64),
        bad: ints,
    ):
        total = grads
        if wp.static(merged):
            total = merge_cells(corner[0], corner[1], corner[2], grads)
        for j in range(8):
            part = vec()
            for k in range(wp.static(features)):
                part[k] = total[j, k]
            if wp.static(merged):
                add_row(sums, level, hash_slot(corner, j, mask), part)
            else:
                wp.atomic_add(sums, level, hash_slot(corner, j, mask), part)

    return scatter


@functools.cache
def hashgrid_kernels(real: type, storage: type, features: int, fixed_point: bool = False) -> SimpleNamespace:
    """Make the forward and backward kernels, for 1, 2, 4 or 8 features a level.

    Positions, table gradients and arithmetic are of the type `real`, the table and the features written of `storage`,
    `real` or wp.float16. With `fixed_point` the backward kernel adds to the table integers, `units` of them in 1.
    """
    t = types(real)
    vec4 = t.vec4
    row = wp.types.vector(length=features, dtype=storage)
    vec = wp.types.vector(length=features, dtype=real)
    reals, vec3s, vec4_rows, ZERO = t.reals, t.vec3s, t.vec4_rows, t.ZERO
    gather = gather_function(real, storage, features)
    scatter = scatter_function(real, features, fixed_point)
    options = {"fast_math": real is wp.float32}
    table_of_sums = wp.array2d(dtype=wp.int64) if fixed_point else wp.array2d(dtype=vec)

    @wp.kernel(enable_backward=False, module="unique", module_options=options)
    def hashgrid(
        first: int,
        table: wp.array2d(dtype=row),
        positions: vec3s,
        depths: reals,
        resolutions: reals,
        focal: reals,
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
            base = floor_of(x)
            corner = wp.vec3i(int(base[0]), int(base[1]), int(base[2]))
            x -= base
            value = interpolate(x, gather(table, level, corner, mask), scale, depth, focal[0])
        for k in range(wp.static(features)):
            encoded[level * features + k, p] = storage(value[k])

    @wp.kernel(enable_backward=False, module="unique", module_options=options)
    def hashgrid_backward(  # noqa: PLR0913  # a kernel entry point
        first: int,
        table: wp.array2d(dtype=row),
        positions: vec3s,
        depths: reals,
        resolutions: reals,
        focal: reals,
        mask: wp.uint32,
        grad_encoded: wp.array2d(dtype=storage),
        unscale: reals,
        units: wp.array(dtype=wp.float64),
        levels_per_thread: int,
        # outputs
        grad_table: table_of_sums,
        grad_points: vec4_rows,
        bad: ints,
    ):
        r_, p = wp.tid()
        run = first + r_
        depth = depths[p]
        if not (depth > ZERO):
            if grad_points.shape[0] > 0:
                grad_points[run, p] = vec4()
            return
        total = vec4()
        start = run * levels_per_thread
        for level in range(start, wp.min(start + levels_per_thread, resolutions.shape[0])):
            grad = vec()
            for k in range(wp.static(features)):
                grad[k] = real(grad_encoded[level * features + k, p]) * unscale[0]
            scale = resolutions[level]
            x = positions[p] * scale
            base = floor_of(x)
            corner = wp.vec3i(int(base[0]), int(base[1]), int(base[2]))
            x -= base
            gx, gc, _s, gd, _f, _g = wp.grad(interpolate_dot)(
                x, gather(table, level, corner, mask), scale, depth, focal[0], grad
            )
            scatter(grad_table, level, corner, mask, gc, units, bad)
            total += vec4(gx[0] * scale, gx[1] * scale, gx[2] * scale, gd)
        if grad_points.shape[0] > 0:
            grad_points[run, p] = total

    return SimpleNamespace(forward=hashgrid, backward=hashgrid_backward)
