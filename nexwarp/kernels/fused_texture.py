"""Texturing on tensor cores: lookup in the hash grid (paper Eq. 2), MLP and SH in one kernel each way; for CUDA alone.

For L * F = 32 features of F = 2 or 4, two hidden layers of 64, and half-precision tables, matrices and activations,
summed in float32. A warp takes 16 neighbouring pixels, a tile, and one hit of each at a time: 16 points are the rows
of every product. Tiles are 8 x 2 pixels of an image, or 16 x 1 where the height is 1. `unit` = tile * K + hit.

Columns of the first matrix are permuted so that a lane looks up whole levels of its two points and finds its features
in its own fragments; rows of the last one, so that a lane has all channels of the SH coefficients q, q + 4, q + 8, ...
of its two points. `logical_feature` and `logical_output` name what stands where. Lower SH degrees have zeros in the
last matrix.

    fused_forward    writes colours and, for the backward pass, the features as fragments (64 bytes a point)
    fused_backward   repeats the hidden layers from the features. Written: gradients of the features (units, L, 16, F),
                     which may overwrite the features, and of the matrices, in permuted order, a slot for each block.
                     Four warps of a block share the sums of matrix gradients: each holds a fourth of them and reads
                     all four's activations
    fused_scatter    gradients of the grid, by atomics, and of positions and depths; a warp takes four units
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.native import snippet
from nexwarp.native.fused_texture import WARPS, backward_text, forward_text

FORWARD_THREADS, BACKWARD_THREADS = 256, 32 * WARPS  # of a block
# Blocks that a multiprocessor holds at least, for which the compiler limits registers.
FORWARD_BLOCKS, BACKWARD_BLOCKS = 3, 3

Word, Real, Vec3 = wp.array(dtype=wp.int32), wp.array(dtype=wp.float32), wp.array(dtype=wp.vec3)


@wp.struct
class Fused:
    """What the three kernels read and write; n points, P directions, n = P * hits."""

    # The image's points: width * height = P, K hits each, tiles of (1 << shift) x (16 >> shift) pixels.
    width: wp.int32
    height: wp.int32
    hits: wp.int32
    shift: wp.int32
    positions: Vec3
    depths: Real
    directions: Vec3
    # The field: the grid (L T F), the mask of a slot T - 1, the packed matrices.
    table: wp.array(dtype=wp.float16)
    mask: wp.uint32
    resolutions: Real
    focal: Real
    packed: Word
    offset: wp.float32
    clamp: wp.int32
    # Written by the forward pass; `encoded` is empty without a backward pass.
    encoded: Word
    colors: Vec3
    # The backward pass: gradients in half precision are multiplied by `scale`.
    scale: Real
    unscale: Real
    grad_colors: Vec3
    grad_encoded: Word
    grad_matrices: Real
    first_level: wp.int32
    end_level: wp.int32
    grad_table: Real
    grad_points: wp.array(dtype=wp.vec4)


# The fields of `Fused` by their names: copies, since references cost registers.
FIELDS = "".join(f"    const auto {name} = fused.{name};\n" for name in Fused.vars)


@wp.func_native("""
    union { int bits; float value; } power;
    power.bits = (exponent + 127) << 23;
    return power.value;
""")
def power_of_two(exponent: wp.int32) -> wp.float32:
    """Return 2^exponent, exactly."""
    ...


@wp.kernel(enable_backward=False, module="unique")
def half_scale(first: int, largest: Real, target: wp.float32, scale: Real, unscale: Real):
    """Power of two that brings `largest` near `target`, and its inverse."""
    exponent = wp.clamp(int(wp.floor(wp.log2(target / wp.max(largest[0], 1.0e-30)))), -24, 60)
    scale[first + wp.tid()] = power_of_two(exponent)
    unscale[first + wp.tid()] = power_of_two(-exponent)


@wp.kernel(enable_backward=False, module="unique")
def pack_matrices(
    first: int, matrix1: Real, matrix2: Real, matrix3: Real, sources: Word, packed: wp.array(dtype=wp.float16)
):
    """Gather the matrices' values, one matrix after another; what lies after the last one is 0."""
    i = first + wp.tid()
    source = sources[i]
    value = float(0.0)
    if source < matrix1.shape[0]:
        value = matrix1[source]
    else:
        source -= matrix1.shape[0]
        if source < matrix2.shape[0]:
            value = matrix2[source]
        else:
            source -= matrix2.shape[0]
            if source < matrix3.shape[0]:
                value = matrix3[source]
    packed[i] = wp.float16(value)


@functools.cache
def fused_kernels(features: int) -> SimpleNamespace:
    """Make the kernels of the forward pass and of the backward pass down to the features, for F = 2 or 4.

    Both take threads = 32 times a number of warps, which share out the tiles.
    """

    @wp.func_native(snippet(FIELDS + forward_text(features)))
    def forward(thread: wp.int32, threads: wp.int32, fused: Fused): ...

    @wp.func_native(snippet(FIELDS + backward_text(features)))
    def backward(thread: wp.int32, threads: wp.int32, fused: Fused, clamped: Vec3): ...

    @wp.kernel(
        enable_backward=False, grid_stride=False, module="unique", launch_bounds=(FORWARD_THREADS, FORWARD_BLOCKS)
    )
    def fused_forward(first: int, threads: int, fused: Fused):
        forward(first + wp.tid(), threads, fused)

    @wp.kernel(
        enable_backward=False, grid_stride=False, module="unique", launch_bounds=(BACKWARD_THREADS, BACKWARD_BLOCKS)
    )
    def fused_backward(first: int, threads: int, fused: Fused, clamped: Vec3):
        # Colours that were clamped, else empty; apart from the struct, where it would cost registers.
        backward(first + wp.tid(), threads, fused, clamped)

    return SimpleNamespace(forward=fused_forward, backward=fused_backward)
