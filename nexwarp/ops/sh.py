"""Plain colours of surfels from spherical harmonics."""

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels.sh import plain_colors_kernels
from nexwarp.kernels.types import types
from nexwarp.ops._interop import Context, array, first_derivative, launch, real_of


def plain_colors(
    sh: torch.Tensor | tuple[torch.Tensor, torch.Tensor], means: torch.Tensor, position: torch.Tensor, degree: int
) -> torch.Tensor:
    """Return max(0, 0.5 + SH(direction from the camera to the surfel)); differentiable in every tensor.

    Args:
        sh: (N, C, 3) coefficients, DC first; or sh0 (N, 1, 3) and shN (N, C - 1, 3) apart, which spares a copy. Those
            above `degree` are not read and get zero gradients.
        means: (N, 3) world.
        position: (3,) camera centre, world.
        degree: 0 to 3, degree to evaluate; less when C is less.

    Returns:
        (N, 3) colours.

    Raises:
        TypeError, ValueError: naming the argument, when types, shapes or devices do not fit.
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
    degree = min(degree, round((shN.shape[1] + 1) ** 0.5) - 1)
    return _PlainColors.apply(*(x.contiguous() for x in (sh0, shN, means, position)), degree)


class _Context(Context):
    degree: int


class _PlainColors(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: _Context, sh0: torch.Tensor, shN: torch.Tensor, means: torch.Tensor, position: torch.Tensor, degree: int
    ) -> torch.Tensor:
        real = real_of(means)
        vec3 = types(real).vec3
        colors = torch.empty_like(means)
        inputs = [array(x, vec3) for x in (sh0, shN, means, position[None])]
        launch(means, plain_colors_kernels(real, degree).forward, len(means), inputs, [array(colors, vec3)])
        ctx.save_for_backward(shN, means, position, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @first_derivative
    def backward(ctx: _Context, grad_colors: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        shN, means, position, colors = ctx.saved_tensors
        need_sh0, need_shN, need_means, need_position, _ = ctx.needs_input_grad
        real, count = real_of(means), len(means)
        vec3 = types(real).vec3
        kernels = plain_colors_kernels(real, ctx.degree)
        seen = [array(x, vec3) for x in (means, position[None], colors, grad_colors.contiguous())]
        grad_sh0 = grad_shN = grad_means = grad_position = None
        if need_sh0 or need_shN:
            grad_sh0, grad_shN = shN.new_empty(count, 1, 3), torch.empty_like(shN)
            # Memory is what counts on CUDA, arithmetic on a CPU.
            sharing = 1 if means.device.type == "cpu" else shN.shape[1] + 1
            outputs = [array(x, vec3) for x in (grad_sh0, grad_shN)]
            launch(means, kernels.coefficients_backward, count * sharing, [sharing, *seen], outputs)
        if need_means or need_position:
            grad_means = torch.empty_like(means)
            launch(means, kernels.rays_backward, count, [array(shN, vec3), *seen], [array(grad_means, vec3)])
            # A ray is the surfel's centre minus the camera's.
            grad_position = -grad_means.sum(0) if need_position else None
        grads = (grad_sh0, grad_shN, grad_means, grad_position)
        return (*(x if need else None for x, need in zip(grads, ctx.needs_input_grad, strict=False)), None)
