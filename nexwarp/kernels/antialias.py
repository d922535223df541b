"""Antialiasing: surfels blurred for cameras that are farther away than any training view was (not in the paper).

A thread is a surfel, forward and backward. Read: the surfels' depths, scales, opacities and gammas, and the largest
depth / focal of the training views. Written: blurred scales, opacities and gammas; backward, all gradients but those of
the focal length and of the training views' depths.

A photo's pixel averages over its area, a ray does not: surfels smaller than a pixel alias. Training learns them as its
own pixels show them. For larger pixels, each surfel is blurred by the pixel's variance less that of the training views'
pixels, and its opacity falls as its area grows (the 2D filter of Mip-Splatting, in the surfel's plane). Gammas fall to
1, a Gaussian's. The backward kernel writes what `wp.grad` gives for the product of outputs and their gradients.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.types import types

# Variance of a pixel's filter, in squared pixels; that of a box is 1/12.
FILTER = 0.125


@functools.cache
def antialias_kernels(real: type) -> SimpleNamespace:
    """Make the kernels."""
    t = types(real)
    vec2 = t.vec2
    ZERO, ONE, VARIANCE = t.ZERO, t.ONE, wp.constant(real(FILTER))

    @wp.func
    def blur(depth: real, focal: real, farthest: real):
        """Variance to add, in squared world units."""
        pixel = depth / focal
        return wp.where(pixel > farthest, VARIANCE * (pixel * pixel - farthest * farthest), ZERO)

    @wp.func
    def wide(scale: real, variance: real):
        """Hypotenuse of the scale and the blur's; squares of scales may overflow, or vanish."""
        blurred = wp.sqrt(variance)
        high = wp.max(scale, blurred)
        ratio = wp.min(scale, blurred) / high
        return high * wp.sqrt(ONE + ratio * ratio)

    @wp.func
    def share(scale: real, variance: real):
        """Old size over the new one."""
        return scale / wide(scale, variance)

    @wp.func
    def antialiased_dot(
        depth: real,
        scale: vec2,
        opacity: real,
        gamma: vec2,
        focal: real,
        farthest: real,
        grad_scale: vec2,
        grad_opacity: real,
        grad_gamma: vec2,
    ):
        """Sum of outputs * gradients (a constant is left out): its gradient is the vector-Jacobian product."""
        variance = blur(depth, focal, farthest)
        x = share(scale[0], variance)
        y = share(scale[1], variance)
        return (
            wide(scale[0], variance) * grad_scale[0]
            + wide(scale[1], variance) * grad_scale[1]
            + opacity * x * y * grad_opacity
            + (gamma[0] - ONE) * x * x * grad_gamma[0]
            + (gamma[1] - ONE) * y * y * grad_gamma[1]
        )

    @wp.kernel(enable_backward=False, module="unique")
    def antialias(
        first: wp.int32,
        depths: wp.array(dtype=real),
        scales: wp.array(dtype=vec2),
        opacities: wp.array(dtype=real),
        gammas: wp.array(dtype=vec2),
        farthest: wp.array(dtype=real),
        focals: wp.array(dtype=real),
        # outputs
        wide_scales: wp.array(dtype=vec2),
        wide_opacities: wp.array(dtype=real),
        wide_gammas: wp.array(dtype=vec2),
    ):
        i = first + wp.tid()
        scale = scales[i]
        gamma = gammas[i]
        variance = blur(depths[i], focals[0], farthest[i])
        if variance > ZERO:
            x = share(scale[0], variance)
            y = share(scale[1], variance)
            wide_scales[i] = vec2(wide(scale[0], variance), wide(scale[1], variance))
            wide_opacities[i] = opacities[i] * x * y
            wide_gammas[i] = vec2(ONE + (gamma[0] - ONE) * x * x, ONE + (gamma[1] - ONE) * y * y)
        else:
            wide_scales[i] = scale
            wide_opacities[i] = opacities[i]
            wide_gammas[i] = gamma

    @wp.kernel(enable_backward=False, module="unique")
    def antialias_backward(
        first: wp.int32,
        depths: wp.array(dtype=real),
        scales: wp.array(dtype=vec2),
        opacities: wp.array(dtype=real),
        gammas: wp.array(dtype=vec2),
        farthest: wp.array(dtype=real),
        focals: wp.array(dtype=real),
        grad_wide_scales: wp.array(dtype=vec2),
        grad_wide_opacities: wp.array(dtype=real),
        grad_wide_gammas: wp.array(dtype=vec2),
        # outputs
        grad_depths: wp.array(dtype=real),
        grad_scales: wp.array(dtype=vec2),
        grad_opacities: wp.array(dtype=real),
        grad_gammas: wp.array(dtype=vec2),
    ):
        i = first + wp.tid()
        if blur(depths[i], focals[0], farthest[i]) > ZERO:
            depth, scale, opacity, gamma, _focal, _farthest, _s, _o, _g = wp.grad(antialiased_dot)(
                depths[i],
                scales[i],
                opacities[i],
                gammas[i],
                focals[0],
                farthest[i],
                grad_wide_scales[i],
                grad_wide_opacities[i],
                grad_wide_gammas[i],
            )
            grad_depths[i] = depth
            grad_scales[i] = scale
            grad_opacities[i] = opacity
            grad_gammas[i] = gamma
        else:
            grad_depths[i] = ZERO
            grad_scales[i] = grad_wide_scales[i]
            grad_opacities[i] = grad_wide_opacities[i]
            grad_gammas[i] = grad_wide_gammas[i]

    return SimpleNamespace(forward=antialias, backward=antialias_backward)
