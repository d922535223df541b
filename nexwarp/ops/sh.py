"""Plain colours of surfels from spherical harmonics."""

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels import sh as kernels
from nexwarp.ops._interop import Context, Op, launch


def plain_colors(
    sh: torch.Tensor | tuple[torch.Tensor, torch.Tensor], means: torch.Tensor, position: torch.Tensor, degree: int
) -> torch.Tensor:
    """Return colours (N, 3), max(0, 0.5 + SH(direction from the camera to the surfel)); differentiable in every tensor.

    `sh` are coefficients (N, C, 3), DC first; or sh0 (N, 1, 3) and shN (N, C - 1, 3) apart, which spares a copy. Those
    above `degree`, 0 to 3, are not read and get zero gradients. Means (N, 3) and the camera's position (3,) are in the
    world. TypeError or ValueError where types, shapes or devices do not fit.
    """
    if isinstance(sh, torch.Tensor):
        check_tensors({"sh": (sh, ("N", "C", 3))})
        sh = (sh[:, :1], sh[:, 1:])
    sh0, shN = sh
    check_tensors(
        {
            "sh0": (sh0, ("N", 1, 3)),
            "shN": (shN, ("N", "C - 1", 3)),
            "means": (means, ("N", 3)),
            "position": (position, (3,)),
        }
    )
    count = min((degree + 1) ** 2, shN.shape[1] + 1)
    return _PlainColors.apply(*(x.contiguous() for x in (sh0, shN, means, position)), count)


class _PlainColors(Op):
    @staticmethod
    def forward(
        ctx: Context, sh0: torch.Tensor, shN: torch.Tensor, means: torch.Tensor, position: torch.Tensor, count: int
    ) -> torch.Tensor:
        colors = torch.empty_like(means)
        launch(means, kernels.plain_colors, len(means), [count, sh0, shN, means, position], [colors])
        ctx.save_for_backward(shN, means, position, colors)
        ctx.rest = count
        return colors

    @staticmethod
    def backward(ctx: Context, grad_colors: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        shN, means, position, colors = ctx.saved_tensors
        need_sh0, need_shN, need_means, need_position, _ = ctx.needs_input_grad
        surfels, count, seen = len(means), ctx.rest, [means, position, colors, grad_colors.contiguous()]
        grad_sh0 = grad_shN = grad_means = grad_position = None
        if need_sh0 or need_shN:
            grad_sh0, grad_shN = shN.new_empty(surfels, 1, 3), torch.empty_like(shN)
            # Memory is what counts on CUDA, arithmetic on a CPU.
            sharing = 1 if means.device.type == "cpu" else shN.shape[1] + 1
            inputs, outputs = [count, sharing, *seen], [grad_sh0, grad_shN]
            launch(means, kernels.plain_coefficients_backward, surfels * sharing, inputs, outputs)
        if need_means or need_position:
            grad_means = torch.empty_like(means)
            launch(means, kernels.plain_rays_backward, surfels, [count, shN, *seen], [grad_means])
            # A ray is the surfel's centre minus the camera's.
            grad_position = -grad_means.sum(0) if need_position else None
        return grad_sh0, grad_shN, grad_means, grad_position, None
