"""The surfel itself: its frame in the camera and the hit of a ray. Shared by every pass, forward and backward.

A surfel is stored for the walk along a ray as four rows, its record (16 scalars):

    row 0   a = (v2 x c) / s1, opacity        u = (a . d) / (n . d)
    row 1   b = (c x v1) / s2, gamma 1        v = (b . d) / (n . d)
    row 2   n, gamma 2                        t = m / (n . d)
    row 3   plain colour, m = c . n

with c its centre and v1, v2, n its axes in the camera frame. There is no division by m: a surfel seen edge-on through
its centre stays finite.
"""

import functools
import math
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.types import types
from nexwarp.native.simd import simd_functions

# Relative to the terms of the sums that decide whether a block of pixels is culled: float32 has a tenth of it.
BLOCK_SLACK = 1e-6
# Bounds for SIMD, where a ray without a hit is computed too, and for the low-pass, which hits where the surfel does
# not: far beyond what a hit of the surfel can have, and finite, since their derivatives meet a 0.
LARGEST_SQUARE = 1e30
LARGEST_EXPONENT = 115.0  # of 2
LEAST_COSINE = 1e-18


@functools.cache
def frame_functions(real: type) -> SimpleNamespace:
    """Functions that take a surfel to the camera frame."""
    t = types(real)
    vec3, vec4, mat33, mat44 = t.vec3, t.vec4, t.mat33, t.mat44
    ONE, TWO = t.ONE, t.TWO

    @wp.func
    def rotation(quat: vec4):
        """Rotation matrix of a unit quaternion, wxyz."""
        w = quat[0]
        x = quat[1]
        y = quat[2]
        z = quat[3]
        return mat33(
            ONE - TWO * (y * y + z * z),
            TWO * (x * y - w * z),
            TWO * (x * z + w * y),
            TWO * (x * y + w * z),
            ONE - TWO * (x * x + z * z),
            TWO * (y * z - w * x),
            TWO * (x * z - w * y),
            TWO * (y * z + w * x),
            ONE - TWO * (x * x + y * y),
        )

    @wp.func
    def rotate(viewmat: mat44, x: vec3):
        """Rotate a world direction into the camera frame."""
        return vec3(
            viewmat[0, 0] * x[0] + viewmat[0, 1] * x[1] + viewmat[0, 2] * x[2],
            viewmat[1, 0] * x[0] + viewmat[1, 1] * x[1] + viewmat[1, 2] * x[2],
            viewmat[2, 0] * x[0] + viewmat[2, 1] * x[1] + viewmat[2, 2] * x[2],
        )

    @wp.func
    def rotate_back(viewmat: mat44, x: vec3):
        """Rotate a camera-frame direction into the world."""
        return vec3(
            viewmat[0, 0] * x[0] + viewmat[1, 0] * x[1] + viewmat[2, 0] * x[2],
            viewmat[0, 1] * x[0] + viewmat[1, 1] * x[1] + viewmat[2, 1] * x[2],
            viewmat[0, 2] * x[0] + viewmat[1, 2] * x[1] + viewmat[2, 2] * x[2],
        )

    @wp.func
    def translation(viewmat: mat44):
        return vec3(viewmat[0, 3], viewmat[1, 3], viewmat[2, 3])

    @wp.func
    def intrinsics_of(Ks: wp.array(dtype=mat33)):
        """(fx, fy, cx, cy) of a camera's matrix: read from memory, so that a CUDA graph serves every camera."""
        K = Ks[0]
        return vec4(K[0, 0], K[1, 1], K[0, 2], K[1, 2])

    return SimpleNamespace(
        rotation=rotation,
        rotate=rotate,
        rotate_back=rotate_back,
        translation=translation,
        intrinsics_of=intrinsics_of,
    )


@functools.cache
def hit_functions(real: type, low_pass: bool, width: int = 1) -> SimpleNamespace:
    """The hit of a ray on a surfel (paper Eq. 3), and its derivatives.

    Rays have directions (dx, dy, 1). With `width` of them at once (see `native.simd`), dx and what follows from it are
    vectors, dy and the surfel are the same for all, and derivatives with respect to the surfel are for the caller to
    sum over the rays.
    """
    f = simd_functions(real, width)
    t = types(real)
    vec2, vec3, vec4 = t.vec2, t.vec3, t.vec4
    ZERO, HALF, ONE, TWO = t.ZERO, t.HALF, t.ONE, t.TWO
    reals = f.reals
    splat, scaled, times, over = f.splat, f.scaled, f.times, f.over
    power_of_2, binary_logarithm, below, pick = f.power_of_2, f.binary_logarithm, f.below, f.pick
    at_least, at_most = f.at_least, f.at_most
    SLACK = wp.constant(real(BLOCK_SLACK))
    ALPHA_MAX, TINY = t.ALPHA_MAX, t.TINY
    EXPONENT = wp.constant(real(LARGEST_EXPONENT))
    LARGE, LEAST = wp.constant(real(LARGEST_SQUARE)), wp.constant(real(LEAST_COSINE))
    # e^(-x / 2) is 2 to the power of this times x.
    FALLOFF, LN_2 = wp.constant(real(-0.5 / math.log(2.0))), wp.constant(real(math.log(2.0)))

    @wp.func
    def inverse_cosine(n: vec4, dx: reals, dy: real):
        """1 / (n . d)."""
        cosine = scaled(n[0], dx) + splat(n[1] * dy + n[2])
        if wp.static(width > 1):
            # All rays are differentiated, those without a hit by 0: which must not meet an infinity.
            cosine = pick(below(times(cosine, cosine), splat(LEAST * LEAST)), splat(LEAST), cosine)
        return over(splat(ONE), cosine)

    @wp.func
    def plane(a: vec4, b: vec4, n: vec4, m: real, dx: reals, dy: real):
        """(u, v, t) where the rays meet the surfel's plane."""
        inverse = inverse_cosine(n, dx, dy)
        u = times(scaled(a[0], dx) + splat(a[1] * dy + a[2]), inverse)
        v = times(scaled(b[0], dx) + splat(b[1] * dy + b[2]), inverse)
        return u, v, scaled(m, inverse)

    @wp.func
    def far_outside(u: real, v: real, limit: real):
        """True only where alpha is certainly below 1/255: spares the exponentials.

        Beyond 1, |u|^(2g) is at least u^2; `limit` is what the exponent of a hit cannot exceed.
        """
        if wp.static(low_pass):
            return False
        u2 = u * u
        v2 = v * v
        low = wp.where(u2 > ONE, u2, ZERO) + wp.where(v2 > ONE, v2, ZERO)
        return low > limit

    @wp.func
    def beside(side: vec4, n: vec4, facing: real, reach: real, d: vec2, half: vec2):
        """Whether all rays of a block, d +- half, meet the plane where |coordinate| > reach, `side` being a or b.

        Where the hit lies before the camera, facing * n . d > 0, so that side . d <= reach * facing * n . d is linear
        in d: the block's corners bound it. The slack is for rounding.
        """
        x = side[0] * d[0]
        y = side[1] * d[1]
        nx = facing * reach * n[0]
        ny = facing * reach * n[1]
        across = facing * reach * n[2] + nx * d[0] + ny * d[1]
        along = x + y + side[2]
        slack = SLACK * (
            wp.abs(x) + wp.abs(y) + wp.abs(side[2]) + reach * (wp.abs(n[0] * d[0]) + wp.abs(n[1] * d[1]) + wp.abs(n[2]))
        )
        above = along - across - wp.abs(side[0] - nx) * half[0] - wp.abs(side[1] - ny) * half[1]
        below = -along - across - wp.abs(side[0] + nx) * half[0] - wp.abs(side[1] + ny) * half[1]
        return above > slack or below > slack

    @wp.func
    def misses_block(
        a: vec4, b: vec4, n: vec4, m: real, reach: vec2, limit: real, center: vec3, d: vec2, half: vec2, focal: vec2
    ):
        """Whether no ray of a block of pixels, d +- half, can hit. Only culls: conservative."""
        facing = wp.where(m < ZERO, -ONE, ONE)
        out = beside(a, n, facing, reach[0], d, half) or beside(b, n, facing, reach[1], d, half)
        if wp.static(low_pass):
            if center[2] > ZERO:
                # The disc's radius is sqrt(limit / 2) pixels, `limit` having a margin already.
                radius = wp.sqrt(HALF * wp.max(limit, ZERO))
                x = wp.abs(d[0] - center[0] / center[2]) - half[0]
                y = wp.abs(d[1] - center[1] / center[2]) - half[1]
                out = out and (x * focal[0] > radius or y * focal[1] > radius)
        return out

    @wp.func
    def square_of(x: reals):
        square = at_least(times(x, x), TINY)
        if wp.static(width > 1 or low_pass):
            square = at_most(square, LARGE)
        return square

    @wp.func
    def power(logarithm: reals, gamma: real):
        """|x|^(2 gamma), given the binary logarithm of x^2."""
        exponent = scaled(gamma, logarithm)
        if wp.static(width == 1 and low_pass):
            exponent = at_most(exponent, EXPONENT)
        return power_of_2(exponent)

    @wp.func
    def offset(center: vec3, dx: reals, dy: real, focal: vec2):
        """(x, y) from the projected centre to the rays, pixels."""
        return scaled(focal[0], dx - splat(center[0] / center[2])), focal[1] * (dy - center[1] / center[2])

    @wp.func
    def kernel(
        u: reals,
        v: reals,
        t: reals,
        a: vec4,
        b: vec4,
        n: vec4,
        center: vec3,
        dx: reals,
        dy: real,
        focal: vec2,
        near: real,
    ):
        """(alpha, t): the generalised Gaussian, its low-pass where asked for, and the depth of the hit."""
        exponent = power(binary_logarithm(square_of(u)), b[3]) + power(binary_logarithm(square_of(v)), n[3])
        depth = t
        if wp.static(low_pass):
            # 2DGS's object-space low-pass: a screen-space Gaussian of variance 1/2 pixel^2 around the projected centre.
            if center[2] > near:
                x, y = offset(center, dx, dy, focal)
                screen = scaled(TWO, times(x, x)) + splat(TWO * y * y)
                # Also where the exponent is not a number.
                inside = below(exponent, screen)
                exponent = pick(inside, exponent, screen)
                depth = pick(inside, depth, splat(center[2]))
        alpha = scaled(a[3], power_of_2(scaled(FALLOFF, exponent)))
        return at_most(alpha, ALPHA_MAX), depth

    @wp.func
    def hit_gradients(
        u: reals,
        v: reals,
        t: reals,
        a: vec4,
        b: vec4,
        n: vec4,
        center: vec3,
        dx: reals,
        dy: real,
        focal: vec2,
        near: real,
        grad_alpha: reals,
        grad_depth: reals,
    ):
        """What the gradients of `kernel`'s (alpha, t) are for each ray; the caller expands them (see `surfel`).

        Returns:
            The gradients of a . d, b . d, n . d, m, opacity, gamma 1 and gamma 2 for each ray, those of the first three
            through 1 / (n . d); and, with the low-pass, those of the projected centre's (x, y) in pixels and of the
            centre's depth, else zeros.
        """
        log_u = binary_logarithm(square_of(u))
        log_v = binary_logarithm(square_of(v))
        power_u = power(log_u, b[3])
        power_v = power(log_v, n[3])
        exponent = power_u + power_v
        none = splat(ZERO)
        x = splat(ZERO)
        y = real(0.0)
        # Whether the exponent is the surfel's own, not that of the screen-space Gaussian.
        own = below(splat(ZERO), splat(ONE))
        if wp.static(low_pass):
            if center[2] > near:
                x, y = offset(center, dx, dy, focal)
                screen = scaled(TWO, times(x, x)) + splat(TWO * y * y)
                own = below(exponent, screen)
                exponent = pick(own, exponent, screen)
        falloff = power_of_2(scaled(FALLOFF, exponent))
        alpha = scaled(a[3], falloff)
        # A clamped alpha is constant.
        grad_falloff = pick(below(alpha, splat(ALPHA_MAX)), grad_alpha, none)
        grad_opacity = times(grad_falloff, falloff)
        grad_exponent = scaled(-HALF, times(grad_falloff, alpha))
        grad_power_u = times(grad_exponent, power_u)
        grad_power_v = times(grad_exponent, power_v)
        inverse = inverse_cosine(n, dx, dy)
        grad_u = times(scaled(TWO * b[3], times(over(grad_power_u, square_of(u)), u)), inverse)
        grad_v = times(scaled(TWO * n[3], times(over(grad_power_v, square_of(v)), v)), inverse)
        grad_m = times(grad_depth, inverse)
        grad_n = -(times(grad_u, u) + times(grad_v, v) + times(grad_m, t))
        grad_gamma_1 = scaled(LN_2, times(grad_power_u, log_u))
        grad_gamma_2 = scaled(LN_2, times(grad_power_v, log_v))
        grad_x = splat(ZERO)
        grad_y = splat(ZERO)
        grad_z = splat(ZERO)
        if wp.static(low_pass):
            # Picked, not multiplied by 0: where only the screen-space Gaussian hits, u and v may be infinite.
            grad_u = pick(own, grad_u, none)
            grad_v = pick(own, grad_v, none)
            grad_n = pick(own, grad_n, none)
            grad_m = pick(own, grad_m, none)
            grad_gamma_1 = pick(own, grad_gamma_1, none)
            grad_gamma_2 = pick(own, grad_gamma_2, none)
            grad_screen = pick(own, none, grad_exponent)
            grad_x = scaled(-TWO * TWO, times(grad_screen, x))
            grad_y = scaled(-TWO * TWO * y, grad_screen)
            grad_z = pick(own, none, grad_depth)
        return grad_u, grad_v, grad_n, grad_m, grad_opacity, grad_gamma_1, grad_gamma_2, grad_x, grad_y, grad_z

    @wp.func
    def center_gradient(center: vec3, focal: vec2, grad_x: real, grad_y: real, grad_z: real):
        """Gradient of a centre, given those of its projection in pixels and of its depth."""
        if not (center[2] > ZERO):
            return vec3()
        gx = grad_x * focal[0] / center[2]
        gy = grad_y * focal[1] / center[2]
        return vec3(gx, gy, grad_z - (gx * center[0] + gy * center[1]) / center[2])

    return SimpleNamespace(
        plane=plane,
        far_outside=far_outside,
        misses_block=misses_block,
        kernel=kernel,
        hit_gradients=hit_gradients,
        center_gradient=center_gradient,
    )
