"""Kernels for test_tape, in a file of their own: to a type checker a kernel's Python is another language."""

import warp as wp

from nexwarp.kernels.types import types

REAL = wp.float64


@wp.kernel(module="unique")
def matmul(weights: wp.array2d(dtype=REAL), x: wp.array2d(dtype=REAL), y: wp.array2d(dtype=REAL)):
    o, i = wp.tid()
    total = REAL(0.0)
    for k in range(weights.shape[1]):
        total += weights[o, k] * x[k, i]
    y[o, i] = total


# A kernel of its own: Warp's adjoint does not replay the sum's dynamic loop, so a max behind it would see zeros.
@wp.kernel(module="unique")
def relu(x: wp.array2d(dtype=REAL), y: wp.array2d(dtype=REAL)):
    o, i = wp.tid()
    y[o, i] = wp.max(x[o, i], REAL(0.0))


@wp.kernel(module="unique")
def weighted_sum(
    image: wp.array(dtype=types(REAL).vec3), weights: wp.array(dtype=types(REAL).vec3), loss: wp.array(dtype=REAL)
):
    i = wp.tid()
    wp.atomic_add(loss, 0, wp.dot(image[i], weights[i]))
