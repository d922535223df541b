"""SIMD form, for CPUs, of the MLP and the SH colours (paper Sec. 4.1) of points whose features are known.

A thread is a part: `part_size` neighbouring points, which it takes block by block, so that all layers of a block stay
in a core's cache. Read: features, matrices and directions. Written: colours; backward, which repeats the hidden layers,
the gradients of the features, and those of the matrices, a sum for each part. What `ops.mlp` computes layer by layer is
the same to rounding; a test compares the two.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.types import types
from nexwarp.native.simd.mlp import backward_text, forward_text


@functools.cache
def mlp_simd_kernels(real: type, degree: int) -> SimpleNamespace:
    """Make the forward and backward kernels for an SH degree.

    `matrices` holds the values of all matrices (out, in), one after another; `sizes` the number of features, the width
    of each hidden layer, and the number of outputs.
    """
    vec3 = types(real).vec3
    name = "float" if real is wp.float32 else "double"

    @wp.func_native(forward_text(name, degree))
    def forward(
        first: wp.int32,
        last: wp.int32,
        matrices: wp.array(dtype=real),
        sizes: wp.array(dtype=wp.int32),
        layers: wp.int32,
        encoded: wp.array2d(dtype=real),
        directions: wp.array(dtype=vec3),
        hits: wp.int32,
        offset: real,
        clamp: wp.bool,
        colors: wp.array(dtype=vec3),
    ): ...

    @wp.func_native(backward_text(name, degree))
    def backward(
        part: wp.int32,
        first: wp.int32,
        last: wp.int32,
        matrices: wp.array(dtype=real),
        sizes: wp.array(dtype=wp.int32),
        layers: wp.int32,
        encoded: wp.array2d(dtype=real),
        directions: wp.array(dtype=vec3),
        hits: wp.int32,
        clamp: wp.bool,
        colors: wp.array(dtype=vec3),
        grad_colors: wp.array(dtype=vec3),
        grad_encoded: wp.array2d(dtype=real),
        grad_matrices: wp.array2d(dtype=real),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def mlp_simd(
        first: wp.int32,
        part_size: wp.int32,
        matrices: wp.array(dtype=real),
        sizes: wp.array(dtype=wp.int32),
        encoded: wp.array2d(dtype=real),
        directions: wp.array(dtype=vec3),
        hits: wp.int32,
        offset: real,
        clamp: wp.bool,
        # outputs
        colors: wp.array(dtype=vec3),
    ):
        start = (first + wp.tid()) * part_size
        last = wp.min(start + part_size, colors.shape[0])
        layers = sizes.shape[0] - 1
        forward(start, last, matrices, sizes, layers, encoded, directions, hits, offset, clamp, colors)

    @wp.kernel(enable_backward=False, module="unique")
    def mlp_simd_backward(
        first: wp.int32,
        part_size: wp.int32,
        matrices: wp.array(dtype=real),
        sizes: wp.array(dtype=wp.int32),
        encoded: wp.array2d(dtype=real),
        directions: wp.array(dtype=vec3),
        hits: wp.int32,
        clamp: wp.bool,
        colors: wp.array(dtype=vec3),
        grad_colors: wp.array(dtype=vec3),
        # outputs
        grad_encoded: wp.array2d(dtype=real),
        grad_matrices: wp.array2d(dtype=real),
    ):
        part = first + wp.tid()
        start = part * part_size
        last = wp.min(start + part_size, grad_colors.shape[0])
        backward(
            part,
            start,
            last,
            matrices,
            sizes,
            sizes.shape[0] - 1,
            encoded,
            directions,
            hits,
            clamp,
            colors,
            grad_colors,
            grad_encoded,
            grad_matrices,
        )

    return SimpleNamespace(forward=mlp_simd, backward=mlp_simd_backward)
