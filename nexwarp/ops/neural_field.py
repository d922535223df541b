"""What a neural texture consists of and where it is evaluated, and the scale of gradients in half precision."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from nexwarp.kernels.fused_texture import half_scale
from nexwarp.ops._interop import launch

# Gradients in half precision are scaled, by a power of two, so that the largest incoming one is near this.
HALF_GRADIENT = 64.0


@dataclass(frozen=True)
class Points:
    """Points at which a texture is evaluated."""

    positions: torch.Tensor  # (n, 3) world
    depths: torch.Tensor  # (n,) z-depths, world units; a point with depth 0 is skipped and has features 0
    focal: torch.Tensor  # (1,) focal length in pixels, for the down-weighting of paper Eq. 4; not differentiated

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class Field:
    """A hash grid and an MLP, whose matrices (out, in) have ReLU between them and no biases.

    With `half`, features, activations and coefficients are in half precision; gradients are scaled on the way and
    summed in float32.
    """

    grid: torch.Tensor  # (L, T, F) features, T a power of two, F in 1, 2, 4, 8
    weights: Sequence[torch.Tensor]  # 3 (d + 1)^2 outputs for SH degree d; without any, outputs are the features
    resolutions: torch.Tensor  # (L,) cells per world unit; not differentiated
    half: bool = False
    table: torch.Tensor | None = None  # (L, T, F) the grid in half precision, where the caller has it already

    def stored(self) -> torch.Tensor:
        """The grid's values, contiguous, in the precision of the evaluation."""
        if self.half and self.table is not None:
            return self.table
        return self.grid.detach().contiguous().to(torch.float16 if self.half else self.grid.dtype)


@dataclass(frozen=True)
class Rays:
    """Directions along which coefficients become colours.

    Those of an image (height, width), whose product is P, are row by row; neighbouring pixels then work together, which
    changes no result but for the order of sums.
    """

    directions: torch.Tensor  # (P, 3) unit, world; of n = P * K points, point i belongs to direction i // K
    offset: float = 0.5  # colour of coefficients of 0; 0 makes them residuals
    clamp: bool = False  # limit colours to >= 0
    image: tuple[int, int] | None = None


def gradient_scales(grad: torch.Tensor, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the factor (1,) that gradients of a dtype are multiplied by on the way, and its inverse; 1 but for half.

    It is the power of two that brings the largest gradient near HALF_GRADIENT.
    """
    if dtype != torch.float16 or grad.numel() == 0:
        return grad.new_ones(1), grad.new_ones(1)
    largest = torch.linalg.vector_norm(grad, float("inf")).view(1)
    scale, unscale = torch.empty_like(largest), torch.empty_like(largest)
    launch(grad, half_scale, 1, [largest, HALF_GRADIENT], [scale, unscale])
    return scale, unscale
