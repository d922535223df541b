"""World positions of hits and directions of rays."""

import torch
from torch.autograd.function import once_differentiable

from nexwarp.kernels.types import types
from nexwarp.kernels.unproject import unproject_kernel
from nexwarp.ops._interop import Context, array, grad_like, launch, real_of
from nexwarp.ops.pinhole import Pinhole


def unproject(depths: torch.Tensor, viewmat: torch.Tensor, camera: Pinhole) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the world points at the given z-depths along the pixels' rays, and the rays' directions.

    Args:
        depths: (H, W, K) z-depths, world units.
        viewmat: (4, 4) world to camera.
        camera: the image plane.

    Returns:
        (H, W, K, 3) positions, world frame, and (H, W, 3) unit directions, world frame; both
        differentiable with respect to `depths` and `viewmat`.
    """
    return _Unproject.apply(depths.contiguous(), viewmat.contiguous(), camera)


class _Context(Context):
    camera: Pinhole


class _Unproject(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: _Context, depths: torch.Tensor, viewmat: torch.Tensor, camera: Pinhole
    ) -> tuple[torch.Tensor, torch.Tensor]:
        positions = depths.new_empty(*depths.shape, 3)
        directions = depths.new_empty(*depths.shape[:2], 3)
        _launch(depths, viewmat[None], 0, camera, (positions, directions))
        ctx.save_for_backward(depths, viewmat)
        ctx.camera = camera
        ctx.set_materialize_grads(False)
        if not ctx.needs_input_grad[1]:
            # They depend on the camera alone: saves the texture the work of differentiating them.
            ctx.mark_non_differentiable(directions)
        return positions, directions

    @staticmethod
    @once_differentiable
    def backward(
        ctx: _Context, grad_positions: torch.Tensor | None, grad_directions: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        depths, viewmat = ctx.saved_tensors
        need_depths, step, _ = ctx.needs_input_grad
        pixels = depths.shape[0] * depths.shape[1]
        grad_depths = grad_like(depths, need_depths)
        grad_viewmats = viewmat.new_zeros(pixels, 4, 4) if step else None
        viewmats = viewmat.expand(pixels, 4, 4) if step else viewmat[None]
        grads = (grad_positions, None if grad_directions is None else grad_directions.contiguous())
        _launch(depths, viewmats, int(step), ctx.camera, grads, (grad_depths, grad_viewmats))
        return grad_depths, None if grad_viewmats is None else grad_viewmats.sum(0), None


def _rows(depths: torch.Tensor | None) -> torch.Tensor | None:
    return None if depths is None else depths.view(depths.shape[0] * depths.shape[1], depths.shape[2])


def _launch(
    depths: torch.Tensor,
    viewmats: torch.Tensor,
    step: int,
    camera: Pinhole,
    outputs: tuple[torch.Tensor | None, torch.Tensor | None],
    grads: tuple[torch.Tensor | None, torch.Tensor | None] | None = None,
) -> None:
    """Launch forward into `outputs`, or, given `grads` to add to, backward from `outputs`' gradients."""
    real = real_of(depths)
    t = types(real)
    pixels = depths.shape[0] * depths.shape[1]
    K = array(camera.K.contiguous()[None], t.mat33)
    inputs = [array(_rows(depths), real), array(viewmats, t.mat44), step, K, camera.width]
    shapes = ((pixels, depths.shape[2], 3), (pixels, 3))
    arrays = [array(None if x is None else x.view(s), t.vec3) for x, s in zip(outputs, shapes, strict=True)]
    if grads is None:
        launch(depths, unproject_kernel(real), pixels, inputs, arrays)
        return
    adjoint_inputs = [array(_rows(grads[0]), real), array(grads[1], t.mat44), None, None, None]
    launch(depths, unproject_kernel(real), pixels, inputs, [None, None], adjoint=(adjoint_inputs, arrays))
