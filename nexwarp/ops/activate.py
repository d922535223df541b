"""Activation of the surfels' raw parameters."""

from collections.abc import Iterable

import torch
from torch.autograd.function import once_differentiable

from nexwarp.errors import check_tensors
from nexwarp.kernels.activate import activate_kernels
from nexwarp.kernels.types import types
from nexwarp.ops._interop import Argument, Context, array, launch, real_of


def activate(
    raw_quats: torch.Tensor,
    log_scales: torch.Tensor,
    logit_opacities: torch.Tensor,
    raw_gammas: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Activate raw parameters, all in one kernel; differentiable with respect to every argument.

    Args:
        raw_quats: (N, 4) wxyz, of any length; one shorter than 1e-12 is divided by 1e-12.
        log_scales: (N, 2) logarithms of world units.
        logit_opacities: (N,).
        raw_gammas: (N, 2), logarithms of gamma - 1.

    Returns:
        (N, 4) unit quaternions, wxyz; (N, 2) scales, world units; (N,) opacities in [0, 1]; (N, 2) gammas >= 1.

    Raises:
        TypeError, ValueError: naming the argument, when types, shapes or devices do not fit.
    """
    check_tensors(
        {
            "raw_quats": (raw_quats, ("N", 4)),
            "log_scales": (log_scales, ("N", 2)),
            "logit_opacities": (logit_opacities, ("N",)),
            "raw_gammas": (raw_gammas, ("N", 2)),
        }
    )
    return _Activate.apply(*(x.contiguous() for x in (raw_quats, log_scales, logit_opacities, raw_gammas)))


def _arrays(real: type, tensors: Iterable[torch.Tensor]) -> list[Argument]:
    t = types(real)
    return [array(x, dtype) for x, dtype in zip(tensors, (t.vec4, t.vec2, real, t.vec2), strict=True)]


class _Activate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Context, *raw: torch.Tensor) -> tuple[torch.Tensor, ...]:
        real = real_of(raw[0])
        activated = tuple(torch.empty_like(x) for x in raw)
        launch(raw[0], activate_kernels(real).forward, len(raw[0]), _arrays(real, raw), _arrays(real, activated))
        ctx.save_for_backward(*raw)
        return activated

    @staticmethod
    @once_differentiable
    def backward(ctx: Context, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        raw = ctx.saved_tensors
        real = real_of(raw[0])
        grad_raw = [torch.empty_like(x) for x in raw]
        inputs = [*_arrays(real, raw), *_arrays(real, (x.contiguous() for x in grads))]
        launch(raw[0], activate_kernels(real).backward, len(raw[0]), inputs, _arrays(real, grad_raw))
        return tuple(x if need else None for x, need in zip(grad_raw, ctx.needs_input_grad, strict=True))
