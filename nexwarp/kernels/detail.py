"""Limits of detail: cameras farther from the surfels, or nearer, than any training view was (not in the paper).

`antialias`: a thread is a surfel, forward and backward. Read: the surfels' depths, scales, opacities and gammas, and
the largest depth / focal of the training views. Written: blurred scales, opacities and gammas; backward, all gradients
but those of the focal length and of the training views' depths. A photo's pixel averages over its area, a ray does not:
surfels smaller than a pixel alias. Training learns them as its own pixels show them. For larger pixels, each surfel is
blurred by the pixel's variance less that of the training views' pixels, and its opacity falls as its area grows (the 2D
filter of Mip-Splatting, in the surfel's plane). Gammas fall to 1, a Gaussian's. The backward kernel writes what
`wp.grad` gives for the product of outputs and their gradients.

`limit_depths`: a thread is a slot of a pixel. Read: ids and depths of the hits, and the surfels' smallest and largest
depth / focal. Written: the depths at which the texture is looked up, at most focal * farthest, then at least
focal * nearest; those of empty slots as they are.
"""

from __future__ import annotations

import warp as wp

from nexwarp.kernels.types import Real, Vec2, ints, per_real

# Variance of a pixel's filter, in squared pixels; that of a box is 1/12.
FILTER = 0.125


@wp.func
def blur(depth: Real, focal: Real, farthest: Real):
    """Variance to add, in squared world units."""
    pixel = depth / focal
    zero = type(depth)(0.0)
    return wp.where(pixel > farthest, type(depth)(FILTER) * (pixel * pixel - farthest * farthest), zero)


@wp.func
def wide(scale: Real, variance: Real):
    """Hypotenuse of the scale and the blur's; squares of scales may overflow, or vanish."""
    blurred = wp.sqrt(variance)
    high = wp.max(scale, blurred)
    ratio = wp.min(scale, blurred) / high
    return high * wp.sqrt(type(scale)(1.0) + ratio * ratio)


@wp.func
def antialiased(scale: Vec2, opacity: Real, gamma: Vec2, variance: Real):
    """(scale, opacity, gamma) of a surfel that is blurred."""
    one = type(variance)(1.0)
    width = wp.vector(wide(scale[0], variance), wide(scale[1], variance))
    # Old sizes over the new ones.
    x = scale[0] / width[0]
    y = scale[1] / width[1]
    return width, opacity * x * y, wp.vector(one + (gamma[0] - one) * x * x, one + (gamma[1] - one) * y * y)


@wp.func
def antialiased_dot(
    depth: Real,
    scale: Vec2,
    opacity: Real,
    gamma: Vec2,
    pixel: Vec2,
    grad_scale: Vec2,
    grad_opacity: Real,
    grad_gamma: Vec2,
):
    """Sum of outputs * gradients, pixel = (focal, farthest): its gradient is the vector-Jacobian product."""
    wider, fainter, rounder = antialiased(scale, opacity, gamma, blur(depth, pixel[0], pixel[1]))
    return wp.dot(wider, grad_scale) + fainter * grad_opacity + wp.dot(rounder, grad_gamma)


@per_real()
def antialias(first: int, depths: reals, surfels: Parameters, farthest: reals, focals: reals, blurred: Parameters):
    i = first + wp.tid()
    scale = surfels.scales[i]
    opacity = surfels.opacities[i]
    gamma = surfels.gammas[i]
    variance = blur(depths[i], focals[0], farthest[i])
    if variance > ZERO:
        scale, opacity, gamma = antialiased(scale, opacity, gamma, variance)
    blurred.scales[i] = scale
    blurred.opacities[i] = opacity
    blurred.gammas[i] = gamma


@per_real()
def antialias_backward(
    first: int,
    depths: reals,
    surfels: Parameters,
    farthest: reals,
    focals: reals,
    grads: Parameters,
    grad_depths: reals,
    grad_surfels: Parameters,
):
    i = first + wp.tid()
    depth = real(0.0)
    scale = grads.scales[i]
    opacity = grads.opacities[i]
    gamma = grads.gammas[i]
    if blur(depths[i], focals[0], farthest[i]) > ZERO:
        depth, scale, opacity, gamma, _pixel, _s, _o, _g = wp.grad(antialiased_dot)(
            depths[i],
            surfels.scales[i],
            surfels.opacities[i],
            surfels.gammas[i],
            vec2(focals[0], farthest[i]),
            scale,
            opacity,
            gamma,
        )
    grad_depths[i] = depth
    grad_surfels.scales[i] = scale
    grad_surfels.opacities[i] = opacity
    grad_surfels.gammas[i] = gamma


@per_real()
def limit_depths(first: int, ids: ints, depths: reals, nearest: reals, farthest: reals, focals: reals, limited: reals):
    k = first + wp.tid()
    i = ids[k]
    depth = depths[k]
    if i >= 0:
        # `nearest` is applied last: where no training view saw the texture, it is huge and removes all detail.
        depth = wp.max(wp.min(depth, focals[0] * farthest[i]), focals[0] * nearest[i])
    limited[k] = depth
