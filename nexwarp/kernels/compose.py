"""Composition (paper Eq. 7): image = plain + textured + (1 - alpha) background, textured = base + sum_k weight_k T_k.

A thread is a pixel. Read: the buffers of `collect`, the textured colours T (P, K) and the background; without `base`, a
null array, it is 0. Written: image and textured; backward, the gradients of all that is read but the background, where
an array for them is given.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.types import types


@functools.cache
def compose_kernels(real: type) -> SimpleNamespace:
    """Make the kernel and its derivative."""
    t = types(real)
    vec3, ONE = t.vec3, t.ONE

    @wp.kernel(enable_backward=False, module="unique")
    def compose(  # noqa: PLR0913  # a kernel entry point
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

    @wp.kernel(enable_backward=False, module="unique")
    def compose_backward(  # noqa: PLR0913  # a kernel entry point
        first: wp.int32,
        colors: wp.array2d(dtype=vec3),
        weights: wp.array2d(dtype=real),
        background: wp.array(dtype=vec3),
        grad_image: wp.array(dtype=vec3),
        grad_textured: wp.array(dtype=vec3),
        # outputs
        grad_base: wp.array(dtype=vec3),
        grad_colors: wp.array2d(dtype=vec3),
        grad_weights: wp.array2d(dtype=real),
        grad_alphas: wp.array(dtype=real),
    ):
        p = first + wp.tid()
        of_image = vec3()
        if grad_image:
            of_image = grad_image[p]
        total = of_image
        if grad_textured:
            total += grad_textured[p]
        if grad_base:
            grad_base[p] = total
        if grad_alphas:
            grad_alphas[p] = -wp.dot(of_image, background[0])
        for h in range(weights.shape[1]):
            if grad_colors:
                grad_colors[p, h] = total * weights[p, h]
            if grad_weights:
                grad_weights[p, h] = wp.dot(colors[p, h], total)

    return SimpleNamespace(forward=compose, backward=compose_backward)
