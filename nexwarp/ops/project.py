"""Projection of surfels into a camera's frame, and its image plane."""

from dataclasses import dataclass

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels import project as kernels
from nexwarp.ops._interop import Context, Op, launch

# Shapes of activated surfels, as `errors.check_tensors` takes them.
GEOMETRY: dict[str, tuple[int | str, ...]] = {
    "means": ("N", 3),
    "quats": ("N", 4),
    "scales": ("N", 2),
    "opacities": ("N",),
    "gammas": ("N", 2),
}


@dataclass(frozen=True)
class Pinhole:
    """The image plane that the passes see: a camera without its pose."""

    K: torch.Tensor  # (3, 3) intrinsics in pixels, on the surfels' device and of their dtype; pixel centres at +0.5
    width: int
    height: int
    near: float  # hits with a z-depth of at most this (world units) are ignored


@dataclass(frozen=True)
class Projection:
    """Surfels in the camera's frame, as the walk along a ray reads them."""

    records: torch.Tensor  # (N, 4, 4), see `nexwarp.kernels.surfel`; differentiable
    centers: torch.Tensor  # (N, 3) centres in the camera frame, world units; they sort
    limits: torch.Tensor  # (N,) what a hit's exponent |u|^(2 g1) + |v|^(2 g2) cannot exceed; only culls


def project(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    gammas: torch.Tensor,
    colors: torch.Tensor,
    viewmat: torch.Tensor,
) -> Projection:
    """Project surfels of plain colours (N, 3) by a world-to-camera matrix (4, 4); differentiable in every argument.

    Quaternions wxyz may have any length; one shorter than 1e-12 is divided by 1e-12. TypeError or ValueError where
    types, shapes or devices do not fit.
    """
    tensors = (means, quats, scales, opacities, gammas, colors, viewmat)
    shapes = GEOMETRY | {"colors": ("N", 3), "viewmat": (4, 4)}
    check_tensors({name: (x, shape) for (name, shape), x in zip(shapes.items(), tensors, strict=True)})
    return Projection(*_Project.apply(*(x.contiguous() for x in tensors)))


class _Project(Op):
    @staticmethod
    def forward(ctx: Context, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        means, *shape, colors, viewmat = inputs
        records = means.new_empty(len(means), 4, 4)
        centers = torch.empty_like(means)
        limits = means.new_empty(len(means))
        launch(means, kernels.project, len(means), [(*shape, means, colors), viewmat], [records, centers, limits])
        ctx.save_for_backward(means, *shape[:2], viewmat)
        ctx.mark_non_differentiable(centers, limits)
        ctx.set_materialize_grads(False)
        return records, centers, limits

    @staticmethod
    def backward(
        ctx: Context, grad_records: torch.Tensor, _centers: None, _limits: None
    ) -> tuple[torch.Tensor | None, ...]:
        means, quats, scales, viewmat = ctx.saved_tensors
        count = len(means)
        grad_means, grad_colors = torch.empty_like(means), torch.empty_like(means)
        grads = (torch.empty_like(quats), torch.empty_like(scales), means.new_empty(count), torch.empty_like(scales))
        # A slot a surfel, then one sum: no contention, and a fixed order.
        grad_viewmats = viewmat.new_empty(count, 4, 4) if ctx.needs_input_grad[6] else None
        inputs = [(quats, scales, None, None, means), viewmat, grad_records.contiguous()]
        outputs = [(*grads, grad_means, grad_colors), grad_viewmats]
        launch(means, kernels.project_backward, count, inputs, outputs)
        grad_viewmat = None if grad_viewmats is None else grad_viewmats.sum(0)
        return grad_means, *grads, grad_colors, grad_viewmat
