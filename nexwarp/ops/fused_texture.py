"""Texturing in one kernel each way, for the shapes that `fused_texture` takes; see `nexwarp.ops.texture`."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch.autograd.function import once_differentiable

from nexwarp.kernels.fused_scatter import SCATTER_THREADS, fused_scatter_kernel
from nexwarp.kernels.fused_texture import (
    BACKWARD_BLOCKS,
    BACKWARD_THREADS,
    FORWARD_BLOCKS,
    FORWARD_THREADS,
    fused_kernels,
    half_scale,
    order_gradients,
    pack_matrices,
)
from nexwarp.kernels.tiles import LARGEST_INT
from nexwarp.native.fused_texture import (
    FEATURES,
    GRADIENTS,
    MATRICES,
    OUTPUTS,
    WARPS,
    WIDTH,
    logical_feature,
    logical_output,
)
from nexwarp.ops._interop import Context, array, device_of, graph_is_kept, launch
from nexwarp.ops.half_gradients import HALF_GRADIENT

GROUP_BYTES = 2**24  # of sums that a launch of the backward lookup adds to: a third of an H100's L2 cache


class Shape(NamedTuple):
    """An image's points, as the kernels order them.

    Attributes:
        width, height: in pixels; without an image, the number of directions and 1.
        hits: K.
    """

    width: int
    height: int
    hits: int

    @property
    def shift(self) -> int:
        """Tiles are (1 << shift) pixels wide and (16 >> shift) high."""
        return 3 if self.height > 1 else 4

    @property
    def units(self) -> int:
        """Number of tiles times hits."""
        wide, high = 1 << self.shift, 16 >> self.shift
        return -(-self.width // wide) * -(-self.height // high) * self.hits


def takes_shape(levels: int, features: int, width: int, hidden_layers: int) -> bool:
    """Whether the fused kernels take textures of a shape: L * F = 32, F 2 or 4, two hidden layers of 64."""
    return levels * features == FEATURES and features in (2, 4) and width == WIDTH and hidden_layers == 2


def fits(grid: torch.Tensor, weights: Sequence[torch.Tensor], points: int) -> bool:
    """Whether the fused kernels take a grid (L, T, F) and matrices, of SH degree 0 to 3, for so many points."""
    levels, size, features = grid.shape
    shapes = [tuple(matrix.shape) for matrix in weights]
    hidden: list[tuple[int, ...]] = [(WIDTH, FEATURES), (WIDTH, WIDTH)]
    return (
        takes_shape(levels, features, len(weights[0]), len(weights) - 1)
        and any(shapes == [*hidden, (3 * (degree + 1) ** 2, WIDTH)] for degree in range(4))
        and levels * size * features <= LARGEST_INT
        and points <= LARGEST_INT // 64
    )


def supported(device: torch.device) -> bool:
    """Whether a GPU has the tensor cores' instructions that the fused kernels use."""
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)


def usable(
    positions: torch.Tensor, directions: torch.Tensor, grid: torch.Tensor, weights: Sequence[torch.Tensor]
) -> bool:
    """Whether the fused kernels compute these colours; see `nexwarp.ops.texture`."""
    return (
        supported(positions.device)
        and positions.dtype == torch.float32
        and not (torch.is_grad_enabled() and directions.requires_grad)
        and not torch.are_deterministic_algorithms_enabled()
        and len(positions) > 0
        and fits(grid, weights, len(positions))
    )


class Inputs(NamedTuple):
    """What the kernels read: see `nexwarp.ops.texture`, whose arguments these are.

    Attributes:
        positions, depths, directions, resolutions, focal: float32, contiguous.
        table: (L, T, F) the grid in half precision.
        weights: the matrices, float32.
        shape: of the image.
    """

    positions: torch.Tensor
    depths: torch.Tensor
    directions: torch.Tensor
    table: torch.Tensor
    weights: Sequence[torch.Tensor]
    resolutions: torch.Tensor
    focal: torch.Tensor
    shape: Shape


class Kept(NamedTuple):
    """What the backward pass needs of the forward pass.

    Attributes:
        encoded: the features as fragments, 64 bytes a point; empty if there will be no backward pass.
        packed: the matrices in half precision, in the order in which the kernels' lanes load them.
        colors: (n, 3) the result if it was clamped, else empty.
    """

    encoded: torch.Tensor
    packed: torch.Tensor
    colors: torch.Tensor


def colors(inputs: Inputs, grid: torch.Tensor, offset: float, clamp: bool, *, keep: bool) -> torch.Tensor:
    """Return colours (n, 3), differentiable with respect to positions, depths, grid and weights.

    Args:
        inputs: what the kernels read.
        grid: (L, T, F) float32, of which `inputs.table` is a copy.
        offset: colour of coefficients of 0.
        clamp: limit colours to >= 0.
        keep: whether there will be a backward pass.
    """
    positions, depths, directions, table, weights, resolutions, focal, shape = inputs
    fixed = (directions, table, resolutions, focal, shape, offset, clamp, keep)
    return _Colors.apply(positions, depths, grid, *fixed, *weights)


class _Context(Context):
    shape: Shape


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: _Context,
        positions: torch.Tensor,
        depths: torch.Tensor,
        grid: torch.Tensor,
        directions: torch.Tensor,
        table: torch.Tensor,
        resolutions: torch.Tensor,
        focal: torch.Tensor,
        shape: Shape,
        offset: float,
        clamp: bool,
        keep: bool,
        *weights: torch.Tensor,
    ) -> torch.Tensor:
        inputs = Inputs(positions, depths, directions, table, weights, resolutions, focal, shape)
        result, kept = forward(inputs, offset, clamp, keep)
        ctx.shape = shape
        if keep:
            ctx.save_for_backward(positions, depths, directions, table, resolutions, focal, *kept, *weights)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: _Context, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        positions, depths, directions, table, resolutions, focal, encoded, packed, result, *weights = ctx.saved_tensors
        need_positions, need_depths, need_grid, *_ = ctx.needs_input_grad
        inputs = Inputs(positions, depths, directions, table, weights, resolutions, focal, ctx.shape)
        kept, need_points = Kept(encoded, packed, result), need_positions or need_depths
        again = graph_is_kept()
        grad_grid, grad_points, grad_matrices = backward(grad.contiguous(), inputs, kept, need_points, again)
        return (
            grad_points[:, :3] if need_positions and grad_points is not None else None,
            grad_points[:, 3] if need_depths and grad_points is not None else None,
            grad_grid if need_grid else None,
            *(None,) * 8,
            *grad_matrices,
        )


def forward(inputs: Inputs, offset: float, clamp: bool, keep: bool) -> tuple[torch.Tensor, Kept]:
    """Return the colours (n, 3), and what `backward` needs, without the features unless `keep`.

    Args:
        inputs: what the kernels read.
        offset: colour of coefficients of 0.
        clamp: limit colours to >= 0.
        keep: whether there will be a backward pass.
    """
    positions, depths, directions, table, weights, resolutions, focal, shape = inputs
    packed = _pack(weights, table.shape[2])
    encoded = torch.empty(shape.units * 256 if keep else 0, dtype=torch.int32, device=table.device)
    result = torch.empty_like(positions)
    warps = _warps(positions, shape.units // shape.hits, FORWARD_BLOCKS * FORWARD_THREADS // 32)
    _launch(
        fused_kernels(table.shape[2]).forward,
        positions,
        warps,
        [
            array(table.view(-1), wp.float16),
            wp.uint32(table.shape[1] - 1),
            array(positions, wp.vec3),
            array(depths, wp.float32),
            array(directions, wp.vec3),
            array(resolutions, wp.float32),
            array(focal, wp.float32),
            array(packed, wp.int32),
            *shape,
            shape.shift,
            offset,
            int(clamp),
        ],
        [array(encoded, wp.int32), array(result, wp.vec3)],
        FORWARD_THREADS,
    )
    return result, Kept(encoded, packed, result if clamp else result.new_empty(0, 3))


def backward(
    grad_colors: torch.Tensor, inputs: Inputs, kept: Kept, need_points: bool, again: bool
) -> tuple[torch.Tensor, torch.Tensor | None, list[torch.Tensor]]:
    """Return the gradients of the grid (L, T, F), of positions and depths (n, 4) if needed, and of the matrices.

    Args:
        grad_colors: (n, 3).
        inputs: of `forward`.
        kept: of `forward`.
        need_points: whether positions or depths need a gradient.
        again: whether `kept` will be needed again; otherwise the features are overwritten by their gradients.
    """
    scale, unscale = _scales(grad_colors)
    grad_encoded = torch.empty_like(kept.encoded) if again else kept.encoded
    sums = _mlp_backward(grad_colors, scale, inputs, kept, grad_encoded)
    order = _order(inputs.table.shape[2], len(inputs.weights[-1]), grad_colors.device)
    flat = grad_colors.new_empty(len(order))
    given = [array(sums, wp.float32), array(order, wp.int32), array(unscale, wp.float32)]
    launch(grad_colors, order_gradients, len(order), given, [array(flat, wp.float32)])
    ends = np.cumsum([0, *(matrix.numel() for matrix in inputs.weights)]).tolist()
    grad_matrices = [flat[a:b].view_as(matrix) for a, b, matrix in zip(ends, ends[1:], inputs.weights, strict=False)]
    return *_scatter(grad_encoded, unscale, inputs, need_points), grad_matrices


def _mlp_backward(
    grad_colors: torch.Tensor, scale: torch.Tensor, inputs: Inputs, kept: Kept, grad_encoded: torch.Tensor
) -> torch.Tensor:
    """Write the gradients of the features, and return those of the matrices in permuted order, both scaled."""
    shape, features = inputs.shape, inputs.table.shape[2]
    warps = _warps(grad_colors, shape.units, BACKWARD_BLOCKS * WARPS)
    sums = grad_colors.new_empty(warps // (WARPS if grad_colors.is_cuda else 1), sum(GRADIENTS))
    _launch(
        fused_kernels(features).backward,
        grad_colors,
        warps,
        [
            array(kept.encoded, wp.int32),
            array(inputs.directions, wp.vec3),
            array(kept.packed, wp.int32),
            *shape,
            shape.shift,
            array(scale, wp.float32),
            array(kept.colors, wp.vec3),
            array(grad_colors, wp.vec3),
        ],
        [array(grad_encoded, wp.int32), array(sums.view(-1), wp.float32)],
        BACKWARD_THREADS,
    )
    return sums.sum(0)


def _scatter(
    grad_encoded: torch.Tensor, unscale: torch.Tensor, inputs: Inputs, need_points: bool
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return the gradients of the grid (L, T, F), and of positions and depths (n, 4) if needed."""
    table, positions, shape = inputs.table, inputs.positions, inputs.shape
    grad_grid = torch.zeros_like(table, dtype=torch.float32)
    count = shape.units * (32 if positions.is_cuda else 1)
    grad_points = positions.new_empty(len(positions) * need_points, 4)
    levels, size, features = table.shape
    kernel = fused_scatter_kernel(features)
    given = [
        array(table.view(-1), wp.float16),
        array(positions, wp.vec3),
        array(inputs.depths, wp.float32),
        array(inputs.resolutions, wp.float32),
        array(inputs.focal, wp.float32),
        wp.uint32(size - 1),
        array(grad_encoded.view(torch.float16), wp.float16),
        array(unscale, wp.float32),
        *shape,
        shape.shift,
    ]
    outputs = [array(grad_grid.view(-1), wp.float32), array(grad_points, wp.vec4)]
    for group in level_groups(levels, size * features * 4):
        # In one thread on a CPU.
        launch(positions, kernel, count, [*given, *group], outputs, block_dim=SCATTER_THREADS, smallest=count)
    return grad_grid, grad_points if need_points else None


def level_groups(levels: int, level_bytes: int) -> list[tuple[int, int]]:
    """Return the ranges of levels (first, end) that one launch of the backward lookup takes.

    Launches of few levels keep the sums in the L2 cache, where atomics are much faster than in memory. The coarser
    half of the levels goes together, as little of their tables is used.

    Args:
        levels: L.
        level_bytes: of the sums of one level.
    """
    if levels * level_bytes <= 2 * GROUP_BYTES:
        return [(0, levels)]
    half, each = levels // 2, max(GROUP_BYTES // level_bytes, 1)
    starts = [0, *range(max(half, 1), levels, each)]
    return list(zip(starts, [*starts[1:], levels], strict=True))


def _launch(
    kernel: wp.Kernel, like: torch.Tensor, warps: int, inputs: list[object], outputs: list[object], threads: int
) -> None:
    """Launch a kernel whose second argument is its number of threads, on CUDA 32 for each warp."""
    count = warps * 32 if device_of(like).is_cuda else warps
    launch(like, kernel, count, [count, *inputs], outputs, block_dim=threads, smallest=count)


def _warps(like: torch.Tensor, most: int, each: int) -> int:
    """Return how many warps share out the work: `each` a multiprocessor on CUDA."""
    if not like.is_cuda:
        return min(most, 2)
    return torch.cuda.get_device_properties(like.device).multi_processor_count * each


def _pack(weights: Sequence[torch.Tensor], features: int) -> torch.Tensor:
    """Return the matrices as words of two halves, in the order in which the kernels' lanes load them."""
    sources = _sources(features, len(weights[-1]), weights[0].device)
    packed = torch.empty(len(sources), dtype=torch.float16, device=sources.device)
    matrices = [array(matrix.reshape(-1), wp.float32) for matrix in weights]
    given = [*matrices, array(sources, wp.int32)]
    launch(packed, pack_matrices, len(packed), given, [array(packed, wp.float16)])
    return packed.view(torch.int32)


def _scales(grad: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the factor (1,) that gradients in half precision are multiplied by, and its inverse."""
    largest = torch.linalg.vector_norm(grad, float("inf")).view(1)
    scale, unscale = torch.empty_like(largest), torch.empty_like(largest)
    given = [array(largest, wp.float32), HALF_GRADIENT]
    launch(grad, half_scale, 1, given, [array(x, wp.float32) for x in (scale, unscale)])
    return scale, unscale


@functools.cache
def _sources(features: int, outputs: int, device: torch.device) -> torch.Tensor:
    """Return where each packed half is among the matrices' values, one after another; a zero stands after them."""
    w1 = np.arange(WIDTH * FEATURES).reshape(WIDTH, FEATURES)[
        :, [logical_feature(c, features) for c in range(FEATURES)]
    ]
    w2 = WIDTH * FEATURES + np.arange(WIDTH**2).reshape(WIDTH, WIDTH)
    start = WIDTH * (FEATURES + WIDTH)
    zero = start + outputs * WIDTH
    w3 = np.minimum(start + np.arange(OUTPUTS * WIDTH), zero).reshape(OUTPUTS, WIDTH)
    w3 = w3[[logical_output(c) for c in range(OUTPUTS)]]
    # As matrices of the products: (inner dimension, columns).
    matrices = {"W1": w1.T, "W2": w2.T, "W3": w3.T, "W3T": w3, "W2T": w2, "W1T": w1}
    parts = []
    for name, (k_tiles, n_tiles) in MATRICES.items():
        pairs = (k_tiles + 1) // 2
        matrix = np.full((pairs * 32, n_tiles * 8), zero)
        matrix[: k_tiles * 16] = matrices[name]
        # k = pair * 32 + tile * 16 + part * 8 + q * 2 + half; column = n * 8 + g.
        split = matrix.reshape(pairs, 2, 2, 4, 2, n_tiles, 8)
        parts.append(split.transpose(5, 0, 6, 3, 1, 2, 4).reshape(-1))  # n, pair, g, q, tile, part, half
    return torch.from_numpy(np.concatenate(parts).astype(np.int32)).to(device)


@functools.cache
def _order(features: int, outputs: int, device: torch.device) -> torch.Tensor:
    """Return where each value of the matrices' gradients is among the sums of the backward kernel."""
    columns = np.argsort([logical_feature(c, features) for c in range(FEATURES)])
    w1 = np.arange(WIDTH * FEATURES).reshape(WIDTH, FEATURES)[:, columns]
    w2 = WIDTH * FEATURES + np.arange(WIDTH**2)
    rows = np.argsort([logical_output(c) for c in range(OUTPUTS)])[:outputs]
    w3 = WIDTH * (FEATURES + WIDTH) + rows[:, None] * WIDTH + np.arange(WIDTH)
    return torch.from_numpy(np.concatenate([x.reshape(-1) for x in (w1, w2, w3)]).astype(np.int32)).to(device)
