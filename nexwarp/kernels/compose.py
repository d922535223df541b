"""Composition (paper Eq. 7): image = plain + textured + (1 - alpha) background, textured = base + sum_k weight_k T_k.

A thread is a pixel. Read: the buffers of `collect`, the textured colours T (P, K) and the background; without `base`, a
null array, it is 0. Written: image and textured. Differentiated with respect to all that is read by Warp's own
adjoint.
"""

import functools

import warp as wp

from nexwarp.kernels.types import types


@functools.cache
def compose_kernel(real: type) -> wp.Kernel:
    """Make the kernel."""
    t = types(real)
    vec3, ONE = t.vec3, t.ONE

    @wp.kernel(module="unique")
    def compose(
        first: wp.int32,
        plain: wp.array(dtype=vec3),
        base: wp.array(dtype=vec3),
        colors: wp.array2d(dtype=vec3),
        weights: wp.array2d(dtype=real),
        alphas: wp.array(dtype=real),
        background: wp.array(dtype=vec3),
        # outputs
        image: wp.array(dtype=vec3),
        textured: wp.array(dtype=vec3),
    ):
        p = first + wp.tid()
        total = vec3()
        if base:
            total += base[p]
        for h in range(weights.shape[1]):
            total += colors[p, h] * weights[p, h]
        textured[p] = total
        image[p] = plain[p] + total + background[0] * (ONE - alphas[p])

    return compose
