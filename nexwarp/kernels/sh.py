"""Spherical harmonics colours of degree 0 to 3: plain (a thread a surfel) and textured (a thread a point).

Plain colours use Warp's own adjoint; textured ones are linear in the coefficients, and `wp.grad` differentiates the
basis. Constants and signs are the field's.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.types import types

BAND_0 = 0.28209479177387814
BAND_1 = 0.4886025119029199
BAND_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
BAND_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


@functools.cache
def basis_function(real: type, degree: int) -> wp.Function:
    """Make the function that evaluates the (degree + 1)^2 basis functions at a unit direction."""
    vec3 = types(real).vec3
    vec = wp.types.vector(length=(degree + 1) ** 2, dtype=real)
    A0, B0 = wp.constant(real(BAND_0)), wp.constant(real(BAND_1))
    C0, C1, C2 = (wp.constant(real(c)) for c in BAND_2)
    D0, D1, D2, D3, D4 = (wp.constant(real(c)) for c in BAND_3)

    @wp.func
    def basis(d: vec3):
        out = vec()
        out[0] = A0
        if wp.static(degree >= 1):
            out[1] = -B0 * d[1]
            out[2] = B0 * d[2]
            out[3] = -B0 * d[0]
        if wp.static(degree >= 2):
            xx = d[0] * d[0]
            yy = d[1] * d[1]
            zz = d[2] * d[2]
            out[4] = C0 * d[0] * d[1]
            out[5] = -C0 * d[1] * d[2]
            out[6] = C1 * (real(2.0) * zz - xx - yy)
            out[7] = -C0 * d[0] * d[2]
            out[8] = C2 * (xx - yy)
        if wp.static(degree >= 3):
            x2 = d[0] * d[0]
            y2 = d[1] * d[1]
            z2 = d[2] * d[2]
            out[9] = -D0 * d[1] * (real(3.0) * x2 - y2)
            out[10] = D1 * d[0] * d[1] * d[2]
            out[11] = -D2 * d[1] * (real(4.0) * z2 - x2 - y2)
            out[12] = D3 * d[2] * (real(2.0) * z2 - real(3.0) * x2 - real(3.0) * y2)
            out[13] = -D2 * d[0] * (real(4.0) * z2 - x2 - y2)
            out[14] = D4 * d[2] * (x2 - y2)
            out[15] = -D0 * d[0] * (x2 - real(3.0) * y2)
        return out

    return basis


@functools.cache
def plain_colors_kernel(real: type, degree: int) -> wp.Kernel:
    """Make the kernel of max(0, 0.5 + SH(direction from the camera's centre to the surfel's))."""
    vec3 = types(real).vec3
    basis = basis_function(real, degree)
    count = (degree + 1) ** 2
    # A surfel at the camera's very centre has no direction; it takes the forward one, without gradient.
    TINY = wp.constant(real(1e-12))

    @wp.kernel(module="unique")
    def plain_colors(
        first: wp.int32,
        sh: wp.array2d(dtype=vec3),
        means: wp.array(dtype=vec3),
        positions: wp.array(dtype=vec3),
        position_step: wp.int32,
        # outputs
        colors: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        ray = means[i] - positions[i * position_step]
        length = wp.length(ray)
        direction = vec3(real(0.0), real(0.0), real(1.0))
        if length > TINY:
            direction = ray / length
        b = basis(direction)
        color = vec3(real(0.5), real(0.5), real(0.5))
        for k in range(wp.static(count)):
            color += sh[i, k] * b[k]
        colors[i] = wp.max(color, vec3())

    return plain_colors


@functools.cache
def textured_colors_kernels(real: type, storage: type, degree: int, clamp: bool) -> SimpleNamespace:
    """Make the kernels of 0.5 + SH(ray direction); coefficients from the field are in rows coefficient * 3 + channel.

    The backward kernel stores grad_coefficients times `scale[0]`, so that half precision holds them.
    """
    vec3 = types(real).vec3
    basis = basis_function(real, degree)
    count = (degree + 1) ** 2
    vec = wp.types.vector(length=count, dtype=real)

    @wp.func
    def color_of(coefficients: wp.array2d(dtype=storage), i: int, b: vec):
        color = vec3(real(0.5), real(0.5), real(0.5))
        for k in range(wp.static(count)):
            color[0] += real(coefficients[3 * k, i]) * b[k]
            color[1] += real(coefficients[3 * k + 1, i]) * b[k]
            color[2] += real(coefficients[3 * k + 2, i]) * b[k]
        return color

    @wp.func
    def basis_dot(d: vec3, w: vec):
        return wp.dot(basis(d), w)

    @wp.kernel(enable_backward=False, module="unique")
    def textured_colors(
        first: wp.int32,
        coefficients: wp.array2d(dtype=storage),
        directions: wp.array(dtype=vec3),
        hits: wp.int32,
        # outputs
        colors: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        color = color_of(coefficients, i, basis(directions[i // hits]))
        if wp.static(clamp):
            color = wp.max(color, vec3())
        colors[i] = color

    @wp.kernel(enable_backward=False, module="unique")
    def textured_colors_backward(
        first: wp.int32,
        coefficients: wp.array2d(dtype=storage),
        directions: wp.array(dtype=vec3),
        hits: wp.int32,
        scale: wp.array(dtype=real),
        grad_colors: wp.array(dtype=vec3),
        # outputs
        grad_coefficients: wp.array2d(dtype=storage),
        grad_directions: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        direction = directions[i // hits]
        b = basis(direction)
        grad = grad_colors[i]
        if wp.static(clamp):
            color = color_of(coefficients, i, b)
            for c in range(3):
                if not (color[c] > real(0.0)):
                    grad[c] = real(0.0)
        for k in range(wp.static(count)):
            for c in range(3):
                grad_coefficients[3 * k + c, i] = storage(grad[c] * b[k] * scale[0])
        if grad_directions.shape[0] > 0:
            w = vec()
            for k in range(wp.static(count)):
                w[k] = (
                    grad[0] * real(coefficients[3 * k, i])
                    + grad[1] * real(coefficients[3 * k + 1, i])
                    + grad[2] * real(coefficients[3 * k + 2, i])
                )
            gd, _w = wp.grad(basis_dot)(direction, w)
            grad_directions[i] = gd

    return SimpleNamespace(forward=textured_colors, backward=textured_colors_backward)
