"""What compares an image with a photo, and depths with those that are expected: a thread is a pixel, or a point.

The loss terms are the L1 of the image, of the texture, and the weight that has no texture.

The image is clamped to [0, 1] (and has no gradient beyond), as the authors' code does.
With S = sum_k W, a pixel's share is |image - target|, |textured / (S + eps) - target| (both summed over the channels)
and 1 - S, each times a scale, which holds the term's factor and the number of values. A term whose
scale is 0 is 0; one whose incoming gradient is a null array is left out. At a difference of 0 an L1 has the gradient
0. A channel whose target is at least `saturation` has a difference of 0 from any brighter value.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from nexwarp.kernels.types import func_per_real, per_real
from nexwarp.native.warp import lane_index, warp_size, warp_sum

WEIGHT_EPSILON = 1e-6  # keeps the un-premultiplied texture finite where nothing is textured


@wp.func
def clamped(x: Any):
    """X in [0, 1]; NaN stays."""
    return wp.where(x < type(x)(0.0), type(x)(0.0), wp.where(x > type(x)(1.0), type(x)(1.0), x))


@wp.func
def clamped_backward(x: Any, grad: Any):
    return wp.where(x >= type(x)(0.0) and x <= type(x)(1.0), grad, type(x)(0.0))


@wp.func
def sign(x: Any):
    """1, 0 or -1; 0 for NaN."""
    zero = type(x)(0.0)
    return wp.where(x > zero, type(x)(1.0), wp.where(x < zero, type(x)(-1.0), zero))


@wp.func
def difference(x: Any, y: Any, saturation: Any):
    """X - y of a channel, or 0 where y is saturated and x brighter."""
    return wp.where(y >= saturation and x > y, type(x)(0.0), x - y)


@wp.func
def total(weights: wp.array2d(dtype=Any), p: int):
    result = weights.dtype(0.0)
    for h in range(weights.shape[1]):
        result += weights[p, h]
    return result


@wp.func
def write_sum(sums: wp.array2d(dtype=Any), k: int, thread: int, x: Any):
    """Write the sum of x over the thread's warp to row k."""
    x = warp_sum(x)
    if lane_index() == 0:
        sums[k, thread // warp_size()] = x


@per_real()
def photometric(first: int, given: Compared, scales: vec3, saturation: real, pixels: int, sums: real_rows):
    """The sums of the terms, over warps, of which threads fill whole ones; `scales` are those of the terms in order."""
    p = first + wp.tid()
    terms = vec3()
    if p < pixels:
        weight = total(given.weights, p)
        if scales[0] != ZERO:
            for c in range(3):
                terms[0] += wp.abs(difference(clamped(given.image[p][c]), given.target[p][c], saturation))
        if scales[1] != ZERO:
            seen = given.textured[p] / (weight + WEIGHT_EPSILON)
            for c in range(3):
                terms[1] += wp.abs(difference(seen[c], given.target[p][c], saturation))
        terms = wp.cw_mul(vec3(terms[0], terms[1], ONE - weight), scales)
    write_sum(sums, 0, p, terms[0])
    write_sum(sums, 1, p, terms[1])
    write_sum(sums, 2, p, terms[2])


@per_real()
def photometric_backward(
    first: int,
    given: Compared,
    scales: vec3,
    saturation: real,
    grad_l1: reals,
    grad_texture: reals,
    grad_alpha: reals,
    grads: Compared,
):
    p = first + wp.tid()
    pull = vec3()
    if grads.image:
        for c in range(3):
            value = given.image[p][c]
            apart = sign(difference(clamped(value), given.target[p][c], saturation))
            pull[c] = clamped_backward(value, apart * (grad_l1[0] * scales[0]))
        grads.image[p] = pull
    change = real(0.0)
    if grad_texture:
        divisor = total(given.weights, p) + WEIGHT_EPSILON
        seen = given.textured[p] / divisor
        for c in range(3):
            apart = sign(difference(seen[c], given.target[p][c], saturation))
            pull[c] = apart * (grad_texture[0] * scales[1]) / divisor
        change -= wp.dot(pull, seen)
        if grads.textured:
            grads.textured[p] = pull
    if grad_alpha:
        change -= grad_alpha[0] * scales[2]
    if grads.weights:
        for h in range(grads.weights.shape[1]):
            grads.weights[p, h] = change


@wp.func
def factor(p: int, exposure: wp.array(dtype=Any)):
    if exposure.shape[0] == 1:
        return exposure[0]
    return exposure[p]


@per_real()
def expose(
    first: int,
    image: vec3s,
    textured: vec3s,
    exposure: vec3s,
    photo: vec3s,
    saturation: real,
    # outputs
    exposed: vec3s,
    exposed_colors: vec3s,
):
    """Render to a photo's exposure e: its gains times its falloff, one for all pixels or one a pixel. Not in the paper.

        exposed         e * image, or the photo's value where that is saturated and e * image brighter
        exposed_colors  e * textured

    Where the photo's value is taken there is no gradient.
    """
    p = first + wp.tid()
    e = factor(p, exposure)
    x = wp.cw_mul(image[p], e)
    y = photo[p]
    for k in range(3):
        if y[k] >= saturation and x[k] > y[k]:
            x[k] = y[k]
    exposed[p] = x
    exposed_colors[p] = wp.cw_mul(textured[p], e)


@per_real()
def expose_backward(  # noqa: PLR0913  # a kernel entry point
    first: int,
    image: vec3s,
    exposure: vec3s,
    photo: vec3s,
    saturation: real,
    grad_exposed: vec3s,
    grad_exposed_colors: vec3s,
    # outputs
    grad_image: vec3s,
    grad_textured: vec3s,
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


@wp.func
def place_of(places: wp.array(dtype=wp.int64), i: int):
    if places:
        return int(places[i])
    return i


@func_per_real
def mean_depth(depths: real_rows, weights: real_rows, p: int):
    mean = real(0.0)
    for h in range(depths.shape[1]):
        mean += weights[p, h] * depths[p, h]
    return mean / (total(weights, p) + WEIGHT_EPSILON)


@per_real()
def depth_errors(
    first: int,
    depths: real_rows,
    weights: real_rows,
    expected: reals,
    places: wp.array(dtype=wp.int64),
    factor: real,
    # output: sums of a warp's errors, and how many of its points count
    sums: real_rows,
):
    """Compare depths with those `expected` of points, 0 where unknown.

    `places` are the points' pixels, in ascending order; where they are a null array, point i is in pixel i. With the
    weights W and depths D of a pixel's hits, a point's error is factor * |sum W D / (sum W + eps) / expected - 1|.
    """
    i = first + wp.tid()
    error, known = real(0.0), real(0.0)
    if i < expected.shape[0] and expected[i] > ZERO:
        p = place_of(places, i)
        error = factor * wp.abs(mean_depth(depths, weights, p) / expected[i] - ONE)
        known = ONE
    write_sum(sums, 0, i, error)
    write_sum(sums, 1, i, known)


@per_real()
def depth_errors_backward(  # noqa: PLR0913  # a kernel entry point
    first: int,
    depths: real_rows,
    weights: real_rows,
    expected: reals,
    places: wp.array(dtype=wp.int64),
    factor: real,
    totals: reals,  # of what the other kernel writes
    grad_loss: reals,
    # outputs
    grad_depths: real_rows,
    grad_weights: real_rows,
):
    p = first + wp.tid()
    mean = mean_depth(depths, weights, p)
    change = real(0.0)
    start = p
    if places:
        start = wp.lower_bound(places, wp.int64(p))
    for i in range(start, expected.shape[0]):
        if place_of(places, i) != p:
            break
        if expected[i] > ZERO:
            change += sign(mean / expected[i] - ONE) / expected[i]
    change *= grad_loss[0] * factor / wp.max(totals[1], ONE) / (total(weights, p) + WEIGHT_EPSILON)
    for h in range(depths.shape[1]):
        grad_depths[p, h] = change * weights[p, h]
        grad_weights[p, h] = change * (depths[p, h] - mean)
