"""One step of Adam on many parameters, in place, with a grid's regulariser and half-precision copy."""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from nexwarp.kernels.adam import CPU_VALUES, MOST, VALUES, Addresses, Numbers
from nexwarp.kernels.adam import adam_step as step_kernel
from nexwarp.kernels.launch import Sharing
from nexwarp.kernels.tiles import LARGEST_INT
from nexwarp.ops._interop import launch

SMALLEST_SHARE = 64  # threads of a chunk on a CPU, at least


class Stepped(NamedTuple):
    """A parameter, float32 and contiguous, and what its step reads and writes."""

    values: torch.Tensor
    mean: torch.Tensor  # of the parameter's shape, exponential average of gradients
    square: torch.Tensor  # likewise of squared gradients
    grad: torch.Tensor | None  # None is zero
    step: torch.Tensor  # () float32, number of the step, from 1
    rate: torch.Tensor  # () float32


def adam_step(
    parameters: Sequence[Stepped],
    *,
    betas: tuple[float, float],
    epsilon: float,
    factors: torch.Tensor | None = None,
    half: torch.Tensor | None = None,
) -> torch.Tensor | None:
    """Update parameters and their averages in place, as `torch.optim.Adam` does, to float32 rounding.

    The first one becomes `half`, too, in float16. With `factors` (L,), it is a grid H (L, T, F) whose T * F is a power
    of two, and the gradient of sum_l factors[l] sum(H_l^2) is added: that sum before the step, a scalar, is returned.
    """
    if not parameters:
        return None
    chosen, rest = [x._replace(grad=_aligned(x.grad)) for x in parameters[:MOST]], parameters[MOST:]
    like = chosen[0].values
    # Whole warps, which add up what their lanes have.
    wide, warp = (VALUES, 32) if like.is_cuda else (CPU_VALUES, 1)
    threads = [-(-x.values.numel() // (wide * warp)) * warp for x in chosen]
    *starts, total = itertools.accumulate(threads, initial=0)
    unused = MOST - len(chosen)
    level_bits, losses = 0, like.new_empty(0)
    if factors is not None:
        level_bits = (like.numel() // len(like)).bit_length() - 1
        losses = like.new_empty(threads[0] // warp)
    named = zip(("values", "means", "squares", "grads", "steps", "rates"), zip(*chosen, strict=True), strict=True)
    adam = dict(
        starts=Numbers(*starts, *[LARGEST_INT] * unused),
        counts=Numbers(*(x.values.numel() for x in chosen), *[0] * unused),
        **{name: Addresses(*(0 if x is None else x.data_ptr() for x in xs), *[0] * unused) for name, xs in named},
        halves=half,
        factors=factors,
        level_bits=level_bits,
        beta1=betas[0],
        beta2=betas[1],
        rest1=1.0 - betas[0],
        rest2=1.0 - betas[1],
        log_beta1=math.log(betas[0]),
        log_beta2=math.log(betas[1]),
        epsilon=epsilon,
    )
    launch(like, step_kernel, total, [adam], [losses], sharing=Sharing(SMALLEST_SHARE))
    adam_step(rest, betas=betas, epsilon=epsilon)
    return None if factors is None else losses.sum()


def _aligned(tensor: torch.Tensor | None) -> torch.Tensor | None:
    """Return a contiguous tensor, on CUDA one whose address is a multiple of 16, which loads of four values need."""
    if tensor is None:
        return None
    tensor = tensor.contiguous()
    return tensor.clone() if tensor.is_cuda and tensor.data_ptr() % 16 else tensor
