"""Composition of the passes into one image."""

import torch

from nexwarp.kernels import compose as kernels
from nexwarp.ops._interop import Context, Op, contiguous, launch


def compose(
    plain: torch.Tensor,
    colors: torch.Tensor,
    weights: torch.Tensor,
    alpha: torch.Tensor,
    background: torch.Tensor,
    base: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Add up the passes (paper Eq. 7); differentiable in every argument.

    Return image = plain + textured + (1 - alpha) background and textured = base + sum_k weights_k colors_k, (H, W, 3)
    as plain and base are; colors (H, W, K, 3), weights (H, W, K), alpha (H, W), background (3,).
    """
    return _Compose.apply(*contiguous(plain, base, colors, weights, alpha, background))


class _Compose(Op):
    @staticmethod
    def forward(ctx: Context, plain: torch.Tensor, *rest: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        _base, colors, weights, alpha, background = rest
        image, textured = torch.empty_like(plain), torch.empty_like(plain)
        launch(plain, kernels.compose, alpha.numel(), [(plain, *rest)], [image, textured])
        ctx.save_for_backward(colors, weights, alpha, background)
        ctx.set_materialize_grads(False)
        return image, textured

    @staticmethod
    def backward(
        ctx: Context, grad_image: torch.Tensor | None, grad_textured: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        colors, weights, alpha, background = ctx.saved_tensors
        need_plain, *needed, need_background = ctx.needs_input_grad
        shapes = ((*alpha.shape, 3), colors.shape, weights.shape, alpha.shape)
        grads = [weights.new_empty(s) if need else None for s, need in zip(shapes, needed, strict=True)]
        inputs = [(None, None, colors, weights, None, background), *contiguous(grad_image, grad_textured)]
        launch(weights, kernels.compose_backward, alpha.numel(), inputs, [(None, *grads)])
        plain = grad_image if need_plain else None
        # One colour for all pixels: torch's sum instead of every thread adding to one place.
        if not need_background or grad_image is None:
            return (plain, *grads, None)
        return (plain, *grads, (grad_image * (1 - alpha)[..., None]).sum((0, 1)))
