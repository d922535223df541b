"""Activation of the surfels' raw parameters."""

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels import activate as kernels
from nexwarp.ops._interop import Context, Op, contiguous, launch


def activate(
    raw_quats: torch.Tensor,
    log_scales: torch.Tensor,
    logit_opacities: torch.Tensor,
    raw_gammas: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return quats (N, 4) of unit length, scales (N, 2), opacities (N,) and gammas (N, 2) of raw ones, see `Surfels`.

    All in one kernel; differentiable with respect to every argument. A quaternion shorter than 1e-12 is divided by
    1e-12. TypeError or ValueError where types, shapes or devices do not fit.
    """
    raw = (raw_quats, log_scales, logit_opacities, raw_gammas)
    shapes = {"raw_quats": ("N", 4), "log_scales": ("N", 2), "logit_opacities": ("N",), "raw_gammas": ("N", 2)}
    check_tensors({name: (x, shape) for x, (name, shape) in zip(raw, shapes.items(), strict=True)})
    return _Activate.apply(*(x.contiguous() for x in raw))


class _Activate(Op):
    @staticmethod
    def forward(ctx: Context, *raw: torch.Tensor) -> tuple[torch.Tensor, ...]:
        activated = tuple(torch.empty_like(x) for x in raw)
        launch(raw[0], kernels.activate, len(raw[0]), [raw], [activated])
        ctx.save_for_backward(*raw)
        return activated

    @staticmethod
    def backward(ctx: Context, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        raw = ctx.saved_tensors
        grad_raw = tuple(torch.empty_like(x) for x in raw)
        launch(raw[0], kernels.activate_backward, len(raw[0]), [raw, contiguous(*grads)], [grad_raw])
        return grad_raw
