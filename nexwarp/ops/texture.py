"""Texturing pass: the neural field at points, as spherical harmonics coefficients or as colours along rays.

Encode, MLP, colours: three steps in torch and Warp. `fused_texture` does all three in one CUDA kernel.
"""

from dataclasses import dataclass, replace

import torch
import warp as wp

from nexwarp.kernels.hashgrid import hashgrid, hashgrid_backward
from nexwarp.kernels.sh import textured_colors, textured_colors_backward
from nexwarp.ops import fused_texture, mlp
from nexwarp.ops._interop import STORAGES, Argument, Context, Names, Op, launch, sums_in_fixed_point
from nexwarp.ops.neural_field import Field, Points, Rays, gradient_scales

# Runs of levels that CPU threads share out in the backward pass.
RUNS = 8
# Points that a CPU evaluates at a time where no backward pass needs what lies between points and colours.
PART = 2**17
OUTPUTS = tuple(3 * (degree + 1) ** 2 for degree in range(4))  # of the MLP, by SH degree


def texture(points: Points, field: Field, rays: Rays | None = None, *, fused: bool = True) -> torch.Tensor:
    """Look points up in the hash grid, apply the MLP and, given rays, evaluate the colours.

    Differentiable with respect to positions, depths, grid, weights and directions, not resolutions and focal.
    `torch.autocast` changes nothing: `field.half` alone says what is computed in half precision.

    Colours whose directions need no gradient are computed by one fused kernel in half precision on GPUs of compute
    capability 8.0 or more, for L * F = 32, F = 2 or 4 and two hidden layers of 64, without torch's deterministic
    algorithms; all else, and all without `fused`, step by step. The two differ by rounding.

    Return colours (n, 3), offset + SH(direction); or, without rays, coefficients (3 (d + 1)^2, n), whose rows are
    coefficient * 3 + channel.
    """
    points = replace(points, positions=points.positions.contiguous(), depths=points.depths.contiguous())
    rays = rays and replace(rays, directions=rays.directions.contiguous())
    directions = None if rays is None else rays.directions
    differentiable = [points.positions, points.depths, directions, field.grid, *field.weights]
    keep = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in differentiable)
    if rays is not None and fused and fused_texture.usable(points, field, rays):
        return fused_texture.colors(points, replace(field, table=field.stored()), rays, keep=keep)
    if rays is not None and not keep and len(points) > PART and not points.positions.is_cuda:
        return _colors_in_parts(points, field, rays)
    return _Texture.apply(points, field, rays, keep, *differentiable)


def _colors_in_parts(points: Points, field: Field, rays: Rays) -> torch.Tensor:
    hits = len(points) // len(rays.directions)
    colors = torch.empty_like(points.positions)
    for first in range(0, len(rays.directions), PART // hits):
        pixels = slice(first, first + PART // hits)
        part = slice(pixels.start * hits, pixels.stop * hits)
        some = Points(points.positions[part], points.depths[part], points.focal)
        colors[part] = texture(some, field, replace(rays, directions=rays.directions[pixels], image=None))
    return colors


class _Texture(Op):
    @staticmethod
    def forward(
        ctx: Context, points: Points, field: Field, rays: Rays | None, keep: bool, *tensors: torch.Tensor | None
    ) -> torch.Tensor:
        lookup = Lookup(points, field.stored(), field.resolutions)
        matrices = [w.to(lookup.table.dtype) for w in field.weights]
        encoded = lookup.features()
        with torch.autocast(encoded.device.type, enabled=False):
            *layers, coefficients = mlp.outputs(encoded, matrices, keep)
        ctx.rest = rays and replace(rays, directions=rays.directions[:0]), len(layers)
        # What was clamped, and how colours follow from directions, is all that the backward pass reads of them.
        read = rays is not None and (rays.clamp or ctx.needs_input_grad[6])
        kept = coefficients if read else coefficients.new_empty(len(coefficients), 0)
        directions = None if rays is None else rays.directions
        inputs = [points.positions, points.depths, points.focal, directions, field.resolutions]
        ctx.save_for_backward(*inputs, lookup.table, kept, *layers, *matrices)
        if rays is None:
            return coefficients[:, : len(points)].to(field.grid.dtype)
        colors = torch.empty_like(points.positions)
        write_colors(colors, coefficients, rays)
        return colors

    @staticmethod
    def backward(ctx: Context, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        positions, depths, focal, directions, resolutions, table, coefficients, *rest = ctx.saved_tensors
        rays, count = ctx.rest
        layers, matrices = rest[:count], rest[count:]
        need_positions, need_depths, need_directions, need_grid = ctx.needs_input_grad[4:8]
        scale, unscale = gradient_scales(grad, table.dtype)
        signal = coefficients.new_empty(len(coefficients), mlp.padded(len(positions), table.dtype))
        signal[:, len(positions) :] = 0
        grad_directions = None
        if rays is None:
            signal[:, : len(positions)] = grad * scale
        else:
            rays = replace(rays, directions=directions)
            grad_directions = colors_backward(signal, coefficients, rays, grad.contiguous(), scale, need_directions)
        with torch.autocast(grad.device.type, enabled=False):
            signal, grad_matrices = mlp.outputs_backward(signal, layers, matrices)
        lookup = Lookup(Points(positions, depths, focal), table, resolutions)
        grad_grid, grad_points = lookup.backward(signal.contiguous(), unscale, need_positions or need_depths)
        return (
            *(None,) * 4,
            grad_points[:, :3] if need_positions else None,
            grad_points[:, 3] if need_depths else None,
            grad_directions,
            grad_grid if need_grid else None,
            *(x * unscale for x in grad_matrices),
        )


@dataclass(frozen=True)
class Lookup:
    """The lookup of points in a table (L, T, F)."""

    points: Points
    table: torch.Tensor
    resolutions: torch.Tensor

    def features(self) -> torch.Tensor:
        """Return the features (L * F, padded n) of n points, 0 in the padding."""
        levels, _, features = self.table.shape
        count = len(self.points)
        encoded = self.table.new_empty(levels * features, mlp.padded(count, self.table.dtype))
        # Without biases the padding stays 0 through all layers, and adds nothing to any gradient.
        encoded[:, count:] = 0
        launch(self.points.positions, hashgrid, (levels, count), self._arguments(), [encoded], **self._names())
        return encoded

    def backward(
        self, grad_encoded: torch.Tensor, unscale: torch.Tensor, need_points: bool
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the gradients of the table (L, T, F), and of positions and depths (n, 4) if needed."""
        count, levels = len(self.points), len(self.table)
        fixed_point = sums_in_fixed_point(self.table)
        # On a CPU a thread owns the tables of its run of levels; on CUDA a thread takes all levels.
        levels_per_thread = levels if self.table.is_cuda else -(-levels // RUNS)
        runs = -(-levels // levels_per_thread)
        grad_points = self.points.positions.new_empty(runs if need_points else 0, count, 4)
        units = bad = None
        if fixed_point:
            units = _units(grad_encoded, unscale)
            bad = torch.zeros(1, dtype=torch.int32, device=self.table.device)
        sums = torch.zeros_like(self.table, dtype=torch.int64 if fixed_point else self.points.positions.dtype)
        inputs = [*self._arguments(), grad_encoded, unscale, units, levels_per_thread]
        outputs = [sums.flatten(1) if fixed_point else sums, grad_points, bad]
        names = self._names() | {"fixed_point": fixed_point}
        launch(self.points.positions, hashgrid_backward, (runs, count), inputs, outputs, **names)
        if units is not None and bad is not None:
            sums = torch.where(bad.bool(), torch.nan, (sums.double() / units).to(grad_points.dtype))
        return sums, grad_points.sum(0) if runs > 1 else grad_points.view(-1, 4)

    def _names(self) -> Names:
        """What the kernels depend on."""
        return {"storage": STORAGES[self.table.dtype], "features": self.table.shape[2]}

    def _arguments(self) -> list[Argument]:
        points, mask = self.points, wp.uint32(self.table.shape[1] - 1)
        return [self.table, points.positions, points.depths, self.resolutions, points.focal, mask]


def _units(grad_encoded: torch.Tensor, unscale: torch.Tensor) -> torch.Tensor:
    """(1,) float64 power of two that makes 2^46 units of the largest gradient: 2^17 of those may meet in one entry."""
    if grad_encoded.numel() == 0:  # whose norm torch refuses
        return unscale.new_ones(1, dtype=torch.float64)
    largest = torch.linalg.vector_norm(grad_encoded.float(), float("inf")).double() * unscale.double()
    return torch.exp2(torch.floor(torch.log2(2.0**46 / largest.clamp_min(1e-200)))).view(1)


def _color_arguments(coefficients: torch.Tensor, rays: Rays, count: int) -> tuple[list[Argument], Names]:
    """The arguments that the kernels of colours along rays begin with, and the names that they depend on."""
    if len(coefficients) not in OUTPUTS:
        raise ValueError(f"weights: expected 3 (d + 1)^2 outputs with d of 0 to 3, got {len(coefficients)}")
    hits = count // max(len(rays.directions), 1)
    names = {"storage": STORAGES[coefficients.dtype], "clamp": rays.clamp}
    return [coefficients, rays.directions, hits, rays.offset], names


def write_colors(colors: torch.Tensor, coefficients: torch.Tensor, rays: Rays) -> None:
    """Write the colours (n, 3) of coefficients along rays."""
    arguments, names = _color_arguments(coefficients, rays, len(colors))
    launch(colors, textured_colors, len(colors), arguments, [colors], **names)


def colors_backward(
    signal: torch.Tensor,
    coefficients: torch.Tensor,
    rays: Rays,
    grad_colors: torch.Tensor,
    scale: torch.Tensor,
    need_directions: bool,
) -> torch.Tensor | None:
    """Write the gradient of the coefficients to `signal`, which has their padded shape; return that of directions."""
    count = len(grad_colors)
    slots = grad_colors.new_zeros(count if need_directions else 0, 3)
    arguments, names = _color_arguments(coefficients, rays, count)
    inputs = [*arguments, scale, grad_colors]
    launch(grad_colors, textured_colors_backward, count, inputs, [signal, slots], **names)
    return slots.view(len(rays.directions), -1, 3).sum(1) if need_directions else None
