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

from __future__ import annotations

import math
from typing import Any

import warp as wp

from nexwarp.kernels.types import func_per_real, ints, per_real
from nexwarp.native.cells import load_function, merge_functions
from nexwarp.native.fixed_point import fixed_point_units

PRIME_Y = wp.constant(wp.uint32(2654435761))
PRIME_Z = wp.constant(wp.uint32(805459861))
INVERSE_TWO_PI = wp.constant(wp.float64(1.0 / (2.0 * math.pi)))


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
def cell_of(x: Any):
    """(corner with the lowest coordinates of a point's cell, where the point lies in it), in units of cells."""
    base = type(x)(wp.floor(x[0]), wp.floor(x[1]), wp.floor(x[2]))
    return wp.vec3i(int(base[0]), int(base[1]), int(base[2])), x - base


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


@func_per_real
def gather(table: Any, level: int, corner: wp.vec3i, mask: wp.uint32):
    """The rows of a cell's eight corners."""
    corners = wp.matrix(shape=(8, features), dtype=real)
    for j in range(8):
        value = wp.static(load_function(features, storage))(table, level, hash_slot(corner, j, mask))
        for k in range(wp.static(features)):
            corners[j, k] = real(value[k])
    return corners


@func_per_real
def scatter(sums: Any, level: int, corner: wp.vec3i, mask: wp.uint32, grads: Any, units: Any, bad: ints):
    """Add gradients to the rows of a cell's eight corners; in fixed point to their integers.

    There the lanes of a cell do not add up theirs first: which ones come together may change.
    """
    total = grads
    if wp.static(merged(real, features) and not fixed_point):
        total = wp.static(merge_functions(features).merge_cells)(corner[0], corner[1], corner[2], grads)
    for j in range(8):
        slot = hash_slot(corner, j, mask)
        if wp.static(fixed_point):
            for k in range(wp.static(features)):
                fixed_point_units(sums, level, int(slot) * wp.static(features) + k, grads[j, k], units[0], bad)
        else:
            part = wp.vector(length=features, dtype=real)
            for k in range(wp.static(features)):
                part[k] = total[j, k]
            if wp.static(merged(real, features)):
                wp.static(merge_functions(features).add_row)(sums, level, slot, part)
            else:
                wp.atomic_add(sums, level, slot, part)


def rows_of(length: int, dtype: type) -> Any:
    """Return the type of arrays of two dimensions whose entries are vectors."""
    return wp.array2d(dtype=wp.types.vector(length=length, dtype=dtype))


def merged(real: type, features: int) -> bool:
    """Whether `merge_functions` has functions for rows of these."""
    return features in (2, 4) and real is wp.float32


@per_real("storage", "features", fast_math=True)
def hashgrid(
    first: int,
    table: rows_of(features, storage),
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
    value = wp.vector(length=features, dtype=real)
    depth = depths[p]
    if depth > ZERO:
        scale = resolutions[level]
        corner, fraction = cell_of(positions[p] * scale)
        value = interpolate(fraction, gather(table, level, corner, mask), scale, depth, focal[0])
    for k in range(wp.static(features)):
        encoded[level * features + k, p] = storage(value[k])


@per_real("storage", "features", "fixed_point", fast_math=True)
def hashgrid_backward(  # noqa: PLR0913  # a kernel entry point
    first: int,
    table: rows_of(features, storage),
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
    grad_table: wp.array2d(dtype=wp.int64) if fixed_point else rows_of(features, real),
    grad_points: vec4_rows,
    bad: ints,
):
    """With `fixed_point` integers are added to the table, `units` of them in 1."""
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
        grad = wp.vector(length=features, dtype=real)
        for k in range(wp.static(features)):
            grad[k] = real(grad_encoded[level * features + k, p]) * unscale[0]
        scale = resolutions[level]
        corner, fraction = cell_of(positions[p] * scale)
        corners = gather(table, level, corner, mask)
        gx, gc, _s, gd, _f, _g = wp.grad(interpolate_dot)(fraction, corners, scale, depth, focal[0], grad)
        scatter(grad_table, level, corner, mask, gc, units, bad)
        total += vec4(gx[0] * scale, gx[1] * scale, gx[2] * scale, gd)
    if grad_points.shape[0] > 0:
        grad_points[run, p] = total
