"""Texturing in one kernel each way, for the shapes that `fits` names; see `nexwarp.ops.texture`."""

import functools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from nexwarp.kernels.fused_scatter import SCATTER_THREADS, fused_scatter_kernel
from nexwarp.kernels.fused_texture import (
    BACKWARD_BLOCKS,
    BACKWARD_THREADS,
    FORWARD_BLOCKS,
    FORWARD_THREADS,
    fused_kernels,
    pack_matrices,
)
from nexwarp.kernels.tiles import LARGEST_INT
from nexwarp.native.fused_texture import (
    FEATURES,
    GRADIENTS,
    MATRICES,
    OUTPUTS,
    WIDTH,
    logical_feature,
    logical_output,
)
from nexwarp.ops._interop import Argument, Context, Op, graph_is_kept, launch
from nexwarp.ops.neural_field import Field, Points, Rays, gradient_scales

GROUP_BYTES = 2**24  # of sums that a launch of the backward lookup adds to: a third of an H100's L2 cache


def fits(grid: torch.Tensor, weights: Sequence[torch.Tensor], points: int) -> bool:
    """Whether the fused kernels take a grid (L, T, F) and matrices, of SH degree 0 to 3, for so many points."""
    levels, size, features = grid.shape
    shapes = [tuple(matrix.shape) for matrix in weights]
    hidden: list[tuple[int, ...]] = [(WIDTH, FEATURES), (WIDTH, WIDTH)]
    return (
        fits_sizes(levels, features, WIDTH, 2)
        and any(shapes == [*hidden, (3 * (degree + 1) ** 2, WIDTH)] for degree in range(4))
        and levels * size * features <= LARGEST_INT
        and points <= LARGEST_INT // 64
    )


def fits_sizes(levels: int, features: int, width: int, hidden_layers: int) -> bool:
    """Whether the fused kernels take L levels of F features and an MLP of these sizes."""
    return levels * features == FEATURES and features in (2, 4) and (width, hidden_layers) == (WIDTH, 2)


def runs_on(device: torch.device) -> bool:
    """Whether a device has the instructions of tensor cores that the kernels use."""
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)


def usable(points: Points, field: Field, rays: Rays) -> bool:
    """Whether the fused kernels compute these colours; see `nexwarp.ops.texture`."""
    positions = points.positions
    return (
        field.half
        and runs_on(positions.device)
        and positions.dtype == torch.float32
        and not (torch.is_grad_enabled() and rays.directions.requires_grad)
        and not torch.are_deterministic_algorithms_enabled()
        and len(positions) > 0
        and fits(field.grid, field.weights, len(positions))
    )


def colors(points: Points, field: Field, rays: Rays, *, keep: bool) -> torch.Tensor:
    """Return colours (n, 3), differentiable with respect to positions, depths, grid and weights.

    Points are float32; they and `rays` are contiguous, and `field` has its `table`. `keep` says whether there will be
    a backward pass.
    """
    return _Colors.apply(points, field, rays, keep, points.positions, points.depths, field.grid, *field.weights)


class _Colors(Op):
    @staticmethod
    def forward(
        ctx: Context, points: Points, field: Field, rays: Rays, keep: bool, *tensors: torch.Tensor
    ) -> torch.Tensor:
        result, encoded, packed = forward(points, field, rays, keep)
        if keep:
            ctx.rest = replace(rays, directions=rays.directions[:0])
            fixed = (rays.directions, points.focal, field.stored(), field.resolutions)
            clamped = result if rays.clamp else result.new_empty(0, 3)
            ctx.save_for_backward(points.positions, points.depths, *fixed, encoded, packed, clamped, *field.weights)
        return result

    @staticmethod
    def backward(ctx: Context, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        positions, depths, directions, focal, table, resolutions, encoded, packed, clamped, *weights = ctx.saved_tensors
        need_positions, need_depths, need_grid = ctx.needs_input_grad[4:7]
        points, field = Points(positions, depths, focal), Field(table, weights, resolutions, True, table)
        grad = grad.contiguous()
        scale, unscale = gradient_scales(grad, table.dtype)
        grad_encoded = torch.empty_like(encoded) if graph_is_kept() else encoded  # else gradients overwrite features
        fused, units = _fused(points, field, replace(ctx.rest, directions=directions), packed)
        fused |= {"encoded": encoded, "scale": scale, "unscale": unscale}
        fused |= {"grad_colors": grad, "grad_encoded": grad_encoded}
        grad_matrices = _mlp_backward(fused, weights, table, clamped, unscale)
        grad_grid, grad_points = _scatter(fused, points, table, units, need_positions or need_depths)
        return (
            *(None,) * 4,
            grad_points[:, :3] if need_positions else None,
            grad_points[:, 3] if need_depths else None,
            grad_grid if need_grid else None,
            *grad_matrices,
        )


def _fused(points: Points, field: Field, rays: Rays, packed: torch.Tensor) -> tuple[dict[str, Argument], int]:
    """The fields of `kernels.fused_texture.Fused` that all kernels read, and the number of tiles times hits."""
    height, width = rays.image or (1, len(rays.directions))
    hits, shift = len(points) // max(len(rays.directions), 1), 3 if height > 1 else 4
    units = -(-width // (1 << shift)) * -(-height // (16 >> shift)) * hits
    table = field.stored()
    image = {"width": width, "height": height, "hits": hits, "shift": shift}
    seen = {"positions": points.positions, "depths": points.depths, "directions": rays.directions}
    texture = {"table": table, "mask": table.shape[1] - 1, "resolutions": field.resolutions, "focal": points.focal}
    return {**image, **seen, **texture, "packed": packed, "offset": rays.offset, "clamp": int(rays.clamp)}, units


def forward(points: Points, field: Field, rays: Rays, keep: bool) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the colours (n, 3), the features as fragments, 64 bytes a point or none unless `keep`, and the matrices.

    These are in half precision, in the order in which the kernels' lanes load them.
    """
    packed, result = _pack(field.weights, field.grid.shape[2]), torch.empty_like(points.positions)
    fused, units = _fused(points, field, rays, packed)
    encoded = packed.new_empty(units * 256 if keep else 0)
    fused |= {"encoded": encoded, "colors": result}
    threads = FORWARD_THREADS * FORWARD_BLOCKS * _multiprocessors(result)
    kernel = fused_kernels(field.grid.shape[2]).forward
    launch(result, kernel, threads, [threads, fused], [], block_dim=FORWARD_THREADS)
    return result, encoded, packed


def _mlp_backward(
    fused: dict[str, Argument],
    weights: Sequence[torch.Tensor],
    table: torch.Tensor,
    clamped: torch.Tensor,
    unscale: torch.Tensor,
) -> list[torch.Tensor]:
    """Write the gradients of the features, scaled, and return those of the matrices."""
    features, blocks = table.shape[2], BACKWARD_BLOCKS * _multiprocessors(table)
    slots = unscale.new_empty(blocks, sum(GRADIENTS))
    arguments = {**fused, "grad_matrices": slots}
    threads = BACKWARD_THREADS * blocks
    kernel = fused_kernels(features).backward
    launch(table, kernel, threads, [threads, arguments, clamped], [], block_dim=BACKWARD_THREADS)
    order = _order(features, len(weights[-1]), table.device)
    gradients = slots.sum(0).index_select(0, order) * unscale
    parts = gradients.split([matrix.numel() for matrix in weights])
    return [part.view_as(matrix) for part, matrix in zip(parts, weights, strict=True)]


def _scatter(
    fused: dict[str, Argument], points: Points, table: torch.Tensor, units: int, need_points: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the gradients of the grid (L, T, F), and of positions and depths (n, 4) if needed."""
    levels, size, features = table.shape
    grad_grid = torch.zeros_like(table, dtype=torch.float32)
    grad_points = points.positions.new_empty(len(points) * need_points, 4)
    outputs = {"grad_table": grad_grid, "grad_points": grad_points}
    kernel = fused_scatter_kernel(features)
    for first, end in level_groups(levels, size * features * 4):
        arguments = {**fused, **outputs, "first_level": first, "end_level": end}
        launch(table, kernel, -(-units // 4) * 32, [arguments], [], block_dim=SCATTER_THREADS)
    return grad_grid, grad_points


def level_groups(levels: int, level_bytes: int) -> list[tuple[int, int]]:
    """Return the ranges of levels (first, end) that one launch of the backward lookup takes.

    Launches of few levels keep the sums in the L2 cache, where atomics are much faster than in memory. The coarser
    half of the levels goes together, as little of their tables is used. `level_bytes` are those of a level's sums.
    """
    if levels * level_bytes <= 2 * GROUP_BYTES:
        return [(0, levels)]
    half, each = levels // 2, max(GROUP_BYTES // level_bytes, 1)
    starts = [0, *range(max(half, 1), levels, each)]
    return list(zip(starts, [*starts[1:], levels], strict=True))


def _multiprocessors(like: torch.Tensor) -> int:
    return torch.cuda.get_device_properties(like.device).multi_processor_count


def _pack(weights: Sequence[torch.Tensor], features: int) -> torch.Tensor:
    """Return the matrices as words of two halves, in the order in which the kernels' lanes load them."""
    sources = _sources(features, len(weights[-1]), weights[0].device)
    packed = torch.empty(len(sources), dtype=torch.float16, device=sources.device)
    launch(packed, pack_matrices, len(packed), [*weights, sources], [packed])
    return packed.view(torch.int32)


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
