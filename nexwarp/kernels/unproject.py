"""Hit points and ray directions in the world frame, for the texturing pass (paper Sec. 4.2).

A thread is a pixel. Read: depths (P, K) and the world-to-camera matrix. Written: for a hit at z-depth t the point
origin + t * R^T d, and for a pixel the direction R^T d, unit, for the textured colour's SH. Differentiated with respect
to depths and the matrix by Warp's own adjoint.
"""

import functools

import warp as wp

from nexwarp.kernels.surfel import frame_functions
from nexwarp.kernels.types import types


@functools.cache
def unproject_kernel(real: type) -> wp.Kernel:
    """Make the kernel; `viewmat_step` is 0 for one shared viewmat, 1 for a gradient slot a pixel."""
    t = types(real)
    vec3, mat33, mat44 = t.vec3, t.mat33, t.mat44
    f = frame_functions(real)

    @wp.kernel(module="unique")
    def unproject(
        first: wp.int32,
        depths: wp.array2d(dtype=real),
        viewmats: wp.array(dtype=mat44),
        viewmat_step: wp.int32,
        Ks: wp.array(dtype=mat33),
        width: wp.int32,
        # outputs
        positions: wp.array2d(dtype=vec3),
        directions: wp.array(dtype=vec3),
    ):
        p = first + wp.tid()
        viewmat = viewmats[p * viewmat_step]
        intrinsics = f.intrinsics_of(Ks)
        x = (real(float(p % width)) + real(0.5) - intrinsics[2]) / intrinsics[0]
        y = (real(float(p // width)) + real(0.5) - intrinsics[3]) / intrinsics[1]
        ray = f.rotate_back(viewmat, vec3(x, y, real(1.0)))
        origin = -f.rotate_back(viewmat, f.translation(viewmat))
        directions[p] = wp.normalize(ray)
        for h in range(depths.shape[1]):
            positions[p, h] = origin + ray * depths[p, h]

    return unproject
