"""What compares an image with a photo, and depths with those that are expected: a thread is a pixel, or a point.

The loss terms are the L1 of the image, of the texture, and the weight that has no texture.

The image is clamped to [0, 1] (and has no gradient beyond), as the authors' code does.
With S = sum_k W, a pixel's share is |image - target|, |textured / (S + eps) - target| (both summed over the channels)
and 1 - S, each times a scale, which holds the term's factor and the number of values. A term whose
scale is 0 is 0; one whose incoming gradient is a null array is left out. At a difference of 0 an L1 has the gradient
0. A channel whose target is at least `saturation` has a difference of 0 from any brighter value.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from nexwarp.kernels.types import types
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
def signs(x: Any):
    return type(x)(sign(x[0]), sign(x[1]), sign(x[2]))


@wp.func
def clamped_color(x: Any):
    return type(x)(clamped(x[0]), clamped(x[1]), clamped(x[2]))


@wp.func
def clamped_color_backward(x: Any, grad: Any):
    return type(x)(clamped_backward(x[0], grad[0]), clamped_backward(x[1], grad[1]), clamped_backward(x[2], grad[2]))


@wp.func
def channel_difference(x: Any, y: Any, saturation: Any):
    """X - y, or 0 where y is saturated and x brighter."""
    return wp.where(y >= saturation and x > y, type(x)(0.0), x - y)


@wp.func
def difference(x: Any, y: Any, saturation: Any):
    return type(x)(
        channel_difference(x[0], y[0], saturation),
        channel_difference(x[1], y[1], saturation),
        channel_difference(x[2], y[2], saturation),
    )


@wp.func
def distance(x: Any):
    return wp.abs(x[0]) + wp.abs(x[1]) + wp.abs(x[2])


@wp.func
def total(weights: wp.array2d(dtype=Any), p: wp.int32):
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


@functools.cache
def photometric_kernels(real: type) -> SimpleNamespace:
    """Make the forward and backward kernels; `scales` are those of the terms in order.

    Threads are whole warps, of which each writes its sum of each term.
    """
    t = types(real)
    vec3 = t.vec3
    ZERO, ONE, EPS = t.ZERO, t.ONE, wp.constant(real(WEIGHT_EPSILON))

    @wp.kernel(enable_backward=False, module="unique")
    def photometric(  # noqa: PLR0913  # a kernel entry point
        first: wp.int32,
        image: wp.array(dtype=vec3),
        textured: wp.array(dtype=vec3),
        weights: wp.array2d(dtype=real),
        target: wp.array(dtype=vec3),
        scales: vec3,
        saturation: real,
        pixels: wp.int32,
        # output
        sums: wp.array2d(dtype=real),
    ):
        p = first + wp.tid()
        terms = vec3()
        if p < pixels:
            weight = total(weights, p)
            if scales[0] != ZERO:
                terms[0] = distance(difference(clamped_color(image[p]), target[p], saturation)) * scales[0]
            if scales[1] != ZERO:
                terms[1] = distance(difference(textured[p] / (weight + EPS), target[p], saturation)) * scales[1]
            terms[2] = (ONE - weight) * scales[2]
        write_sum(sums, 0, p, terms[0])
        write_sum(sums, 1, p, terms[1])
        write_sum(sums, 2, p, terms[2])

    @wp.kernel(enable_backward=False, module="unique")
    def photometric_backward(  # noqa: PLR0913  # a kernel entry point
        first: wp.int32,
        image: wp.array(dtype=vec3),
        textured: wp.array(dtype=vec3),
        weights: wp.array2d(dtype=real),
        target: wp.array(dtype=vec3),
        scales: vec3,
        saturation: real,
        grad_l1: wp.array(dtype=real),
        grad_texture: wp.array(dtype=real),
        grad_alpha: wp.array(dtype=real),
        # outputs
        grad_image: wp.array(dtype=vec3),
        grad_textured: wp.array(dtype=vec3),
        grad_weights: wp.array2d(dtype=real),
    ):
        p = first + wp.tid()
        if grad_image:
            color = image[p]
            grad = signs(difference(clamped_color(color), target[p], saturation)) * (grad_l1[0] * scales[0])
            grad_image[p] = clamped_color_backward(color, grad)
        change = real(0.0)
        if grad_texture:
            divisor = total(weights, p) + EPS
            seen = textured[p] / divisor
            pull = signs(difference(seen, target[p], saturation)) * (grad_texture[0] * scales[1]) / divisor
            change -= wp.dot(pull, seen)
            if grad_textured:
                grad_textured[p] = pull
        if grad_alpha:
            change -= grad_alpha[0] * scales[2]
        if grad_weights:
            for h in range(grad_weights.shape[1]):
                grad_weights[p, h] = change

    return SimpleNamespace(forward=photometric, backward=photometric_backward)


@functools.cache
def expose_kernels(real: type) -> SimpleNamespace:
    """Make the kernel that renders to a photo's exposure, and its derivative (not in the paper).

    With e the exposure's gains times its falloff, one for all pixels or one a pixel:

        exposed         e * image, or the photo's value where that is saturated and e * image brighter
        exposed_colors  e * textured

    Where the photo's value is taken there is no gradient.
    """
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


@wp.func
def place_of(places: wp.array(dtype=wp.int64), i: int):
    if places:
        return int(places[i])
    return i


@functools.cache
def depth_kernels(real: type) -> SimpleNamespace:
    """Make the kernel that compares depths with those `expected` of points, 0 where unknown, and its derivative.

    `places` are the points' pixels, in ascending order; where they are a null array, point i is in pixel i. With the
    weights W and depths D of a pixel's hits, a point's error is factor * |sum W D / (sum W + eps) / expected - 1|.
    """
    ZERO, ONE, EPS = real(0.0), wp.constant(real(1.0)), wp.constant(real(WEIGHT_EPSILON))

    @wp.func
    def mean_depth(depths: wp.array2d(dtype=real), weights: wp.array2d(dtype=real), p: int):
        mean = ZERO
        for h in range(depths.shape[1]):
            mean += weights[p, h] * depths[p, h]
        return mean / (total(weights, p) + EPS)

    @wp.kernel(enable_backward=False, module="unique")
    def depth_errors(
        first: wp.int32,
        depths: wp.array2d(dtype=real),
        weights: wp.array2d(dtype=real),
        expected: wp.array(dtype=real),
        places: wp.array(dtype=wp.int64),
        factor: real,
        # output: sums of a warp's errors, and how many of its points count
        sums: wp.array2d(dtype=real),
    ):
        i = first + wp.tid()
        error, known = ZERO, ZERO
        if i < expected.shape[0] and expected[i] > ZERO:
            p = place_of(places, i)
            error = factor * wp.abs(mean_depth(depths, weights, p) / expected[i] - ONE)
            known = ONE
        write_sum(sums, 0, i, error)
        write_sum(sums, 1, i, known)

    @wp.kernel(enable_backward=False, module="unique")
    def depth_errors_backward(  # noqa: PLR0913  # a kernel entry point
        first: wp.int32,
        depths: wp.array2d(dtype=real),
        weights: wp.array2d(dtype=real),
        expected: wp.array(dtype=real),
        places: wp.array(dtype=wp.int64),
        factor: real,
        totals: wp.array(dtype=real),  # of what the other kernel writes
        grad_loss: wp.array(dtype=real),
        # outputs
        grad_depths: wp.array2d(dtype=real),
        grad_weights: wp.array2d(dtype=real),
    ):
        p = first + wp.tid()
        mean = mean_depth(depths, weights, p)
        change = ZERO
        start = p
        if places:
            start = wp.lower_bound(places, wp.int64(p))
        for i in range(start, expected.shape[0]):
            if place_of(places, i) != p:
                break
            if expected[i] > ZERO:
                change += sign(mean / expected[i] - ONE) / expected[i]
        change *= grad_loss[0] * factor / wp.max(totals[1], ONE) / (total(weights, p) + EPS)
        for h in range(depths.shape[1]):
            grad_depths[p, h] = change * weights[p, h]
            grad_weights[p, h] = change * (depths[p, h] - mean)

    return SimpleNamespace(forward=depth_errors, backward=depth_errors_backward)
