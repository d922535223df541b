"""Antialiasing: surfels as a camera sees them that is farther away than any training view was."""

from collections.abc import Iterable

import torch
from torch.autograd.function import once_differentiable

from nexwarp.errors import check_tensors
from nexwarp.kernels.antialias import antialias_kernels
from nexwarp.kernels.types import types
from nexwarp.ops._interop import Argument, Context, array, launch, real_of


def antialias(
    depths: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    gammas: torch.Tensor,
    farthest: torch.Tensor,
    focal: float | torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Blur surfels where a pixel covers more of them than it did in training.

    Differentiable with respect to all arguments but `farthest` and `focal`.

    Args:
        depths: (N,) z-depths of the centres, world units.
        scales: (N, 2) world units.
        opacities: (N,).
        gammas: (N, 2).
        farthest: (N,) largest depth / focal at which a training view saw the surfel, world units.
        focal: of the camera, pixels; a number, or a tensor (1,) on the device.

    Returns:
        (N, 2) scales, (N,) opacities and (N, 2) gammas; those given where depth / focal is no larger than in training.

    Raises:
        TypeError, ValueError: naming the argument, when types, shapes or devices do not fit.
    """
    check_tensors(
        {
            "depths": (depths, ("N",)),
            "scales": (scales, ("N", 2)),
            "opacities": (opacities, ("N",)),
            "gammas": (gammas, ("N", 2)),
            "farthest": (farthest, ("N",)),
        }
    )
    tensors = (x.contiguous() for x in (depths, scales, opacities, gammas))
    focal = focal.to(farthest) if isinstance(focal, torch.Tensor) else farthest.new_full((1,), float(focal))
    return _Antialias.apply(farthest.contiguous(), focal, *tensors)


def _arrays(real: type, tensors: Iterable[torch.Tensor]) -> list[Argument]:
    """Of scalars (N,) and pairs (N, 2)."""
    return [array(x, real if x.ndim == 1 else types(real).vec2) for x in tensors]


class _Antialias(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Context, farthest: torch.Tensor, focal: torch.Tensor, *shape: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        real = real_of(farthest)
        wide = tuple(torch.empty_like(x) for x in shape[1:])
        inputs = _arrays(real, (*shape, farthest, focal))
        launch(farthest, antialias_kernels(real).forward, len(farthest), inputs, _arrays(real, wide))
        ctx.save_for_backward(*shape, farthest, focal)
        return wide

    @staticmethod
    @once_differentiable
    def backward(ctx: Context, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        *shape, farthest, focal = ctx.saved_tensors
        real = real_of(farthest)
        found = [torch.empty_like(x) for x in shape]
        inputs = _arrays(real, (*shape, farthest, focal, *(x.contiguous() for x in grads)))
        launch(farthest, antialias_kernels(real).backward, len(farthest), inputs, _arrays(real, found))
        wanted = (x if need else None for x, need in zip(found, ctx.needs_input_grad[2:], strict=True))
        return (None, None, *wanted)
