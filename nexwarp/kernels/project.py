"""Projection: activated surfels to their records in the camera frame, see `surfel` (paper Sec. 4.2).

A thread is a surfel. Read: means, rotations, scales, opacities, gammas, plain colours and the world-to-camera matrix.
Written: records, centres and limits. Smooth and loop-free, so that Warp's own adjoint differentiates records and
centres with respect to every float input; limits only cull and are frozen.
"""

import functools

import warp as wp

from nexwarp.kernels.surfel import frame_functions
from nexwarp.kernels.types import LIMIT_MARGIN, types

# Nobody sees a surfel as small: its inverse is finite, and so are products with what a scene has else.
SMALLEST_SCALE = 1e-20


@functools.cache
def project_kernel(real: type) -> wp.Kernel:
    """Make the projection kernel; `viewmat_step` is 0 for one shared viewmat, 1 for a gradient slot a surfel."""
    t = types(real)
    vec2, vec3, vec4, mat44 = t.vec2, t.vec3, t.vec4, t.mat44
    f = frame_functions(real)
    ONE, TWO, TINY, MARGIN = t.ONE, t.TWO, t.TINY, wp.constant(real(LIMIT_MARGIN))
    SMALLEST = wp.constant(real(SMALLEST_SCALE))

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
        viewmat_step: wp.int32,
        # outputs
        records: wp.array2d(dtype=vec4),
        centers: wp.array(dtype=vec3),
        limits: wp.array(dtype=real),
    ):
        i = first + wp.tid()
        viewmat = viewmats[i * viewmat_step]
        axes = f.rotation(quats[i])
        center = f.rotate(viewmat, means[i]) + f.translation(viewmat)
        v1 = f.rotate(viewmat, vec3(axes[0, 0], axes[1, 0], axes[2, 0]))
        v2 = f.rotate(viewmat, vec3(axes[0, 1], axes[1, 1], axes[2, 1]))
        n = f.rotate(viewmat, vec3(axes[0, 2], axes[1, 2], axes[2, 2]))
        # Not vectors over scalars: the adjoint of those has the square of the scale, which may be too small for it.
        a = wp.cross(v2, center) * (ONE / wp.max(scales[i][0], SMALLEST))
        b = wp.cross(center, v1) * (ONE / wp.max(scales[i][1], SMALLEST))
        records[i, 0] = vec4(a[0], a[1], a[2], opacities[i])
        records[i, 1] = vec4(b[0], b[1], b[2], gammas[i][0])
        records[i, 2] = vec4(n[0], n[1], n[2], gammas[i][1])
        color = colors[i]
        records[i, 3] = vec4(color[0], color[1], color[2], wp.dot(center, n))
        centers[i] = center
        limits[i] = TWO * wp.log(real(255.0) * wp.max(opacities[i], TINY)) + MARGIN

    return project
