"""Structural dissimilarity of two images: on a GPU, in float32, a kernel each way; elsewhere torch."""

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels.ssim import C1, C2, REACH, THREADS, WINDOW_SIZE, blocks_of, gradient, score, tap
from nexwarp.ops._interop import Context, Op, launch, real_of


def weighted_dssim(image: torch.Tensor, target: torch.Tensor, factor: float = 1.0) -> torch.Tensor:
    """Return factor * (1 - SSIM) of images (H, W, 3), float32 or float64, the first one clamped to [0, 1].

    Differentiable once, in `image` only. ValueError where `target` requires a gradient, which it would not get.
    """
    check_tensors({"image": (image, ("H", "W", 3)), "target": (target, ("H", "W", 3))})
    real_of(image)
    if target.requires_grad:
        raise ValueError("target: expected a tensor that needs no gradient, got requires_grad=True")
    if image.is_cuda and image.dtype == torch.float32:
        return _KernelDSSIM.apply(image.contiguous(), target.contiguous(), factor)
    return factor * (1.0 - ssim_map(image.clamp(0, 1), target).mean())


def ssim_map(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Return the structural similarity (H, W, C) about each pixel of two images, by torch.

    The formula is that of `nexwarp.kernels.ssim`: an 11 x 11 Gaussian window of sigma 1.5, zeros outside.
    """
    blurred = _blur(torch.cat([x, y, 0.5 * (x * x + y * y), x * y], dim=-1))
    mean_x, mean_y, squares, products = blurred.split(3, dim=-1)
    product = mean_x * mean_y
    square = 0.5 * (mean_x * mean_x + mean_y * mean_y)
    variance = squares - square
    variance = variance + (-variance).clamp_min(0.0).detach()  # rounding can take it below zero
    luminance = (product + C1 / 2) / (square + C1 / 2)
    structure = (products - product + C2 / 2) / (variance + C2 / 2)
    return luminance * structure


def _blur(maps: torch.Tensor) -> torch.Tensor:
    """The window's weighted mean about each pixel of maps (H, W, C), zeros outside."""
    count = maps.shape[-1]
    taps = maps.new_tensor([tap(i) for i in range(WINDOW_SIZE)]).expand(count, 1, WINDOW_SIZE)
    planes = maps.permute(2, 0, 1)[None]
    down = torch.nn.functional.conv2d(planes, taps[..., None], padding=(REACH, 0), groups=count)
    across = torch.nn.functional.conv2d(down, taps[:, :, None], padding=(0, REACH), groups=count)
    return across[0].permute(1, 2, 0)


class _KernelDSSIM(Op):
    @staticmethod
    def forward(ctx: Context, image: torch.Tensor, target: torch.Tensor, factor: float) -> torch.Tensor:
        derivatives = image.new_empty(3, image.numel()) if ctx.needs_input_grad[0] else None
        ctx.rest = factor / image.numel()
        if derivatives is not None:
            ctx.save_for_backward(image, target, derivatives)
        height, width = image.shape[0], 3 * image.shape[1]
        threads = THREADS * blocks_of(height, width)
        losses = image.new_empty(threads // 32)  # one a warp
        inputs = [image, target, height, width, ctx.rest]
        launch(image, score, threads, inputs, [losses, derivatives], block_dim=THREADS)
        return losses.sum()

    @staticmethod
    def backward(ctx: Context, grad_loss: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        image, target, derivatives = ctx.saved_tensors
        height, width = image.shape[0], 3 * image.shape[1]
        grad_image = torch.empty_like(image)
        inputs = [derivatives, image, target, height, width, ctx.rest, grad_loss]
        launch(image, gradient, THREADS * blocks_of(height, width), inputs, [grad_image], block_dim=THREADS)
        return grad_image, None, None
