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

from nexwarp.kernels.types import types

# Relative to the terms of the sums that decide whether a block of pixels is culled: float32 has a tenth of it.
BLOCK_SLACK = 1e-6


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

    return SimpleNamespace(rotation=rotation, rotate=rotate, rotate_back=rotate_back, translation=translation)


@functools.cache
def hit_functions(real: type, low_pass: bool) -> SimpleNamespace:
    """The hit of a ray on a surfel (paper Eq. 3), and its contraction for `wp.grad`."""
    t = types(real)
    vec2, vec3, vec4 = t.vec2, t.vec3, t.vec4
    ALPHA_MAX, TINY, ZERO, HALF, ONE, TWO = t.ALPHA_MAX, t.TINY, t.ZERO, t.HALF, t.ONE, t.TWO
    SLACK = wp.constant(real(BLOCK_SLACK))

    @wp.func
    def plane(a: vec4, b: vec4, n: vec4, m: real, d: vec3):
        """(u, v, t) where the ray along d meets the surfel's plane."""
        inverse = ONE / (n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
        u = (a[0] * d[0] + a[1] * d[1] + a[2] * d[2]) * inverse
        v = (b[0] * d[0] + b[1] * d[1] + b[2] * d[2]) * inverse
        return vec3(u, v, m * inverse)

    @wp.func
    def far_outside(uvt: vec3, limit: real):
        """True only where alpha is certainly below 1/255: spares the exponentials.

        Beyond 1, |u|^(2g) is at least u^2; `limit` is what the exponent of a hit cannot exceed.
        """
        if wp.static(low_pass):
            return False
        u2 = uvt[0] * uvt[0]
        v2 = uvt[1] * uvt[1]
        low = wp.where(u2 > ONE, u2, ZERO) + wp.where(v2 > ONE, v2, ZERO)
        return low > limit

    @wp.func
    def beside(side: vec4, n: vec4, facing: real, reach: real, d: vec3, half: vec2):
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
        a: vec4, b: vec4, n: vec4, m: real, reach: vec2, limit: real, center: vec3, d: vec3, half: vec2, focal: vec2
    ):
        """Whether no ray of a block of pixels, d +- half, can hit; d[2] = 1. Only culls: conservative."""
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
    def kernel(uvt: vec3, a: vec4, b: vec4, n: vec4, center: vec3, d: vec3, focal: vec2, near: real):
        """(alpha, t): the generalised Gaussian, its low-pass where asked for, and the depth of the hit."""
        u2 = wp.max(uvt[0] * uvt[0], TINY)
        v2 = wp.max(uvt[1] * uvt[1], TINY)
        exponent = wp.exp(b[3] * wp.log(u2)) + wp.exp(n[3] * wp.log(v2))
        depth = uvt[2]
        if wp.static(low_pass):
            # 2DGS's object-space low-pass: a screen-space Gaussian of variance 1/2 pixel^2 around the projected centre.
            if center[2] > near:
                x = focal[0] * (d[0] - center[0] / center[2])
                y = focal[1] * (d[1] - center[1] / center[2])
                screen = TWO * (x * x + y * y)
                if screen < exponent or not (exponent >= real(0.0)):
                    exponent = screen
                    depth = center[2]
        return vec2(wp.min(a[3] * wp.exp(-HALF * exponent), ALPHA_MAX), depth)

    @wp.func
    def hit_dot(
        a: vec4,
        b: vec4,
        n: vec4,
        m: real,
        center: vec3,
        d: vec3,
        focal: vec2,
        near: real,
        grad_alpha: real,
        grad_depth: real,
    ):
        """grad_alpha * alpha + grad_depth * t: wp.grad of a scalar contraction is the vector-Jacobian product."""
        hit = kernel(plane(a, b, n, m, d), a, b, n, center, d, focal, near)
        return grad_alpha * hit[0] + grad_depth * hit[1]

    return SimpleNamespace(
        plane=plane, far_outside=far_outside, misses_block=misses_block, kernel=kernel, hit_dot=hit_dot
    )
