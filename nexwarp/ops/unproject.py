"""World positions of hits and directions of rays."""

import torch

from nexwarp.kernels import unproject as kernels
from nexwarp.ops._interop import Context, Op, contiguous, launch
from nexwarp.ops.project import Pinhole


def unproject(
    depths: torch.Tensor, viewmat: torch.Tensor, camera: Pinhole, factors: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the points (H, W, K, 3) at z-depths (H, W, K) along the pixels' rays, and the rays' directions (H, W, 3).

    Points and unit directions are in the world frame, depths in world units, which `factors` (H, W, K) multiply, if
    given; `viewmat` (4, 4) is world to camera. Both are differentiable with respect to `depths` and `viewmat`.
    """
    return _Unproject.apply(*contiguous(depths, viewmat, factors), camera)


class _Unproject(Op):
    @staticmethod
    def forward(
        ctx: Context, depths: torch.Tensor, viewmat: torch.Tensor, factors: torch.Tensor | None, camera: Pinhole
    ) -> tuple[torch.Tensor, torch.Tensor]:
        positions = depths.new_empty(*depths.shape, 3)
        directions = depths.new_empty(*depths.shape[:2], 3)
        inputs = [depths, factors, viewmat, camera.K.contiguous(), camera.width]
        pixels = depths.shape[0] * depths.shape[1]
        launch(depths, kernels.unproject, pixels, inputs, [positions, directions])
        ctx.save_for_backward(depths, factors, viewmat)
        ctx.rest = camera
        ctx.set_materialize_grads(False)
        if not ctx.needs_input_grad[1]:
            # They depend on the camera alone: saves the texture the work of differentiating them.
            ctx.mark_non_differentiable(directions)
        return positions, directions

    @staticmethod
    def backward(
        ctx: Context, grad_positions: torch.Tensor | None, grad_directions: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        depths, factors, viewmat = ctx.saved_tensors
        need_depths, need_viewmat, *_ = ctx.needs_input_grad
        camera, pixels = ctx.rest, depths.shape[0] * depths.shape[1]
        grad_depths = torch.empty_like(depths) if need_depths else None
        # A slot a pixel, then one sum: no contention, and a fixed order.
        grad_viewmats = viewmat.new_empty(pixels, 4, 4) if need_viewmat else None
        if grad_positions is not None and grad_positions.stride(-1) != 1:  # rows may be apart, as the texture's are
            grad_positions = grad_positions.contiguous()
        arguments = [depths, factors, viewmat, camera.K.contiguous(), camera.width]
        inputs = [*arguments, grad_positions, *contiguous(grad_directions)]
        launch(depths, kernels.unproject_backward, pixels, inputs, [grad_depths, grad_viewmats])
        return grad_depths, None if grad_viewmats is None else grad_viewmats.sum(0), None, None
