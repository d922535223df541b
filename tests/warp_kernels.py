"""Kernels of tests, in a file of their own: to a type checker a kernel's Python is another language."""

import warp as wp

from nexwarp.kernels.types import types
from nexwarp.native.fixed_point import fixed_point_add

REAL = wp.float64


@wp.kernel(enable_backward=False, module="unique")
def scaled_sum(
    first: wp.int32,
    a: wp.array(dtype=wp.float32),
    b: wp.array(dtype=wp.float32),
    shift: wp.vec2i,
    scale: wp.float32,
    negate: wp.bool,
    # outputs
    out: wp.array(dtype=wp.float32),
):
    """out = +-(scale * a + b + shift[0] + 10 shift[1]), without b where it is a null array."""
    i = first + wp.tid()
    x = scale * a[i] + float(shift[0] + 10 * shift[1])
    if b:
        x += b[i]
    out[i] = wp.where(negate, -x, x)


@wp.kernel(module="unique", enable_backward=False)
def add_in_order(
    order: wp.array(dtype=wp.int32),
    terms: wp.array(dtype=wp.float32),
    sums: wp.array2d(dtype=wp.int64),
    bad: wp.array(dtype=wp.int32),
):
    fixed_point_add(sums, 0, terms[order[wp.tid()]], bad)


@wp.kernel(module="unique")
def weighted_sum(
    image: wp.array(dtype=types(REAL).vec3), weights: wp.array(dtype=types(REAL).vec3), loss: wp.array(dtype=REAL)
):
    i = wp.tid()
    wp.atomic_add(loss, 0, wp.dot(image[i], weights[i]))
