"""Texturing pass: the neural field at points, as spherical harmonics coefficients or as colours along rays."""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from nexwarp.kernels.hashgrid import hashgrid_kernels
from nexwarp.kernels.sh import textured_colors_kernels
from nexwarp.kernels.types import types
from nexwarp.ops import fused_texture, mlp
from nexwarp.ops._interop import STORAGES, array, launch, real_of, sums_in_fixed_point
from nexwarp.ops.half_gradients import gradient_scale

# Runs of levels that CPU threads share out in the backward pass.
RUNS = 8


def texture(
    positions: torch.Tensor,
    depths: torch.Tensor,
    grid: torch.Tensor,
    weights: Sequence[torch.Tensor],
    resolutions: torch.Tensor,
    focal: torch.Tensor,
    *,
    directions: torch.Tensor | None = None,
    offset: float = 0.5,
    clamp: bool = False,
    half: bool = False,
    table: torch.Tensor | None = None,
    image: tuple[int, int] | None = None,
    fused: bool = True,
) -> torch.Tensor:
    """Look points up in the hash grid, apply the MLP and, given directions, evaluate the colours.

    Differentiable with respect to positions, depths, grid, weights and directions, not resolutions and focal.
    `torch.autocast` changes nothing: `half` alone says what is computed in half precision.

    Colours whose directions need no gradient are computed by one fused kernel in half precision on GPUs of compute
    capability 8.0 or more, for L * F = 32, F = 2 or 4 and two hidden layers of 64, without torch's deterministic
    algorithms; all else layer by layer. The two differ by rounding.

    Args:
        positions: (n, 3) world.
        depths: (n,) z-depths from the camera, world units; a point with depth 0 is skipped and has features 0.
        grid: (L, T, F) features, T a power of two, F in 1, 2, 4, 8.
        weights: the MLP's matrices (out, in), ReLU between them, no biases; 3 (d + 1)^2 outputs for SH degree d.
        resolutions: (L,) cells per world unit.
        focal: (1,) focal length in pixels, for the down-weighting of paper Eq. 4.
        directions: (P, 3) unit directions, world, where n = P * K and point i belongs to direction i // K.
        offset: colour of coefficients of 0; 0 makes them residuals.
        clamp: limit colours to >= 0.
        half: keep features, activations and coefficients in half precision; gradients are scaled on the way
            and summed in float32.
        table: (L, T, F) the grid in half precision, where the caller has it already.
        image: (height, width), whose product is P, of the image that the directions belong to, row by row; neighbouring
            pixels then work together. It changes no result but for the order of sums.
        fused: False computes layer by layer in any case.

    Returns:
        (3 (d + 1)^2, n) coefficients, row coefficient * 3 + channel; or (n, 3) colours offset + SH(direction).
    """
    positions, depths = positions.contiguous(), depths.contiguous()
    turned = directions is not None and directions.requires_grad
    keep = torch.is_grad_enabled() and (turned or any(x.requires_grad for x in (positions, depths, grid, *weights)))
    directions = None if directions is None else directions.contiguous()
    points = (positions, depths, directions)
    if directions is not None and fused and half and fused_texture.usable(positions, directions, grid, weights):
        height, width = image or (1, len(directions))
        shape = fused_texture.Shape(width, height, len(positions) // max(len(directions), 1))
        copy = grid.detach().contiguous().half() if table is None else table
        inputs = fused_texture.Inputs(positions, depths, directions, copy, weights, resolutions, focal, shape)
        return fused_texture.colors(inputs, grid, offset, clamp, keep=keep)
    return _Texture.apply(*points, grid, table, resolutions, focal, offset, clamp, half, keep, *weights)


class _Texture(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        positions: torch.Tensor,
        depths: torch.Tensor,
        directions: torch.Tensor | None,
        grid: torch.Tensor,
        table: torch.Tensor | None,
        resolutions: torch.Tensor,
        focal: torch.Tensor,
        offset: float,
        clamp: bool,
        half: bool,
        keep: bool,
        *weights: torch.Tensor,
    ) -> torch.Tensor:
        dtype = torch.float16 if half else grid.dtype
        table = table if half and table is not None else grid.contiguous().to(dtype)
        matrices = [w.to(dtype) for w in weights]
        encoded = _features(table, positions, depths, resolutions, focal)
        with torch.autocast(grid.device.type, enabled=False):
            *layers, coefficients = mlp.outputs(encoded, matrices, keep)
        ctx.offset, ctx.clamp = offset, clamp
        ctx.layers = len(layers)
        # What was clamped, and how colours follow from directions, is all that the backward pass reads of them.
        read = directions is not None and (clamp or ctx.needs_input_grad[2])
        kept = coefficients if read else coefficients.new_empty(len(coefficients), 0)
        ctx.save_for_backward(positions, depths, directions, resolutions, focal, table, kept, *layers, *matrices)
        if directions is None:
            return coefficients[:, : len(positions)].to(grid.dtype)
        colors = torch.empty_like(positions)
        kernels, arguments = _colors(coefficients, directions, len(positions), offset, clamp)
        launch(
            positions,
            kernels.forward,
            len(positions),
            arguments,
            [array(colors, types(real_of(positions)).vec3)],
        )
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        positions, depths, directions, resolutions, focal, table, coefficients, *rest = ctx.saved_tensors
        layers, matrices = rest[: ctx.layers], rest[ctx.layers :]
        need_positions, need_depths, need_directions, need_grid = ctx.needs_input_grad[:4]
        scale = gradient_scale(grad, table.dtype)
        grad_directions = None
        if directions is None:
            signal = coefficients.new_zeros(len(coefficients), layers[0].shape[1])
            signal[:, : grad.shape[1]] = grad * scale
        else:
            signal = coefficients.new_empty(len(coefficients), layers[0].shape[1])
            grad_directions = _colors_backward(
                signal, coefficients, directions, grad.contiguous(), scale, ctx.offset, ctx.clamp, need_directions
            )
        unscale = scale.reciprocal()
        with torch.autocast(grad.device.type, enabled=False):
            signal, grad_matrices = mlp.outputs_backward(signal, layers, matrices)
        grad_matrices = [x * unscale for x in grad_matrices]
        grad_grid, grad_positions, grad_depths = _lookup_backward(
            table, positions, depths, resolutions, focal, signal, unscale, need_positions or need_depths
        )
        return (
            grad_positions if need_positions else None,
            grad_depths if need_depths else None,
            grad_directions,
            grad_grid if need_grid else None,
            *(None,) * 7,
            *grad_matrices,
        )


def _features(
    table: torch.Tensor,
    positions: torch.Tensor,
    depths: torch.Tensor,
    resolutions: torch.Tensor,
    focal: torch.Tensor,
) -> torch.Tensor:
    """Return the features (L * F, padded n) of n points, 0 in the padding."""
    levels, _, features = table.shape
    count = len(positions)
    encoded = table.new_empty(levels * features, mlp.padded(count, table.dtype))
    # Without biases the padding stays 0 through all layers, and adds nothing to any gradient.
    if encoded.shape[1] > count:
        encoded[:, count:] = 0
    kernels, arguments = _lookup(table, positions, depths, resolutions, focal)
    outputs = [array(encoded, STORAGES[table.dtype])]
    launch(positions, kernels.forward, (levels, len(positions)), arguments, outputs)
    return encoded


def _lookup(
    table: torch.Tensor,
    positions: torch.Tensor,
    depths: torch.Tensor,
    resolutions: torch.Tensor,
    focal: torch.Tensor,
) -> tuple[Any, list[Any]]:
    real, storage = real_of(positions), STORAGES[table.dtype]
    _, size, features = table.shape
    arguments = [
        array(table, wp.types.vector(length=features, dtype=storage)),
        array(positions, types(real).vec3),
        array(depths, real),
        array(resolutions, real),
        array(focal, real),
        wp.uint32(size - 1),
    ]
    return hashgrid_kernels(real, storage, features), arguments


def _lookup_backward(
    table: torch.Tensor,
    positions: torch.Tensor,
    depths: torch.Tensor,
    resolutions: torch.Tensor,
    focal: torch.Tensor,
    grad_encoded: torch.Tensor,
    unscale: torch.Tensor,
    need_points: bool,
) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
    real = real_of(positions)
    vec4 = types(real).vec4
    levels, _, features = table.shape
    fixed_point = sums_in_fixed_point(positions)
    # On a CPU a thread owns the tables of its run of levels; on CUDA a thread takes all levels.
    levels_per_thread = levels if positions.is_cuda else -(-levels // RUNS)
    runs = -(-levels // levels_per_thread)
    grad_points = positions.new_empty(runs if need_points else 0, len(positions), 4)
    kernels, arguments = _lookup(table, positions, depths, resolutions, focal)
    arguments += [array(grad_encoded.contiguous(), STORAGES[table.dtype]), array(unscale, real)]
    threads = (runs, len(positions))
    if fixed_point:
        kernel = hashgrid_kernels(real, STORAGES[table.dtype], features, fixed_point=True).backward
        units = _units(grad_encoded, unscale)
        bad = torch.zeros(1, dtype=torch.int32, device=table.device)
        sums = torch.zeros_like(table, dtype=torch.int64)
        outputs = [array(sums.view(levels, -1), wp.int64), array(grad_points, vec4), array(bad, wp.int32)]
        launch(positions, kernel, threads, [*arguments, array(units, wp.float64), levels_per_thread], outputs)
        grad_grid = torch.where(bad.bool(), torch.nan, (sums.double() / units).to(positions.dtype))
    else:
        grad_grid = torch.zeros_like(table, dtype=positions.dtype)
        outputs = [array(grad_grid, wp.types.vector(length=features, dtype=real)), array(grad_points, vec4)]
        launch(positions, kernels.backward, threads, [*arguments, None, levels_per_thread], [*outputs, None])
    if not need_points:
        return grad_grid, None, None
    points = grad_points.sum(0) if runs > 1 else grad_points[0]
    return grad_grid, points[:, :3], points[:, 3]


def _units(grad_encoded: torch.Tensor, unscale: torch.Tensor) -> torch.Tensor:
    """(1,) float64 power of two that makes 2^46 units of the largest gradient: 2^17 of those may meet in one entry."""
    if grad_encoded.numel() == 0:  # whose norm torch refuses
        return unscale.new_ones(1, dtype=torch.float64)
    largest = torch.linalg.vector_norm(grad_encoded.float(), float("inf")).double() * unscale.double()
    return torch.exp2(torch.floor(torch.log2(2.0**46 / largest.clamp_min(1e-200)))).view(1)


def _colors(
    coefficients: torch.Tensor, directions: torch.Tensor, count: int, offset: float, clamp: bool
) -> tuple[Any, list[Any]]:
    real, storage = real_of(directions), STORAGES[coefficients.dtype]
    if coefficients.shape[0] not in mlp.OUTPUTS:
        raise ValueError(f"weights: expected 3 (d + 1)^2 outputs with d of 0 to 3, got {coefficients.shape[0]}")
    degree = mlp.OUTPUTS.index(coefficients.shape[0])
    kernels = textured_colors_kernels(real, storage, degree, clamp)
    hits = count // max(len(directions), 1)
    return kernels, [array(coefficients, storage), array(directions, types(real).vec3), hits, offset]


def _colors_backward(
    signal: torch.Tensor,
    coefficients: torch.Tensor,
    directions: torch.Tensor,
    grad_colors: torch.Tensor,
    scale: torch.Tensor,
    offset: float,
    clamp: bool,
    need_directions: bool,
) -> torch.Tensor | None:
    """Write the gradient of the coefficients to `signal`, which has their padded shape; return that of directions."""
    real = real_of(directions)
    vec3 = types(real).vec3
    count = len(grad_colors)
    if signal.shape[1] > count:
        signal[:, count:] = 0
    slots = directions.new_zeros(count if need_directions else 0, 3)
    kernels, arguments = _colors(coefficients, directions, count, offset, clamp)
    arguments += [array(scale, real), array(grad_colors, vec3)]
    launch(
        directions,
        kernels.backward,
        count,
        arguments,
        [array(signal, STORAGES[coefficients.dtype]), array(slots, vec3)],
    )
    return slots.view(len(directions), -1, 3).sum(1) if need_directions else None
