"""What compares an image with a photo pixel by pixel: several losses in one go, and the photo's exposure."""

import math
from collections.abc import Sequence

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels.photometric import expose_kernels, photometric_kernels
from nexwarp.kernels.types import types
from nexwarp.ops._interop import Argument, Context, array, first_derivative, launch, real_of

Factors = tuple[float, float, float]


def photometric_terms(
    image: torch.Tensor | None,
    textured: torch.Tensor | None,
    weights: torch.Tensor | None,
    target: torch.Tensor | None,
    *,
    l1: float = 0.0,
    texture: float = 0.0,
    alpha: float = 0.0,
    saturation: float | None = None,
) -> tuple[torch.Tensor | None, torch.Tensor | None, torch.Tensor | None]:
    """Return the L1, texture and alpha terms of `nexwarp.train.losses`, each times its factor.

    Differentiable once, with respect to image, textured and weights. What no wanted term reads may be None.

    Args:
        image: (H, W, 3) float32 or float64.
        textured: (H, W, 3), sum_k W T.
        weights: (H, W, K), W.
        target: (H, W, 3).
        l1: factor of the mean of |image - target|.
        texture: factor of the mean of |textured / (sum_k W + 1e-6) - target|.
        alpha: factor of the mean of 1 - sum_k W.
        saturation: a channel of `target` with at least this value equals any brighter one; None compares all values.

    Returns:
        Three scalars; None, at no cost, for a factor of 0.

    Raises:
        ValueError: a shape or device does not fit, or `target` requires a gradient, which it would not get.
    """
    wanted: dict[str, tuple[torch.Tensor | None, tuple[int | str, ...], float]] = {
        "image": (image, ("H", "W", 3), l1),
        "textured": (textured, ("H", "W", 3), texture),
        "weights": (weights, ("H", "W", "K"), texture or alpha),
        "target": (target, ("H", "W", 3), l1 or texture),
    }
    read = {name: (tensor, shape) for name, (tensor, shape, factor) in wanted.items() if factor and tensor is not None}
    if not read:
        return None, None, None
    check_tensors(read)
    if "target" in read and read["target"][0].requires_grad:
        raise ValueError("target: expected a tensor that needs no gradient, got requires_grad=True")
    tensors = [read[name][0].contiguous() if name in read else None for name in wanted]
    return _Photometric.apply((l1, texture, alpha), math.inf if saturation is None else saturation, *tensors)


def _arrays(real: type, tensors: Sequence[torch.Tensor | None]) -> list[Argument]:
    """View image, textured, weights and any more images, (H, W, ...) each, as arrays of pixels."""
    flat = [None if x is None else x.view(x.shape[0] * x.shape[1], x.shape[2]) for x in tensors]
    return [array(x, real if i == 2 else types(real).vec3) for i, x in enumerate(flat)]


class _Context(Context):
    scales: tuple[float, float, float]
    saturation: float


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: _Context, factors: Factors, saturation: float, *tensors: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        like = next(x for x in tensors if x is not None)
        real, pixels = real_of(like), like.shape[0] * like.shape[1]
        ctx.scales = (factors[0] / (3 * pixels), factors[1] / (3 * pixels), factors[2] / pixels)
        ctx.saturation = saturation
        maps = like.new_empty(sum(factor != 0.0 for factor in factors), pixels)
        rows = iter(maps)
        outputs = [array(next(rows), real) if factor else None for factor in factors]
        inputs = [*_arrays(real, tensors), types(real).vec3(*ctx.scales), real(saturation)]
        launch(like, photometric_kernels(real).forward, pixels, inputs, outputs)
        ctx.save_for_backward(*tensors)  # type: ignore[arg-type]  # torch saves None too
        ctx.set_materialize_grads(False)
        sums = iter(maps.sum(1).unbind())
        return tuple(next(sums) if factor else None for factor in factors)

    @staticmethod
    @first_derivative
    def backward(ctx: _Context, *grads: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        tensors = ctx.saved_tensors
        like = next(x for x in tensors if x is not None)
        real, pixels = real_of(like), like.shape[0] * like.shape[1]
        l1, texture, alpha = (grad is not None for grad in grads)
        reached = zip(tensors, ctx.needs_input_grad[2:], (l1, texture, texture or alpha, False), strict=True)
        results = [torch.empty_like(x) if needed and term else None for x, needed, term in reached]
        incoming = [None if grad is None else array(grad.reshape(1), real) for grad in grads]
        inputs = [*_arrays(real, tensors), types(real).vec3(*ctx.scales), real(ctx.saturation), *incoming]
        launch(like, photometric_kernels(real).backward, pixels, inputs, _arrays(real, results[:3]))
        return None, None, *results


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


def _images(real: type, *images: torch.Tensor | None) -> list[Argument]:
    return [array(None if x is None else x.view(-1, 3), types(real).vec3) for x in images]


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
        inputs = [*_images(real, image, textured, exposure, photo), saturation]
        launch(image, expose_kernels(real).forward, photo.numel() // 3, inputs, _images(real, exposed, exposed_colors))
        ctx.save_for_backward(image, exposure, photo)
        ctx.saturation = saturation
        ctx.set_materialize_grads(False)
        return exposed, exposed_colors

    @staticmethod
    @first_derivative
    def backward(
        ctx: _Context, grad_exposed: torch.Tensor | None, grad_exposed_colors: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        image, exposure, photo = ctx.saved_tensors
        real = real_of(image)
        grads = [None if x is None else x.contiguous() for x in (grad_exposed, grad_exposed_colors)]
        results = [None if x is None else torch.empty_like(x) for x in grads]
        inputs = [*_images(real, image, exposure, photo), ctx.saturation, *_images(real, *grads)]
        launch(image, expose_kernels(real).backward, photo.numel() // 3, inputs, _images(real, *results))
        return *results, None, None, None
