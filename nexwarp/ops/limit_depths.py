"""Depths for the texture's down-weighting, limited to what training views saw."""

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from nexwarp.kernels.limit_depths import limit_depths_kernel
from nexwarp.ops._interop import Context, array, launch, real_of


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
        real = real_of(depths)
        limited = torch.empty_like(depths)
        inputs = [array(ids.view(-1), wp.int32), *(array(x, real) for x in (depths.view(-1), *limits))]
        launch(depths, limit_depths_kernel(real), depths.numel(), inputs, [array(limited.view(-1), real)])
        ctx.save_for_backward(depths, limited)
        return limited

    @staticmethod
    @once_differentiable
    def backward(ctx: Context, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        depths, limited = ctx.saved_tensors
        return None, grad.where(depths == limited, 0.0), None, None, None
