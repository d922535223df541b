"""Hit points and ray directions in the world frame, for the texturing pass (paper Sec. 4.2).

A thread is a pixel. Read: depths (P, K), factors on them (or a null array) and the world-to-camera matrix. Written: for
a hit at z-depth t the point origin + t * R^T d, and for a pixel the direction R^T d, unit, for the textured colour's
SH; backward, the gradients of depths and, a pixel, of the matrix.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from nexwarp.kernels.surfel import intrinsics_of, ray_through, rotate_back, translation
from nexwarp.kernels.types import Mat33, Mat44, Vec3, per_real


@wp.func
def ray_of(p: int, width: int, K: Mat33):
    """Direction through pixel p in the camera frame; its z is 1."""
    half = K.dtype(0.5)
    d = ray_through(K.dtype(float(p % width)) + half, K.dtype(float(p // width)) + half, intrinsics_of(K))
    return wp.vector(d[0], d[1], K.dtype(1.0))


@wp.func
def direction_dot(viewmat: Mat44, ray: Vec3, grad: Vec3):
    return wp.dot(wp.normalize(rotate_back(viewmat, ray)), grad)


@wp.func
def position_dot(viewmat: Mat44, point: Vec3, grad: Vec3):
    """Of a point in the camera frame."""
    return wp.dot(rotate_back(viewmat, point - translation(viewmat)), grad)


@wp.func
def factor(factors: wp.array2d(dtype=Any), p: int, h: int):
    if factors:
        return factors[p, h]
    return factors.dtype(1.0)


@per_real()
def unproject(
    first: int,
    depths: real_rows,
    factors: real_rows,
    viewmats: mat44s,
    Ks: mat33s,
    width: int,
    # outputs
    positions: vec3_rows,
    directions: vec3s,
):
    p = first + wp.tid()
    viewmat = viewmats[0]
    ray = rotate_back(viewmat, ray_of(p, width, Ks[0]))
    origin = -rotate_back(viewmat, translation(viewmat))
    directions[p] = wp.normalize(ray)
    for h in range(depths.shape[1]):
        positions[p, h] = origin + ray * (depths[p, h] * factor(factors, p, h))


@per_real()
def unproject_backward(  # noqa: PLR0913  # a kernel entry point
    first: int,
    depths: real_rows,
    factors: real_rows,
    viewmats: mat44s,
    Ks: mat33s,
    width: int,
    grad_positions: vec3_rows,
    grad_directions: vec3s,
    # outputs
    grad_depths: real_rows,
    grad_viewmats: mat44s,
):
    p = first + wp.tid()
    viewmat = viewmats[0]
    d = ray_of(p, width, Ks[0])
    ray = rotate_back(viewmat, d)
    grad_viewmat = mat44()
    if grad_directions:
        if grad_viewmats:
            grad_viewmat, _r, _g = wp.grad(direction_dot)(viewmat, d, grad_directions[p])
    for h in range(depths.shape[1]):
        grad = vec3()
        if grad_positions:
            grad = grad_positions[p, h]
        if grad_depths:
            grad_depths[p, h] = wp.dot(ray, grad) * factor(factors, p, h)
        if grad_viewmats:
            point = d * (depths[p, h] * factor(factors, p, h))
            of_position, _p, _h = wp.grad(position_dot)(viewmat, point, grad)
            grad_viewmat += of_position
    if grad_viewmats:
        grad_viewmats[p] = grad_viewmat
