"""Rendering to the exposure of the photo that it is compared with."""

import torch
from torch.autograd.function import once_differentiable

from nexwarp.errors import check_tensors
from nexwarp.kernels.expose import expose_kernels
from nexwarp.kernels.types import types
from nexwarp.ops._interop import Argument, Context, array, launch, real_of


def expose(
    image: torch.Tensor, textured: torch.Tensor, exposure: torch.Tensor, photo: torch.Tensor, saturation: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return image and textured at an exposure: multiply them, and clip the image where the photo is clipped.

    Where a channel of the photo is saturated, a brighter image equals it: it has no error and no gradient there.
    Differentiable once, with respect to image and textured.

    Args:
        image: (H, W, 3) float32 or float64.
        textured: (H, W, 3), sum_k W T.
        exposure: (3,) or (H, W, 3) gains times falloff.
        photo: (H, W, 3).
        saturation: a channel of `photo` with at least this value is saturated.

    Raises:
        ValueError: a shape or device does not fit, or `exposure` or `photo` requires a gradient that it would not get.
    """
    shape = ("H", "W", 3)
    there = {"image": (image, shape), "textured": (textured, shape), "photo": (photo, shape)}
    check_tensors(there | {"exposure": (exposure, shape[-exposure.ndim :])}, dtype=image.dtype, device=image.device)
    for name, x in (("exposure", exposure), ("photo", photo)):
        if x.requires_grad:
            raise ValueError(f"{name}: expected a tensor that needs no gradient, got requires_grad=True")
    return _Expose.apply(*(x.contiguous() for x in (image, textured, exposure, photo)), saturation)


def _arrays(real: type, *images: torch.Tensor | None) -> list[Argument]:
    return [array(None if x is None else x.view(-1, 3), types(real).vec3) for x in images]


class _Context(Context):
    saturation: float


class _Expose(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: _Context,
        image: torch.Tensor,
        textured: torch.Tensor,
        exposure: torch.Tensor,
        photo: torch.Tensor,
        saturation: float,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        real = real_of(image)
        exposed, exposed_colors = torch.empty_like(image), torch.empty_like(textured)
        inputs = [*_arrays(real, image, textured, exposure, photo), saturation]
        launch(image, expose_kernels(real).forward, photo.numel() // 3, inputs, _arrays(real, exposed, exposed_colors))
        ctx.save_for_backward(image, exposure, photo)
        ctx.saturation = saturation
        ctx.set_materialize_grads(False)
        return exposed, exposed_colors

    @staticmethod
    @once_differentiable
    def backward(
        ctx: _Context, grad_exposed: torch.Tensor | None, grad_exposed_colors: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        image, exposure, photo = ctx.saved_tensors
        real = real_of(image)
        grads = [None if x is None else x.contiguous() for x in (grad_exposed, grad_exposed_colors)]
        results = [None if x is None else torch.empty_like(x) for x in grads]
        inputs = [*_arrays(real, image, exposure, photo), ctx.saturation, *_arrays(real, *grads)]
        launch(image, expose_kernels(real).backward, photo.numel() // 3, inputs, _arrays(real, *results))
        return *results, None, None, None
