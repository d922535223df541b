"""Projection: activated surfels to their records in the camera frame, see `surfel` (paper Sec. 4.2).

A thread is a surfel. Read: means, rotations, scales, opacities, gammas, plain colours and the world-to-camera matrix.
Written: records, centres and limits; backward, the gradients of every float input, that of the matrix a surfel, from
those of records. Centres sort and limits cull: both are frozen. The backward kernel writes what `wp.grad` gives for the
product of outputs and their gradients.
"""

from __future__ import annotations

import warp as wp

from nexwarp.kernels.activate import unit
from nexwarp.kernels.shape import exponent_limit
from nexwarp.kernels.surfel import axes, rotate, translation
from nexwarp.kernels.types import Mat44, Vec2, Vec3, Vec4, per_real
from nexwarp.native.vector_loads import load_record, store_record_row

# Nobody sees a surfel as small: its inverse is finite, and so are products with what a scene has else.
SMALLEST_SCALE = wp.constant(wp.float64(1e-20))


@wp.func
def placed(mean: Vec3, quat: Vec4, scale: Vec2, viewmat: Mat44):
    """(a, b, n, c) of the surfel's record, see `surfel`."""
    x, y, z = axes(unit(quat))
    center = rotate(viewmat, mean) + translation(viewmat)
    v1 = rotate(viewmat, x)
    v2 = rotate(viewmat, y)
    n = rotate(viewmat, z)
    # Not vectors over scalars: the adjoint of those has the square of the scale, which may be too small for it.
    one = scale.dtype(1.0)
    a = wp.cross(v2, center) * (one / wp.max(scale[0], scale.dtype(SMALLEST_SCALE)))
    b = wp.cross(center, v1) * (one / wp.max(scale[1], scale.dtype(SMALLEST_SCALE)))
    return a, b, n, center


@wp.func
def placed_dot(mean: Vec3, quat: Vec4, scale: Vec2, viewmat: Mat44, grad_a: Vec4, grad_b: Vec4, grad_n: Vec4, m: Vec4):
    """Sum of outputs * gradients, those of m in m[3]: its gradient is the vector-Jacobian product."""
    a, b, n, center = placed(mean, quat, scale, viewmat)
    return (
        wp.dot(a, wp.vector(grad_a[0], grad_a[1], grad_a[2]))
        + wp.dot(b, wp.vector(grad_b[0], grad_b[1], grad_b[2]))
        + wp.dot(n, wp.vector(grad_n[0], grad_n[1], grad_n[2]))
        + wp.dot(center, n) * m[3]
    )


@per_real()
def project(first: int, surfels: Parameters, viewmats: mat44s, records: vec4_rows, centers: vec3s, limits: reals):
    i = first + wp.tid()
    opacity = surfels.opacities[i]
    gamma = surfels.gammas[i]
    a, b, n, center = placed(surfels.means[i], surfels.quats[i], surfels.scales[i], viewmats[0])
    color = surfels.colors[i]
    store_record_row(records, i, 0, vec4(a[0], a[1], a[2], opacity))
    store_record_row(records, i, 1, vec4(b[0], b[1], b[2], gamma[0]))
    store_record_row(records, i, 2, vec4(n[0], n[1], n[2], gamma[1]))
    store_record_row(records, i, 3, vec4(color[0], color[1], color[2], wp.dot(center, n)))
    centers[i] = center
    limits[i] = exponent_limit(opacity)


@per_real()
def project_backward(
    first: int, surfels: Parameters, viewmats: mat44s, grad_records: vec4_rows, grads: Parameters, grad_viewmats: mat44s
):
    i = first + wp.tid()
    a, b, n, c = load_record(grad_records, i)
    mean, quat, scale, viewmat, _a, _b, _n, _c = wp.grad(placed_dot)(
        surfels.means[i], surfels.quats[i], surfels.scales[i], viewmats[0], a, b, n, c
    )
    grads.means[i] = mean
    grads.quats[i] = quat
    grads.scales[i] = scale
    grads.opacities[i] = a[3]
    grads.gammas[i] = vec2(b[3], n[3])
    grads.colors[i] = vec3(c[0], c[1], c[2])
    if grad_viewmats:
        grad_viewmats[i] = viewmat
