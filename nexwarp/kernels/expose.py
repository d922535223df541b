"""Rendering to the exposure of the photo that it is compared with, elementwise (not in the paper).

A thread is a pixel. With e the exposure's gains times its falloff, one for all pixels or one a pixel:

    exposed         e * image, or the photo's value where that is saturated and e * image brighter
    exposed_colors  e * textured

Where the photo's value is taken there is no gradient.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.types import types


@functools.cache
def expose_kernels(real: type) -> SimpleNamespace:
    """Make the kernel and its derivative."""
    t = types(real)
    vec3, ZERO = t.vec3, t.ZERO

    @wp.func
    def factor(p: int, exposure: wp.array(dtype=vec3)):
        if exposure.shape[0] == 1:
            return exposure[0]
        return exposure[p]

    @wp.kernel(enable_backward=False, module="unique")
    def expose(
        first: wp.int32,
        image: wp.array(dtype=vec3),
        textured: wp.array(dtype=vec3),
        exposure: wp.array(dtype=vec3),
        photo: wp.array(dtype=vec3),
        saturation: real,
        # outputs
        exposed: wp.array(dtype=vec3),
        exposed_colors: wp.array(dtype=vec3),
    ):
        p = first + wp.tid()
        e = factor(p, exposure)
        x = wp.cw_mul(image[p], e)
        y = photo[p]
        for k in range(3):
            if y[k] >= saturation and x[k] > y[k]:
                x[k] = y[k]
        exposed[p] = x
        exposed_colors[p] = wp.cw_mul(textured[p], e)

    @wp.kernel(enable_backward=False, module="unique")
    def expose_backward(  # noqa: PLR0913  # a kernel entry point
        first: wp.int32,
        image: wp.array(dtype=vec3),
        exposure: wp.array(dtype=vec3),
        photo: wp.array(dtype=vec3),
        saturation: real,
        grad_exposed: wp.array(dtype=vec3),
        grad_exposed_colors: wp.array(dtype=vec3),
        # outputs
        grad_image: wp.array(dtype=vec3),
        grad_textured: wp.array(dtype=vec3),
    ):
        p = first + wp.tid()
        e = factor(p, exposure)
        if grad_exposed:
            x = wp.cw_mul(image[p], e)
            y = photo[p]
            g = wp.cw_mul(grad_exposed[p], e)
            for k in range(3):
                if y[k] >= saturation and x[k] > y[k]:
                    g[k] = ZERO
            grad_image[p] = g
        if grad_exposed_colors:
            grad_textured[p] = wp.cw_mul(grad_exposed_colors[p], e)

    return SimpleNamespace(forward=expose, backward=expose_backward)
