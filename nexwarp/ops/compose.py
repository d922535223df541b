"""Composition of the passes into one image."""

import torch

from nexwarp.kernels.compose import compose_kernels
from nexwarp.kernels.types import types
from nexwarp.ops._interop import Argument, Context, array, first_derivative, launch, real_of


def compose(
    plain: torch.Tensor,
    colors: torch.Tensor,
    weights: torch.Tensor,
    alpha: torch.Tensor,
    background: torch.Tensor,
    base: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Add up the passes (paper Eq. 7); differentiable in every argument.

    Args:
        plain: (H, W, 3) colour of the hits outside the buffer.
        colors: (H, W, K, 3) colours of the hits in the buffer.
        weights: (H, W, K) their weights.
        alpha: (H, W).
        background: (3,).
        base: (H, W, 3) what `colors` are added to, once blended; None where they stand alone.

    Returns:
        (H, W, 3) image = plain + textured + (1 - alpha) background, and (H, W, 3) textured = base + sum_k weight_k
        colour_k.
    """
    inputs = (plain, base, colors, weights, alpha, background)
    return _Compose.apply(*(None if x is None else x.contiguous() for x in inputs))


def _arrays(real: type, images: list[torch.Tensor | None]) -> list[Argument]:
    """View images (H, W, ...) as the kernels do, one row a pixel; the background is an image of one."""
    vec3 = types(real).vec3
    dtypes = (vec3, vec3, vec3, real, real, vec3)
    return [array(None if x is None else x.flatten(0, 1), dtype) for x, dtype in zip(images, dtypes, strict=True)]


class _Compose(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Context,
        plain: torch.Tensor,
        base: torch.Tensor | None,
        colors: torch.Tensor,
        weights: torch.Tensor,
        alpha: torch.Tensor,
        background: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        real, pixels = real_of(plain), plain.shape[0] * plain.shape[1]
        image, textured = torch.empty_like(plain), torch.empty_like(plain)
        outputs = [array(x.view(-1, 3), types(real).vec3) for x in (image, textured)]
        inputs = _arrays(real, [plain, base, colors, weights, alpha, background[None, None]])
        launch(plain, compose_kernels(real).forward, pixels, inputs, outputs)
        ctx.save_for_backward(colors, weights, alpha, background)
        ctx.set_materialize_grads(False)
        return image, textured

    @staticmethod
    @first_derivative
    def backward(
        ctx: Context, grad_image: torch.Tensor | None, grad_textured: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        colors, weights, alpha, background = ctx.saved_tensors
        if grad_image is None and grad_textured is None:
            return (None,) * 6
        need_plain, *needed, need_background = ctx.needs_input_grad
        real = real_of(weights)
        shapes = ((*alpha.shape, 3), colors.shape, weights.shape, alpha.shape)
        grads = [weights.new_empty(s) if need else None for s, need in zip(shapes, needed, strict=True)]
        signals = [None if x is None else x.contiguous() for x in (grad_image, grad_textured)]
        _, _, *inputs = _arrays(real, [None, None, colors, weights, None, background[None, None]])
        incoming = [array(None if x is None else x.view(-1, 3), types(real).vec3) for x in signals]
        _, *outputs, _ = _arrays(real, [None, *grads, None])
        launch(weights, compose_kernels(real).backward, alpha.numel(), [*inputs[:2], inputs[3], *incoming], outputs)
        plain = grad_image if need_plain else None
        # One colour for all pixels: torch's sum instead of every thread adding to one place.
        if not need_background or grad_image is None:
            return (plain, *grads, None)
        return (plain, *grads, (grad_image * (1 - alpha)[..., None]).sum((0, 1)))
