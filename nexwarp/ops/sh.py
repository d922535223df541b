"""Plain colours of surfels from spherical harmonics."""

from typing import Any

import torch
from torch.autograd.function import once_differentiable

from nexwarp.kernels.sh import plain_colors_kernel
from nexwarp.kernels.types import types
from nexwarp.ops._interop import array, grad_like, launch, real_of
from nexwarp.ops.checks import check_tensors


def plain_colors(sh: torch.Tensor, means: torch.Tensor, position: torch.Tensor, degree: int) -> torch.Tensor:
    """Return max(0, 0.5 + SH(direction from the camera to the surfel)); differentiable in every tensor.

    Args:
        sh: (N, C, 3) coefficients, DC first.
        means: (N, 3) world.
        position: (3,) camera centre, world.
        degree: 0 to 3, degree to evaluate; less when `sh` holds less.

    Returns:
        (N, 3) colours.
    """
    check_tensors({"sh": (sh, ("N", "C", 3)), "means": (means, ("N", 3)), "position": (position, (3,))})
    degree = min(degree, round(sh.shape[1] ** 0.5) - 1)
    return _PlainColors.apply(sh.contiguous(), means.contiguous(), position.contiguous(), degree)


class _PlainColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: torch.Tensor, means: torch.Tensor, position: torch.Tensor, degree: int) -> torch.Tensor:
        real = real_of(means)
        vec3 = types(real).vec3
        colors = torch.empty_like(means)
        arrays = [array(x, vec3) for x in (sh, means, position[None])]
        launch(means, plain_colors_kernel(real, degree), len(means), [*arrays, 0], [array(colors, vec3)])
        ctx.save_for_backward(sh, means, position)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_colors: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        sh, means, position = ctx.saved_tensors
        need_sh, need_means, step, _ = ctx.needs_input_grad
        real, count = real_of(means), len(means)
        vec3 = types(real).vec3
        grads = [
            grad_like(sh, need_sh),
            grad_like(means, need_means),
            means.new_zeros(count, 3) if step else None,
        ]
        positions = position.expand(count, 3) if step else position[None]
        launch(
            means,
            plain_colors_kernel(real, ctx.degree),
            count,
            [*(array(x, vec3) for x in (sh, means, positions)), int(step)],
            [None],
            adjoint=([*(array(x, vec3) for x in grads), None], [array(grad_colors.contiguous(), vec3)]),
        )
        return grads[0], grads[1], grads[2].sum(0) if step else None, None
