"""Limits of detail: surfels and depths of texture look-ups for cameras that are not where training views were."""

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels.detail import antialias_kernels, limit_depths_kernel
from nexwarp.ops._interop import Context, first_derivative, launch, needed, real_of
from nexwarp.ops.activate import parameters


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


class _Antialias(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Context, farthest: torch.Tensor, focal: torch.Tensor, depths: torch.Tensor, *shape: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        blurred = tuple(torch.empty_like(x) for x in shape)
        inputs = [depths, parameters(None, *shape), farthest, focal]
        kernel = antialias_kernels(real_of(farthest)).forward
        launch(farthest, kernel, len(farthest), inputs, [parameters(None, *blurred)])
        ctx.save_for_backward(farthest, focal, depths, *shape)
        return blurred

    @staticmethod
    @first_derivative
    def backward(ctx: Context, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        farthest, focal, depths, *shape = ctx.saved_tensors
        grad_depths, *grad_shape = (torch.empty_like(x) for x in (depths, *shape))
        inputs = [depths, parameters(None, *shape), farthest, focal, parameters(None, *grads)]
        kernel = antialias_kernels(real_of(farthest)).backward
        launch(farthest, kernel, len(farthest), inputs, [grad_depths, parameters(None, *grad_shape)])
        return needed((None, None, grad_depths, *grad_shape), ctx.needs_input_grad)


def limit_depths(
    ids: torch.Tensor,
    depths: torch.Tensor,
    nearest: torch.Tensor,
    farthest: torch.Tensor,
    focal: float | torch.Tensor,
) -> torch.Tensor:
    """Clamp depths to at most focal * farthest, then to at least focal * nearest; differentiable in depths.

    Args:
        ids: (H, W, K) int32 surfels of the hits, -1 in empty slots, whose depths stay.
        depths: (H, W, K) z-depths of the hits, world units.
        nearest: (N,) smallest depth / focal, world units.
        farthest: (N,) largest depth / focal.
        focal: in pixels, a number or a tensor (1,) on the device.
    """
    focal = focal.to(depths) if isinstance(focal, torch.Tensor) else depths.new_full((1,), float(focal))
    return _LimitDepths.apply(ids, depths.contiguous(), nearest.contiguous(), farthest.contiguous(), focal)


class _LimitDepths(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Context, ids: torch.Tensor, depths: torch.Tensor, *limits: torch.Tensor) -> torch.Tensor:
        limited = torch.empty_like(depths)
        kernel = limit_depths_kernel(real_of(depths))
        launch(depths, kernel, depths.numel(), [ids, depths, *limits], [limited])
        ctx.save_for_backward(depths, limited)
        return limited

    @staticmethod
    @first_derivative
    def backward(ctx: Context, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        depths, limited = ctx.saved_tensors
        return None, grad.where(depths == limited, 0.0), None, None, None
