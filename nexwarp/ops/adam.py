"""One step of Adam on one parameter, in place, with a regulariser and a half-precision copy."""

import math
from typing import NamedTuple

import torch

from nexwarp.kernels.adam import CPU_VALUES, VALUES, Adam
from nexwarp.kernels.adam import adam_step as step_kernel
from nexwarp.kernels.launch import Sharing
from nexwarp.ops._interop import launch, struct

SMALLEST_SHARE = 64  # threads of a chunk on a CPU, at least


class Moments(NamedTuple):
    """What Adam keeps of a parameter."""

    step: torch.Tensor  # () float32, number of steps
    mean: torch.Tensor  # of the parameter's shape, exponential average of gradients
    square: torch.Tensor  # likewise of squared gradients


def adam_step(
    parameter: torch.Tensor,
    grad: torch.Tensor | None,
    moments: Moments,
    rate: torch.Tensor,
    *,
    betas: tuple[float, float],
    epsilon: float,
    factors: torch.Tensor | None = None,
    half: torch.Tensor | None = None,
) -> torch.Tensor | None:
    """Update a parameter and its averages in place, as `torch.optim.Adam` does, to float32 rounding.

    The parameter is float32 and contiguous; a gradient of None is zero; `moments.step` is the number of this step, from
    1; `rate` is () float32; `half`, float16, becomes the new values. With `factors` (L,), the parameter is a grid H
    (L, T, F) whose T * F is a power of two, and the gradient of sum_l factors[l] sum(H_l^2) is added: that sum before
    the step, a scalar, is returned.
    """
    count = parameter.numel()
    threads = -(-count // (VALUES if parameter.is_cuda else CPU_VALUES))
    level_bits, losses = 0, parameter.new_empty(0)
    if factors is not None:
        level_bits = (count // len(parameter)).bit_length() - 1
        if parameter.is_cuda:
            threads = -(-threads // 32) * 32  # whole warps, which add up what their lanes have
        losses = parameter.new_empty(threads // 32 if parameter.is_cuda else threads)
    adam = struct(
        Adam,
        values=parameter,
        means=moments.mean,
        squares=moments.square,
        grads=None if grad is None else _aligned(grad),
        halves=half,
        factors=factors,
        level_bits=level_bits,
        step=moments.step,
        rates=rate,
        beta1=betas[0],
        beta2=betas[1],
        rest1=1.0 - betas[0],
        rest2=1.0 - betas[1],
        log_beta1=math.log(betas[0]),
        log_beta2=math.log(betas[1]),
        epsilon=epsilon,
    )
    launch(parameter, step_kernel, threads, [adam], [losses], sharing=Sharing(SMALLEST_SHARE))
    return None if factors is None else losses.sum()


def _aligned(tensor: torch.Tensor) -> torch.Tensor:
    """Return a contiguous tensor, on CUDA one whose address is a multiple of 16, which loads of four values need."""
    tensor = tensor.contiguous()
    return tensor.clone() if tensor.is_cuda and tensor.data_ptr() % 16 else tensor
