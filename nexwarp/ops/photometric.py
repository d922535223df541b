"""What compares pixel by pixel: several losses of an image and a photo in one go, its exposure, and depths."""

import math

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels import photometric as kernels
from nexwarp.kernels.types import types
from nexwarp.ops._interop import Context, Op, contiguous, launch, real_of

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

    They are the means of |image - target|, of |textured / (sum_k W + 1e-6) - target| and of 1 - sum_k W, with image,
    textured and target (H, W, 3) and weights W (H, W, K), float32 or float64; the image is clamped to [0, 1].
    Differentiable once, with respect to image, textured and weights; ValueError where `target` requires a gradient.
    What no wanted term reads may be None; a factor of 0 gives None, at no cost. A channel of `target` with at least
    the value `saturation` equals any brighter one.
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


def _warp_sums(like: torch.Tensor, rows: int, count: int) -> tuple[torch.Tensor, int]:
    """Room for sums (rows, warps) over the warps of `count` threads or a few more, and how many threads these are."""
    warp = 32 if like.is_cuda else 1
    return like.new_empty(rows, -(-count // warp)), -(-count // warp) * warp


class _Photometric(Op):
    @staticmethod
    def forward(
        ctx: Context, factors: Factors, saturation: float, *tensors: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        like = next(x for x in tensors if x is not None)
        real, pixels = real_of(like), like.shape[0] * like.shape[1]
        scales = types(real).vec3(factors[0] / (3 * pixels), factors[1] / (3 * pixels), factors[2] / pixels)
        sums, threads = _warp_sums(like, 3, pixels)
        launch(like, kernels.photometric, threads, [tensors, scales, saturation, pixels], [sums])
        ctx.save_for_backward(*tensors)
        ctx.rest = scales, saturation
        ctx.set_materialize_grads(False)
        return tuple(term if factor else None for term, factor in zip(sums.sum(1).unbind(), factors, strict=True))

    @staticmethod
    def backward(ctx: Context, *grads: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        tensors = ctx.saved_tensors
        like = next(x for x in tensors if x is not None)
        l1, texture, alpha = (grad is not None for grad in grads)
        reached = zip(tensors, ctx.needs_input_grad[2:], (l1, texture, texture or alpha, False), strict=True)
        results = [torch.empty_like(x) if needed and term else None for x, needed, term in reached]
        inputs, pixels = [tensors, *ctx.rest, *grads], like.shape[0] * like.shape[1]
        launch(like, kernels.photometric_backward, pixels, inputs, [tuple(results)])
        return None, None, *results


def expose(
    image: torch.Tensor, textured: torch.Tensor, exposure: torch.Tensor, photo: torch.Tensor, saturation: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return image and textured at an exposure: multiply them, and clip the image where the photo is clipped.

    Where a channel of the photo is saturated, at least `saturation`, a brighter image equals it: it has no error and no
    gradient there. Images are (H, W, 3), float32 or float64, `exposure` (3,) or (H, W, 3). Differentiable once, with
    respect to image and textured; ValueError where `exposure` or `photo` requires a gradient.
    """
    shape = ("H", "W", 3)
    there = {"image": (image, shape), "textured": (textured, shape), "photo": (photo, shape)}
    check_tensors(there | {"exposure": (exposure, shape[-exposure.ndim :])}, dtype=image.dtype, device=image.device)
    for name, x in (("exposure", exposure), ("photo", photo)):
        if x.requires_grad:
            raise ValueError(f"{name}: expected a tensor that needs no gradient, got requires_grad=True")
    return _Expose.apply(saturation, *contiguous(image, textured, exposure, photo))


class _Expose(Op):
    @staticmethod
    def forward(ctx: Context, saturation: float, *tensors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        image, textured, exposure, photo = tensors
        exposed, exposed_colors = torch.empty_like(image), torch.empty_like(textured)
        launch(image, kernels.expose, photo.numel() // 3, [*tensors, saturation], [exposed, exposed_colors])
        ctx.save_for_backward(image, exposure, photo)
        ctx.rest = saturation
        ctx.set_materialize_grads(False)
        return exposed, exposed_colors

    @staticmethod
    def backward(
        ctx: Context, grad_exposed: torch.Tensor | None, grad_exposed_colors: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        image, exposure, photo = ctx.saved_tensors
        grads = contiguous(grad_exposed, grad_exposed_colors)
        results = [None if x is None else torch.empty_like(x) for x in grads]
        inputs = [image, exposure, photo, ctx.rest, *grads]
        launch(image, kernels.expose_backward, photo.numel() // 3, inputs, results)
        return None, *results, None, None


def depth_term(
    depths: torch.Tensor,
    weights: torch.Tensor,
    expected: torch.Tensor,
    places: torch.Tensor | None = None,
    *,
    factor: float = 1.0,
) -> torch.Tensor:
    """Return factor times the mean of |mean depth of a pixel's hits / expected depth - 1| over known expected depths.

    No error has a larger gradient than another. Differentiable once, with respect to depths and weights; the same bits
    in any order of threads.

    Args:
        depths: (H, W, K) z-depths of the textured hits, world units.
        weights: (H, W, K), W.
        expected: z-depths (H, W), or (M,) of points in the pixels `places`; 0 where unknown, which does not count.
        places: (M,) int64, row * W + column, ascending; those beyond the image have the expected depth 0.
        factor: of the mean, which is 0 without any known depth.
    """
    shape: tuple[int | str, ...] = ("H", "W") if places is None else ("M",)
    hits = ("H", "W", "K")
    check_tensors({"depths": (depths, hits), "weights": (weights, hits), "expected": (expected, shape)})
    return _DepthTerm.apply(factor, *contiguous(depths, weights, expected, places))


class _DepthTerm(Op):
    @staticmethod
    def forward(ctx: Context, factor: float, *tensors: torch.Tensor | None) -> torch.Tensor:
        depths, _weights, expected, _places = tensors
        assert depths is not None and expected is not None
        sums, threads = _warp_sums(depths, 2, expected.numel())
        launch(depths, kernels.depth_errors, threads, [*tensors, factor], [sums])
        totals = sums.sum(1)
        ctx.save_for_backward(*tensors, totals)
        ctx.rest = factor
        return totals[0] / totals[1].clamp_min(1)

    @staticmethod
    def backward(ctx: Context, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        *tensors, totals = ctx.saved_tensors
        grads = [torch.empty_like(x) for x in tensors[:2]]
        inputs, pixels = [*tensors, ctx.rest, totals, grad], grads[0].shape[0] * grads[0].shape[1]
        launch(totals, kernels.depth_errors_backward, pixels, inputs, grads)
        return None, *grads, None, None
