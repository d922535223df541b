"""One step of Adam on one parameter, in place, with a regulariser and a half-precision copy."""

import math
from typing import NamedTuple

import torch
import warp as wp

from nexwarp.kernels.adam import VALUES, adam_kernel
from nexwarp.ops._interop import array, launch


class Regulariser(NamedTuple):
    """sum_l factors[l] sum(H_l^2) over the levels of a grid H (L, T, F), T * F a power of two.

    Attributes:
        factors: (L,) float32.
    """

    factors: torch.Tensor


def adam_step(
    parameter: torch.Tensor,
    grad: torch.Tensor | None,
    mean: torch.Tensor,
    square: torch.Tensor,
    step: torch.Tensor,
    rate: torch.Tensor,
    *,
    betas: tuple[float, float],
    epsilon: float,
    regulariser: Regulariser | None = None,
    half: torch.Tensor | None = None,
) -> torch.Tensor | None:
    """Update a parameter and its moments in place, as `torch.optim.Adam` does, to float32 rounding.

    Args:
        parameter: float32, contiguous, as are all of its shape.
        grad: of its shape; None is zero.
        mean: of its shape, exponential average of gradients.
        square: of its shape, exponential average of squared gradients.
        step: () float32, number of this step, from 1.
        rate: () float32, learning rate.
        betas: decay of the two averages.
        epsilon: added to the denominator.
        regulariser: whose gradient is added to `grad`; the parameter is then the grid (L, T, F).
        half: of its shape, float16, becomes the new values.

    Returns:
        The regulariser's value before the step, a scalar; None without one.
    """
    count = parameter.numel()
    threads = -(-count // VALUES)
    factors = level_bits = None
    losses = parameter.new_empty(0)
    if regulariser is not None:
        factors, level_bits = regulariser.factors, (count // len(parameter)).bit_length() - 1
        if parameter.is_cuda:
            threads = -(-threads // 32) * 32  # whole warps, which add up what their lanes have
        losses = parameter.new_empty(threads // 32 if parameter.is_cuda else threads)
    nothing = parameter.new_empty(0)
    launch(
        parameter,
        adam_kernel(),
        threads,
        [
            array(nothing if grad is None else _aligned(grad).view(-1), wp.float32),
            array(nothing if factors is None else factors, wp.float32),
            level_bits or 0,
            array(step.view(1), wp.float32),
            array(rate.view(1), wp.float32),
            *betas,
            *(1.0 - beta for beta in betas),
            *(math.log(beta) for beta in betas),
            epsilon,
        ],
        [
            *(array(x.view(-1), wp.float32) for x in (parameter, mean, square)),
            array(parameter.new_empty(0, dtype=torch.float16) if half is None else half.view(-1), wp.float16),
            array(losses, wp.float32),
        ],
    )
    return None if regulariser is None else losses.sum()


def _aligned(tensor: torch.Tensor) -> torch.Tensor:
    """Return a contiguous tensor whose address is a multiple of 16 bytes, which loads of four values need."""
    tensor = tensor.contiguous()
    return tensor.clone() if tensor.data_ptr() % 16 else tensor
