"""The surfel itself: its frame in the camera and the hit of a ray. Shared by every pass, forward and backward.

A surfel is stored for the walk along a ray as four rows, its record (16 scalars):

    row 0   a = (v2 x c) / s1, opacity        u = (a . d) / (n . d)
    row 1   b = (c x v1) / s2, gamma 1        v = (b . d) / (n . d)
    row 2   n, gamma 2                        t = m / (n . d)
    row 3   plain colour, m = c . n

with c its centre, v1, v2, n its axes in the camera frame, and d the ray's direction (x, y, 1), given as (x, y). There
is no division by m: a surfel seen edge-on through its centre stays finite. Its opacity at (u, v): `shape`.
"""

import warp as wp

from nexwarp.kernels.shape import alpha_gradients
from nexwarp.kernels.types import Mat33, Mat44, Real, Vec2, Vec3, Vec4, Vec7


@wp.func
def axes(quat: Vec4):
    """(x, y, z) axes of a unit quaternion, wxyz: the columns of its rotation matrix."""
    one = quat.dtype(1.0)
    two = quat.dtype(2.0)
    w = quat[0]
    x = quat[1]
    y = quat[2]
    z = quat[3]
    return (
        wp.vector(one - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)),
        wp.vector(two * (x * y - w * z), one - two * (x * x + z * z), two * (y * z + w * x)),
        wp.vector(two * (x * z + w * y), two * (y * z - w * x), one - two * (x * x + y * y)),
    )


@wp.func
def rotate(viewmat: Mat44, x: Vec3):
    """Rotate a world direction into the camera frame."""
    return wp.vector(
        viewmat[0, 0] * x[0] + viewmat[0, 1] * x[1] + viewmat[0, 2] * x[2],
        viewmat[1, 0] * x[0] + viewmat[1, 1] * x[1] + viewmat[1, 2] * x[2],
        viewmat[2, 0] * x[0] + viewmat[2, 1] * x[1] + viewmat[2, 2] * x[2],
    )


@wp.func
def rotate_back(viewmat: Mat44, x: Vec3):
    """Rotate a camera-frame direction into the world."""
    return wp.vector(
        viewmat[0, 0] * x[0] + viewmat[1, 0] * x[1] + viewmat[2, 0] * x[2],
        viewmat[0, 1] * x[0] + viewmat[1, 1] * x[1] + viewmat[2, 1] * x[2],
        viewmat[0, 2] * x[0] + viewmat[1, 2] * x[1] + viewmat[2, 2] * x[2],
    )


@wp.func
def translation(viewmat: Mat44):
    """World origin in the camera frame."""
    return wp.vector(viewmat[0, 3], viewmat[1, 3], viewmat[2, 3])


@wp.func
def intrinsics_of(K: Mat33):
    """(fx, fy, cx, cy) of a camera's matrix."""
    return wp.vector(K[0, 0], K[1, 1], K[0, 2], K[1, 2])


@wp.func
def ray_through(x: Real, y: Real, intrinsics: Vec4):
    """Direction (x, y) through pixel coordinates; its z is 1."""
    return wp.vector((x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1])


@wp.func
def along(row: Vec4, d: Vec2):
    """Product of a record's row, without its last scalar, and the ray (x, y, 1)."""
    return row[0] * d[0] + (row[1] * d[1] + row[2])


@wp.func
def hit(a: Vec4, b: Vec4, n: Vec4, m: Real, d: Vec2):
    """(u, v, t) where a ray meets the surfel's plane."""
    inverse = type(m)(1.0) / along(n, d)
    return along(a, d) * inverse, along(b, d) * inverse, m * inverse


@wp.func
def facing_side(n: Vec4, d: Vec2):
    """1 where the normal points to the camera, else -1."""
    one = type(n[0])(1.0)
    return wp.where(n[0] * d[0] + n[1] * d[1] + n[2] > type(n[0])(0.0), -one, one)


@wp.func
def hit_gradients(a: Vec4, b: Vec4, n: Vec4, m: Real, d: Vec2, grad_alpha: Real, grad_depth: Real):
    """Gradients of (a . d, b . d, n . d, m, opacity, gamma 1, gamma 2), given those of a hit's alpha and t."""
    u, v, t = hit(a, b, n, m, d)
    grad_u, grad_v, grad_opacity, grad_gamma_1, grad_gamma_2 = alpha_gradients(u, v, a[3], b[3], n[3], grad_alpha)
    inverse = type(m)(1.0) / along(n, d)
    grad_a = grad_u * inverse
    grad_b = grad_v * inverse
    grad_m = grad_depth * inverse
    grad_n = -(grad_a * u + grad_b * v + grad_m * t)
    return wp.vector(grad_a, grad_b, grad_n, grad_m, grad_opacity, grad_gamma_1, grad_gamma_2)


@wp.func
def record_gradients(grad: Vec7, d: Vec2):
    """Gradients of the rows a, b and n of a record, given those of `hit_gradients`; that of m is grad[3]."""
    return (
        wp.vector(grad[0] * d[0], grad[0] * d[1], grad[0], grad[4]),
        wp.vector(grad[1] * d[0], grad[1] * d[1], grad[1], grad[5]),
        wp.vector(grad[2] * d[0], grad[2] * d[1], grad[2], grad[6]),
    )
