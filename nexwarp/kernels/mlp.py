"""A layer of the MLP (paper Sec. 4.1) for programs without torch: y = W relu(x), by Warp's matrix products of tiles.

Columns are points. Warp differentiates it: the ReLU stands before the product, so that its adjoint finds what it needs
in memory. Rectified are the inputs of all layers but the first.
"""

import functools

import warp as wp

from nexwarp.kernels.types import Real

POINTS = 32  # of a tile: with its gradients, a layer of 64 x 64 in double precision fits a GPU's shared memory
THREADS = 128  # of a block


@wp.func
def relu(x: Real):
    """The larger of x and 0."""
    return wp.max(x, type(x)(0.0))


@functools.cache
def layer_kernel(real: type, outputs: int, inputs: int, rectified: bool) -> wp.Kernel:
    """Make the kernel of a layer with a matrix (outputs, inputs): a block of threads is a tile of points."""

    @wp.kernel(module="unique", module_options={"enable_mathdx_gemm": False})
    def layer(matrix: wp.array2d(dtype=real), x: wp.array2d(dtype=real), y: wp.array2d(dtype=real)):
        first = wp.tid() * POINTS
        weights = wp.tile_load(matrix, shape=(outputs, inputs))
        values = wp.tile_load(x, shape=(inputs, POINTS), offset=(0, first))
        if wp.static(rectified):
            values = wp.tile_map(relu, values)
        product = wp.tile_matmul(weights, values)
        wp.tile_store(y, product, offset=(0, first))

    return layer
