"""Spherical harmonics colours of degree 0 to 3: plain ones of surfels, textured ones of points (paper Sec. 4.1).

A thread is a surfel (plain) or a point (textured). Read: coefficients and directions. Written: colours; backward, the
gradients of coefficients and directions, which `wp.grad` of the basis gives. Nothing is added up. A colour that was
clamped to 0 has no gradient. Constants and signs are the field's.

Of lower degrees, plain colours use the first `count` functions of the basis, textured ones those with coefficients.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from nexwarp.kernels.types import MAX_SH_DEGREE, func_per_real, per_real

BAND_0 = 0.28209479177387814
BAND_1 = 0.4886025119029199
BAND_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
BAND_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
A0, B0, (C0, C1, C2), (D0, D1, D2, D3, D4) = BAND_0, BAND_1, BAND_2, BAND_3
TINY = wp.constant(wp.float64(1e-12))
FUNCTIONS = wp.constant((MAX_SH_DEGREE + 1) ** 2)  # of the basis


@wp.func
def direction_of(ray: Any):
    """Unit vector along a ray; the forward one, as a constant, for a surfel at the camera's very centre."""
    length = wp.length(ray)
    direction = type(ray)(type(length)(0.0), type(length)(0.0), type(length)(1.0))
    if length > type(length)(TINY):
        direction = ray / length
    return direction


@wp.func
def unclamped(grad: Any, color: Any):
    """Gradient of what `color` was before it was clamped to >= 0."""
    out = type(grad)()
    for c in range(3):
        if color[c] > type(color[c])(0.0):
            out[c] = grad[c]
    return out


@func_per_real
def basis(d: vec3):
    """The basis functions of degrees 0 to 3 at a unit direction."""
    out = wp.vector(length=FUNCTIONS, dtype=real)
    xx = d[0] * d[0]
    yy = d[1] * d[1]
    zz = d[2] * d[2]
    out[0] = A0
    out[1] = -B0 * d[1]
    out[2] = B0 * d[2]
    out[3] = -B0 * d[0]
    out[4] = C0 * d[0] * d[1]
    out[5] = -C0 * d[1] * d[2]
    out[6] = C1 * (real(2.0) * zz - xx - yy)
    out[7] = -C0 * d[0] * d[2]
    out[8] = C2 * (xx - yy)
    out[9] = -D0 * d[1] * (real(3.0) * xx - yy)
    out[10] = D1 * d[0] * d[1] * d[2]
    out[11] = -D2 * d[1] * (real(4.0) * zz - xx - yy)
    out[12] = D3 * d[2] * (real(2.0) * zz - real(3.0) * xx - real(3.0) * yy)
    out[13] = -D2 * d[0] * (real(4.0) * zz - xx - yy)
    out[14] = D4 * d[2] * (xx - yy)
    out[15] = -D0 * d[0] * (xx - real(3.0) * yy)
    return out


@func_per_real
def ray_dot(ray: vec3, w: Any):
    return wp.dot(basis(direction_of(ray)), w)


@per_real()
def plain_colors(first: int, count: int, sh0: vec3_rows, shN: vec3_rows, means: vec3s, position: vec3s, colors: vec3s):
    """max(0, 0.5 + SH(direction from the camera's centre to the surfel's))."""
    i = first + wp.tid()
    b = basis(direction_of(means[i] - position[0]))
    color = vec3(real(0.5), real(0.5), real(0.5)) + sh0[i, 0] * b[0]
    for k in range(1, FUNCTIONS):
        if k < count:
            color += shN[i, k - 1] * b[k]
    colors[i] = wp.max(color, vec3())


@per_real()
def plain_coefficients_backward(  # noqa: PLR0913  # a kernel entry point
    first: int,
    count: int,
    sharing: int,
    means: vec3s,
    position: vec3s,
    colors: vec3s,
    grad_colors: vec3s,
    # outputs
    grad_sh0: vec3_rows,
    grad_shN: vec3_rows,
):
    """Gradients of coefficients, sh0 (N, 1) and shN (N, C - 1); a colour of 0 was clamped and has none.

    `sharing` threads share a surfel: with C of them each writes one coefficient and neighbours write neighbouring
    addresses; one alone evaluates the basis but once.
    """
    thread = first + wp.tid()
    i = thread // sharing
    grad = unclamped(grad_colors[i], colors[i])
    b = basis(direction_of(means[i] - position[0]))
    for k in range(thread - i * sharing, grad_shN.shape[1] + 1, sharing):
        # Not b[k]: an index that the compiler does not know moves the basis from registers to memory.
        value = real(0.0)
        for c in range(FUNCTIONS):
            value = wp.where(c == k, b[c], value)
        value = wp.where(k < count, value, real(0.0))
        if k == 0:
            grad_sh0[i, 0] = grad * value
        else:
            grad_shN[i, k - 1] = grad * value


@per_real()
def plain_rays_backward(
    first: int,
    count: int,
    shN: vec3_rows,
    means: vec3s,
    position: vec3s,
    colors: vec3s,
    grad_colors: vec3s,
    grad_rays: vec3s,
):
    """Gradients of the rays from the camera's centre to the surfels' centres."""
    i = first + wp.tid()
    grad = unclamped(grad_colors[i], colors[i])
    w = wp.vector(length=FUNCTIONS, dtype=real)
    for k in range(1, FUNCTIONS):
        if k < count:
            w[k] = wp.dot(grad, shN[i, k - 1])
    ray, _w = wp.grad(ray_dot)(means[i] - position[0], w)
    grad_rays[i] = ray


@func_per_real
def color_of(coefficients: wp.array2d(dtype=storage), i: int, b: Any, offset: real):
    color = vec3(offset, offset, offset)
    for k in range(FUNCTIONS):
        if 3 * k < coefficients.shape[0]:
            color[0] += real(coefficients[3 * k, i]) * b[k]
            color[1] += real(coefficients[3 * k + 1, i]) * b[k]
            color[2] += real(coefficients[3 * k + 2, i]) * b[k]
    return color


@func_per_real
def direction_dot(d: vec3, w: Any):
    return wp.dot(basis(d), w)


@per_real("storage", "clamp")
def textured_colors(
    first: int, coefficients: wp.array2d(dtype=storage), directions: vec3s, hits: int, offset: real, colors: vec3s
):
    """Offset + SH(ray direction); coefficients are in rows coefficient * 3 + channel."""
    i = first + wp.tid()
    color = color_of(coefficients, i, basis(directions[i // hits]), offset)
    if wp.static(clamp):
        color = wp.max(color, vec3())
    colors[i] = color


@per_real("storage", "clamp")
def textured_colors_backward(  # noqa: PLR0913  # a kernel entry point
    first: int,
    coefficients: wp.array2d(dtype=storage),
    directions: vec3s,
    hits: int,
    offset: real,
    scale: reals,
    grad_colors: vec3s,
    # outputs
    grad_coefficients: wp.array2d(dtype=storage),
    grad_directions: vec3s,
):
    """Gradients; those of coefficients times `scale[0]`, so that half precision holds them."""
    i = first + wp.tid()
    direction = directions[i // hits]
    b = basis(direction)
    grad = grad_colors[i]
    if wp.static(clamp):
        grad = unclamped(grad, color_of(coefficients, i, b, offset))
    for k in range(FUNCTIONS):
        if 3 * k < coefficients.shape[0]:
            for c in range(3):
                grad_coefficients[3 * k + c, i] = storage(grad[c] * b[k] * scale[0])
    if grad_directions.shape[0] > 0:
        w = wp.vector(length=FUNCTIONS, dtype=real)
        for k in range(FUNCTIONS):
            if 3 * k < coefficients.shape[0]:
                w[k] = (
                    grad[0] * real(coefficients[3 * k, i])
                    + grad[1] * real(coefficients[3 * k + 1, i])
                    + grad[2] * real(coefficients[3 * k + 2, i])
                )
        gd, _w = wp.grad(direction_dot)(direction, w)
        grad_directions[i] = gd
