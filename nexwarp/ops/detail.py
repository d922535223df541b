"""Limits of detail: surfels and depths of texture look-ups for cameras that are not where training views were."""

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels import detail as kernels
from nexwarp.ops._interop import Context, Op, contiguous, launch


def antialias(
    depths: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    gammas: torch.Tensor,
    farthest: torch.Tensor,
    focal: float | torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Blur surfels where a pixel covers more of them than it did in training.

    Return scales (N, 2), opacities (N,) and gammas (N, 2); those given where the centre's z-depth (N,) over the focal
    length, pixels, a number or a tensor (1,), is no larger than `farthest` (N,), the largest of the training views.
    Differentiable with respect to all arguments but `farthest` and `focal`.
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


class _Antialias(Op):
    @staticmethod
    def forward(
        ctx: Context, farthest: torch.Tensor, focal: torch.Tensor, depths: torch.Tensor, *shape: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        blurred = tuple(torch.empty_like(x) for x in shape)
        inputs = [depths, (None, *shape), farthest, focal]
        launch(farthest, kernels.antialias, len(farthest), inputs, [(None, *blurred)])
        ctx.save_for_backward(farthest, focal, depths, *shape)
        return blurred

    @staticmethod
    def backward(ctx: Context, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        farthest, focal, depths, *shape = ctx.saved_tensors
        grad_depths, *grad_shape = (torch.empty_like(x) for x in (depths, *shape))
        inputs = [depths, (None, *shape), farthest, focal, contiguous(None, *grads)]
        launch(farthest, kernels.antialias_backward, len(farthest), inputs, [grad_depths, (None, *grad_shape)])
        return None, None, grad_depths, *grad_shape


def limit_depths(
    ids: torch.Tensor,
    depths: torch.Tensor,
    nearest: torch.Tensor,
    farthest: torch.Tensor,
    focal: float | torch.Tensor,
) -> torch.Tensor:
    """Clamp depths (H, W, K) to at most focal * farthest, then to at least focal * nearest; differentiable in depths.

    Hits are of the surfels `ids` (H, W, K) int32, of which -1 leaves the depth; limits (N,) are depth / focal, world
    units; `focal` is in pixels, a number or a tensor (1,) on the device.
    """
    focal = focal.to(depths) if isinstance(focal, torch.Tensor) else depths.new_full((1,), float(focal))
    return _LimitDepths.apply(ids, depths.contiguous(), nearest.contiguous(), farthest.contiguous(), focal)


class _LimitDepths(Op):
    @staticmethod
    def forward(ctx: Context, ids: torch.Tensor, depths: torch.Tensor, *limits: torch.Tensor) -> torch.Tensor:
        limited = torch.empty_like(depths)
        launch(depths, kernels.limit_depths, depths.numel(), [ids, depths, *limits], [limited])
        ctx.save_for_backward(depths, limited)
        return limited

    @staticmethod
    def backward(ctx: Context, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        depths, limited = ctx.saved_tensors
        return None, grad.where(depths == limited, 0.0), None, None, None
