"""Texturing in one kernel each way, for the shapes that `fits` names; see `nexwarp.ops.texture`."""

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
from nexwarp.ops._interop import Argument, Context, array, graph_is_kept, launch
from nexwarp.ops.neural_field import HALF_GRADIENT, Field, Points, Rays

GROUP_BYTES = 2**24  # of sums that a launch of the backward lookup adds to: a third of an H100's L2 cache


class Shape(NamedTuple):
    """An image's points, as the kernels order them.

    Attributes:
        width, height: in pixels; without an image, the number of directions and 1.
        hits: K.
        shift: tiles are (1 << shift) pixels wide and (16 >> shift) high.
    """

    width: int
    height: int
    hits: int
    shift: int

    @staticmethod
    def of(points: Points, rays: Rays) -> "Shape":
        """Return the shape of points along rays."""
        height, width = rays.image or (1, len(rays.directions))
        return Shape(width, height, len(points) // max(len(rays.directions), 1), 3 if height > 1 else 4)

    @property
    def units(self) -> int:
        """Number of tiles times hits."""
        wide, high = 1 << self.shift, 16 >> self.shift
        return -(-self.width // wide) * -(-self.height // high) * self.hits


def fits(grid: torch.Tensor, weights: Sequence[torch.Tensor], points: int) -> bool:
    """Whether the fused kernels take a grid (L, T, F) and matrices, of SH degree 0 to 3, for so many points."""
    levels, size, features = grid.shape
    shapes = [tuple(matrix.shape) for matrix in weights]
    hidden: list[tuple[int, ...]] = [(WIDTH, FEATURES), (WIDTH, WIDTH)]
    return (
        levels * features == FEATURES
        and features in (2, 4)
        and any(shapes == [*hidden, (3 * (degree + 1) ** 2, WIDTH)] for degree in range(4))
        and levels * size * features <= LARGEST_INT
        and points <= LARGEST_INT // 64
    )


def usable(points: Points, field: Field, rays: Rays) -> bool:
    """Whether the fused kernels compute these colours; see `nexwarp.ops.texture`."""
    positions = points.positions
    return (
        field.half
        and positions.is_cuda
        and torch.cuda.get_device_capability(positions.device) >= (8, 0)  # tensor cores' instructions
        and positions.dtype == torch.float32
        and not (torch.is_grad_enabled() and rays.directions.requires_grad)
        and not torch.are_deterministic_algorithms_enabled()
        and len(positions) > 0
        and fits(field.grid, field.weights, len(positions))
    )


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


def colors(points: Points, field: Field, rays: Rays, *, keep: bool) -> torch.Tensor:
    """Return colours (n, 3), differentiable with respect to positions, depths, grid and weights.

    Args:
        points: float32, contiguous.
        field: with its `table`.
        rays: contiguous.
        keep: whether there will be a backward pass.
    """
    return _Colors.apply(points, field, rays, keep, points.positions, points.depths, field.grid, *field.weights)


class _Context(Context):
    rays: Rays


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: _Context, points: Points, field: Field, rays: Rays, keep: bool, *tensors: torch.Tensor
    ) -> torch.Tensor:
        result, kept = forward(points, field, rays, keep)
        if keep:
            assert field.table is not None
            ctx.rays = Rays(rays.directions[:0], rays.offset, rays.clamp, rays.image)
            fixed = (rays.directions, points.focal, field.table, field.resolutions)
            ctx.save_for_backward(points.positions, points.depths, *fixed, *kept, *field.weights)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: _Context, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        positions, depths, directions, focal, table, resolutions, encoded, packed, result, *weights = ctx.saved_tensors
        need_positions, need_depths, need_grid = ctx.needs_input_grad[4:7]
        points, field = Points(positions, depths, focal), Field(table, weights, resolutions, True, table)
        rays = Rays(directions, ctx.rays.offset, ctx.rays.clamp, ctx.rays.image)
        backward_pass = Backward(points, field, rays, Kept(encoded, packed, result), again=graph_is_kept())
        grad_grid, grad_points, grad_matrices = backward_pass(grad.contiguous(), need_positions or need_depths)
        return (
            *(None,) * 4,
            grad_points[:, :3] if need_positions else None,
            grad_points[:, 3] if need_depths else None,
            grad_grid if need_grid else None,
            *grad_matrices,
        )


def forward(points: Points, field: Field, rays: Rays, keep: bool) -> tuple[torch.Tensor, Kept]:
    """Return the colours (n, 3), and what `Backward` needs, without the features unless `keep`."""
    table, shape = field.stored(), Shape.of(points, rays)
    packed = _pack(field.weights, table.shape[2])
    encoded = torch.empty(shape.units * 256 if keep else 0, dtype=torch.int32, device=table.device)
    result = torch.empty_like(points.positions)
    warps = _warps(points.positions, shape.units // shape.hits, FORWARD_BLOCKS * FORWARD_THREADS // 32)
    inputs = [
        array(table.view(-1), wp.float16),
        wp.uint32(table.shape[1] - 1),
        array(points.positions, wp.vec3),
        array(points.depths, wp.float32),
        array(rays.directions, wp.vec3),
        array(field.resolutions, wp.float32),
        array(points.focal, wp.float32),
        array(packed, wp.int32),
        *shape,
        rays.offset,
        int(rays.clamp),
    ]
    outputs = [array(encoded, wp.int32), array(result, wp.vec3)]
    _launch(fused_kernels(table.shape[2]).forward, points.positions, warps, inputs, outputs, FORWARD_THREADS)
    return result, Kept(encoded, packed, result if rays.clamp else result.new_empty(0, 3))


class Backward(NamedTuple):
    """The backward pass.

    Attributes:
        points, field, rays: of `forward`.
        kept: of `forward`.
        again: whether `kept` will be needed again; otherwise the features are overwritten by their gradients.
    """

    points: Points
    field: Field
    rays: Rays
    kept: Kept
    again: bool

    def __call__(
        self, grad_colors: torch.Tensor, need_points: bool
    ) -> tuple[torch.Tensor, torch.Tensor, list[torch.Tensor]]:
        """Return the gradients of the grid (L, T, F), of positions and depths (n, 4) if needed, and of the matrices."""
        scale, unscale = _scales(grad_colors)
        grad_encoded = torch.empty_like(self.kept.encoded) if self.again else self.kept.encoded
        sums = self._mlp(grad_colors, scale, grad_encoded)
        weights = self.field.weights
        order = _order(self.field.grid.shape[2], len(weights[-1]), grad_colors.device)
        flat = grad_colors.new_empty(len(order))
        inputs = [array(sums, wp.float32), array(order, wp.int32), array(unscale, wp.float32)]
        launch(grad_colors, order_gradients, len(order), inputs, [array(flat, wp.float32)])
        parts = flat.split([matrix.numel() for matrix in weights])
        grad_matrices = [part.view_as(matrix) for part, matrix in zip(parts, weights, strict=True)]
        return *self._scatter(grad_encoded, unscale, need_points), grad_matrices

    def _mlp(self, grad_colors: torch.Tensor, scale: torch.Tensor, grad_encoded: torch.Tensor) -> torch.Tensor:
        """Write the gradients of the features, and return those of the matrices in permuted order, both scaled."""
        shape = Shape.of(self.points, self.rays)
        warps = _warps(grad_colors, shape.units, BACKWARD_BLOCKS * WARPS)
        sums = grad_colors.new_empty(warps // (WARPS if grad_colors.is_cuda else 1), sum(GRADIENTS))
        inputs = [
            array(self.kept.encoded, wp.int32),
            array(self.rays.directions, wp.vec3),
            array(self.kept.packed, wp.int32),
            *shape,
            array(scale, wp.float32),
            array(self.kept.colors, wp.vec3),
            array(grad_colors, wp.vec3),
        ]
        outputs = [array(grad_encoded, wp.int32), array(sums.view(-1), wp.float32)]
        kernel = fused_kernels(self.field.grid.shape[2]).backward
        _launch(kernel, grad_colors, warps, inputs, outputs, BACKWARD_THREADS)
        return sums.sum(0)

    def _scatter(
        self, grad_encoded: torch.Tensor, unscale: torch.Tensor, need_points: bool
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the gradients of the grid (L, T, F), and of positions and depths (n, 4) if needed."""
        table, positions, shape = self.field.stored(), self.points.positions, Shape.of(self.points, self.rays)
        grad_grid = torch.zeros_like(table, dtype=torch.float32)
        grad_points = positions.new_empty(len(positions) * need_points, 4)
        levels, size, features = table.shape
        inputs = [
            array(table.view(-1), wp.float16),
            array(positions, wp.vec3),
            array(self.points.depths, wp.float32),
            array(self.field.resolutions, wp.float32),
            array(self.points.focal, wp.float32),
            wp.uint32(size - 1),
            array(grad_encoded.view(torch.float16), wp.float16),
            array(unscale, wp.float32),
            *shape,
        ]
        outputs = [array(grad_grid.view(-1), wp.float32), array(grad_points, wp.vec4)]
        kernel, threads = fused_scatter_kernel(features), shape.units * (32 if positions.is_cuda else 1)
        for group in level_groups(levels, size * features * 4):
            # In one thread on a CPU.
            launch(positions, kernel, threads, [*inputs, *group], outputs, block_dim=SCATTER_THREADS, smallest=threads)
        return grad_grid, grad_points


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
    kernel: wp.Kernel, like: torch.Tensor, warps: int, inputs: list[Argument], outputs: list[Argument], block_dim: int
) -> None:
    """Launch a kernel whose second argument is its number of threads, on CUDA 32 for each warp."""
    threads = warps * 32 if like.is_cuda else warps
    launch(like, kernel, threads, [threads, *inputs], outputs, block_dim=block_dim, smallest=threads)


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
    inputs = [*matrices, array(sources, wp.int32)]
    launch(packed, pack_matrices, len(packed), inputs, [array(packed, wp.float16)])
    return packed.view(torch.int32)


def _scales(grad: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the factor (1,) that gradients in half precision are multiplied by, and its inverse."""
    largest = torch.linalg.vector_norm(grad, float("inf")).view(1)
    scale, unscale = torch.empty_like(largest), torch.empty_like(largest)
    outputs = [array(x, wp.float32) for x in (scale, unscale)]
    launch(grad, half_scale, 1, [array(largest, wp.float32), HALF_GRADIENT], outputs)
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
