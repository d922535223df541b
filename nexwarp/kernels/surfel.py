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
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.native.simd import simd_functions
from nexwarp.kernels.types import types

# Relative to the terms of the sums that decide whether a block of pixels is culled: float32 has a tenth of it.
BLOCK_SLACK = 1e-6
# Bounds for SIMD, where a ray without a hit is computed too, and for the low-pass, which hits where the surfel does
# not: far beyond what a hit of the surfel can have, and finite, since their derivatives meet a 0.
LARGEST_SQUARE = 1e30
LARGEST_EXPONENT = 80.0
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
    """The hit of a ray on a surfel (paper Eq. 3), and its contraction for `wp.grad`.

    Rays have directions (dx, dy, 1). With `width` of them at once (see `native.simd`), dx and what follows from it are
    vectors, dy and the surfel are the same for all, and the contraction is the sum over the rays.

    The contraction calls copies of the functions: `wp.grad` finds no derivative, and silently takes 0, of a function
    two calls down that the kernel has already used for its value.
    """
    values = _hit_functions(real, low_pass, width, simd_functions(real, width))
    values.hit_dot = _hit_functions(real, low_pass, width, simd_functions(real, width, for_gradients=True)).hit_dot
    return values


def _hit_functions(real: type, low_pass: bool, width: int, f: SimpleNamespace) -> SimpleNamespace:
    t = types(real)
    vec2, vec3, vec4 = t.vec2, t.vec3, t.vec4
    ZERO, HALF, ONE, TWO = t.ZERO, t.HALF, t.ONE, t.TWO
    reals = f.reals
    splat, scaled, times, over, inner = f.splat, f.scaled, f.times, f.over, f.inner
    power_of_e, logarithm, below, pick = f.power_of_e, f.logarithm, f.below, f.pick
    at_least, at_most = f.at_least, f.at_most
    SLACK = wp.constant(real(BLOCK_SLACK))
    ALPHA_MAX, TINY = t.ALPHA_MAX, t.TINY
    EXPONENT = wp.constant(real(LARGEST_EXPONENT))
    LARGE, LEAST = wp.constant(real(LARGEST_SQUARE)), wp.constant(real(LEAST_COSINE))

    @wp.func
    def plane(a: vec4, b: vec4, n: vec4, m: real, dx: reals, dy: real):
        """(u, v, t) where the rays meet the surfel's plane."""
        cosine = scaled(n[0], dx) + splat(n[1] * dy + n[2])
        if wp.static(width > 1):
            # All rays are differentiated, those without a hit by 0: which must not meet an infinity.
            cosine = pick(below(times(cosine, cosine), splat(LEAST * LEAST)), splat(LEAST), cosine)
        inverse = over(splat(ONE), cosine)
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
    def power(x: reals, gamma: real):
        """|x|^(2 gamma)."""
        square = at_least(times(x, x), TINY)
        if wp.static(width > 1 or low_pass):
            square = at_most(square, LARGE)
        exponent = scaled(gamma, logarithm(square))
        if wp.static(width == 1 and low_pass):
            exponent = at_most(exponent, EXPONENT)
        return power_of_e(exponent)

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
        exponent = power(u, b[3]) + power(v, n[3])
        depth = t
        if wp.static(low_pass):
            # 2DGS's object-space low-pass: a screen-space Gaussian of variance 1/2 pixel^2 around the projected centre.
            if center[2] > near:
                x = scaled(focal[0], dx - splat(center[0] / center[2]))
                y = focal[1] * (dy - center[1] / center[2])
                screen = scaled(TWO, times(x, x)) + splat(TWO * y * y)
                # Also where the exponent is not a number.
                inside = below(exponent, screen)
                exponent = pick(inside, exponent, screen)
                depth = pick(inside, depth, splat(center[2]))
        alpha = scaled(a[3], power_of_e(scaled(-HALF, exponent)))
        return at_most(alpha, ALPHA_MAX), depth

    @wp.func
    def hit_dot(
        a: vec4,
        b: vec4,
        n: vec4,
        m: real,
        center: vec3,
        dx: reals,
        dy: real,
        focal: vec2,
        near: real,
        grad_alpha: reals,
        grad_depth: reals,
    ):
        """grad_alpha * alpha + grad_depth * t: wp.grad of a scalar contraction is the vector-Jacobian product."""
        u, v, t = plane(a, b, n, m, dx, dy)
        alpha, depth = kernel(u, v, t, a, b, n, center, dx, dy, focal, near)
        return inner(grad_alpha, alpha) + inner(grad_depth, depth)

    return SimpleNamespace(
        plane=plane, far_outside=far_outside, misses_block=misses_block, kernel=kernel, hit_dot=hit_dot
    )
