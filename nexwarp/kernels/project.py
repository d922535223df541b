"""Projection: activated surfels to their records in the camera frame, see `surfel` (paper Sec. 4.2).

A thread is a surfel. Read: means, rotations, scales, opacities, gammas, plain colours and the world-to-camera matrix.
Written: records, centres and limits; backward, the gradients of every float input, that of the matrix a surfel, from
those of records and centres. Limits only cull and are frozen. The backward kernel writes what `wp.grad` gives for the
product of outputs and their gradients: Warp's own adjoint, which serves tapes, adds by atomics to rows that only one
thread has.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.surfel import frame_functions
from nexwarp.kernels.types import LIMIT_MARGIN, types
from nexwarp.native.vector_loads import record_row_function, store_record_row_function

# Nobody sees a surfel as small: its inverse is finite, and so are products with what a scene has else.
SMALLEST_SCALE = 1e-20


@functools.cache
def project_kernels(real: type) -> SimpleNamespace:
    """Make the projection kernel and its derivative."""
    t = types(real)
    vec2, vec3, vec4, mat44 = t.vec2, t.vec3, t.vec4, t.mat44
    f = frame_functions(real)
    ONE, TWO, TINY, MARGIN = t.ONE, t.TWO, t.TINY, wp.constant(real(LIMIT_MARGIN))
    SMALLEST = wp.constant(real(SMALLEST_SCALE))

    load, store = record_row_function(real), store_record_row_function(real)

    @wp.func
    def placed(
        mean: vec3,
        quat: vec4,
        scale: vec2,
        viewmat: mat44,
    ):
        """(a, b, n, c) of the surfel's record, see `surfel`."""
        axes = f.rotation(quat)
        center = f.rotate(viewmat, mean) + f.translation(viewmat)
        v1 = f.rotate(viewmat, vec3(axes[0, 0], axes[1, 0], axes[2, 0]))
        v2 = f.rotate(viewmat, vec3(axes[0, 1], axes[1, 1], axes[2, 1]))
        n = f.rotate(viewmat, vec3(axes[0, 2], axes[1, 2], axes[2, 2]))
        # Not vectors over scalars: the adjoint of those has the square of the scale, which may be too small for it.
        a = wp.cross(v2, center) * (ONE / wp.max(scale[0], SMALLEST))
        b = wp.cross(center, v1) * (ONE / wp.max(scale[1], SMALLEST))
        return a, b, n, center

    @wp.func
    def placed_dot(
        mean: vec3,
        quat: vec4,
        scale: vec2,
        viewmat: mat44,
        grad_a: vec3,
        grad_b: vec3,
        grad_n: vec3,
        grad_m: real,
        grad_center: vec3,
    ):
        """Sum of outputs * gradients: its gradient is the vector-Jacobian product."""
        a, b, n, center = placed(mean, quat, scale, viewmat)
        return (
            wp.dot(a, grad_a)
            + wp.dot(b, grad_b)
            + wp.dot(n, grad_n)
            + wp.dot(center, n) * grad_m
            + wp.dot(center, grad_center)
        )

    @wp.kernel(module="unique")
    def project(
        first: wp.int32,
        means: wp.array(dtype=vec3),
        quats: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec2),
        opacities: wp.array(dtype=real),
        gammas: wp.array(dtype=vec2),
        colors: wp.array(dtype=vec3),
        viewmats: wp.array(dtype=mat44),
        # outputs
        records: wp.array2d(dtype=vec4),
        centers: wp.array(dtype=vec3),
        limits: wp.array(dtype=real),
    ):
        i = first + wp.tid()
        a, b, n, center = placed(means[i], quats[i], scales[i], viewmats[0])
        color = colors[i]
        store(records, i, 0, vec4(a[0], a[1], a[2], opacities[i]))
        store(records, i, 1, vec4(b[0], b[1], b[2], gammas[i][0]))
        store(records, i, 2, vec4(n[0], n[1], n[2], gammas[i][1]))
        store(records, i, 3, vec4(color[0], color[1], color[2], wp.dot(center, n)))
        centers[i] = center
        limits[i] = TWO * wp.log(real(255.0) * wp.max(opacities[i], TINY)) + MARGIN

    @wp.kernel(enable_backward=False, module="unique")
    def project_backward(
        first: wp.int32,
        means: wp.array(dtype=vec3),
        quats: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec2),
        viewmats: wp.array(dtype=mat44),
        grad_records: wp.array2d(dtype=vec4),
        grad_centers: wp.array(dtype=vec3),
        # outputs
        grad_means: wp.array(dtype=vec3),
        grad_quats: wp.array(dtype=vec4),
        grad_scales: wp.array(dtype=vec2),
        grad_opacities: wp.array(dtype=real),
        grad_gammas: wp.array(dtype=vec2),
        grad_colors: wp.array(dtype=vec3),
        grad_viewmats: wp.array(dtype=mat44),
    ):
        i = first + wp.tid()
        r0 = load(grad_records, i, 0)
        r1 = load(grad_records, i, 1)
        r2 = load(grad_records, i, 2)
        r3 = load(grad_records, i, 3)
        grad_center = vec3()
        if grad_centers:
            grad_center = grad_centers[i]
        mean, quat, scale, viewmat, _a, _b, _n, _m, _c = wp.grad(placed_dot)(
            means[i],
            quats[i],
            scales[i],
            viewmats[0],
            vec3(r0[0], r0[1], r0[2]),
            vec3(r1[0], r1[1], r1[2]),
            vec3(r2[0], r2[1], r2[2]),
            r3[3],
            grad_center,
        )
        grad_means[i] = mean
        grad_quats[i] = quat
        grad_scales[i] = scale
        grad_opacities[i] = r0[3]
        grad_gammas[i] = vec2(r1[3], r2[3])
        grad_colors[i] = vec3(r3[0], r3[1], r3[2])
        if grad_viewmats:
            grad_viewmats[i] = viewmat

    return SimpleNamespace(forward=project, backward=project_backward)
