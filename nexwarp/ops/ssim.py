"""Structural dissimilarity of two images."""

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from nexwarp.errors import check_tensors
from nexwarp.kernels.ssim import PAD, SIMD_WIDTH, rows_a_thread, ssim_kernels
from nexwarp.kernels.ssim_tiles import THREADS, blocks_of, ssim_tile_kernels
from nexwarp.ops._interop import Argument, Context, array, launch, real_of, uses_simd


def weighted_dssim(image: torch.Tensor, target: torch.Tensor, factor: float = 1.0) -> torch.Tensor:
    """Return factor * (1 - SSIM), see `nexwarp.train.losses.dssim`; differentiable once, with respect to `image` only.

    Args:
        image: (H, W, 3) float32 or float64.
        target: (H, W, 3).
        factor: of the result and of the gradient.

    Raises:
        ValueError: `target` requires a gradient, which it would not get.
    """
    check_tensors({"image": (image, ("H", "W", 3)), "target": (target, ("H", "W", 3))})
    if target.requires_grad:
        raise ValueError("target: expected a tensor that needs no gradient, got requires_grad=True")
    return _DSSIM.apply(image.contiguous(), target.contiguous(), factor)


class _Blocks:
    """How an image's values are shared out among threads, and its arrays of blocks."""

    def __init__(self, image: torch.Tensor) -> None:
        real = real_of(image)
        self.height, self.width = image.shape[0], 3 * image.shape[1]
        self.length = SIMD_WIDTH if uses_simd(image) and self.width >= SIMD_WIDTH else 1
        self.kernels = ssim_kernels(real, self.length)
        self.dtype = wp.types.vector(length=self.length, dtype=real)
        self.padded_size = self.height * (self.width + 2 * PAD)

    def array(self, values: torch.Tensor | None) -> Argument:
        """View (n,) or (M, n) contiguous values as blocks, one at every address: (n - length + 1,) or (M, ...)."""
        return None if values is None else array(values.unfold(-1, self.length, 1), self.dtype)

    def blur_columns(self, kernel: wp.Kernel, *sources: torch.Tensor) -> torch.Tensor:
        """Launch `moments` on two images or `blur` on three maps, (n,) each: (4 or 3, padded_size)."""
        blurred = sources[0].new_empty(4 if len(sources) == 2 else 3, self.padded_size)
        blocks = -(-self.width // self.length) + 2 * PAD // self.length
        groups = -(-self.height // rows_a_thread(self.length))
        inputs = [self.array(sources[i] if i < len(sources) else None) for i in range(3)]
        inputs += [self.height, self.width]
        launch(blurred, kernel, groups * blocks, inputs, [self.array(blurred)], align=blocks, smallest=blocks)
        return blurred

    def blur_rows(
        self, kernel: wp.Kernel, blurred: torch.Tensor, inputs: list[Argument], outputs: list[Argument]
    ) -> None:
        """Launch `score` or `gradient` on what `blur_columns` returned."""
        blocks = -(-self.width // self.length)
        launch(
            blurred,
            kernel,
            self.height * blocks,
            [self.array(blurred), *inputs],
            outputs,
            align=blocks,
            smallest=blocks,
        )


def _score_tiles(
    image: torch.Tensor, target: torch.Tensor, scale: float, derivatives: torch.Tensor | None
) -> torch.Tensor:
    """Return the sum of (1 - s) scale of float32 images on a GPU; write ds/dmx, ds/dq, ds/dp."""
    height, width = image.shape[0], 3 * image.shape[1]
    threads = THREADS * blocks_of(height, width)
    losses = image.new_empty(threads)
    inputs = [*(array(x.view(-1), wp.float32) for x in (image, target)), height, width, scale]
    outputs = [array(losses, wp.float32), array(derivatives, wp.float32)]
    launch(image, ssim_tile_kernels().score, threads, inputs, outputs, block_dim=THREADS)
    return losses.sum()


def _gradient_tiles(
    image: torch.Tensor, target: torch.Tensor, scale: float, derivatives: torch.Tensor, grad_loss: torch.Tensor
) -> torch.Tensor:
    """Return the gradient of what `_score_tiles` returned."""
    height, width = image.shape[0], 3 * image.shape[1]
    gradient = torch.empty_like(image)
    inputs = [array(derivatives, wp.float32), *(array(x.view(-1), wp.float32) for x in (image, target))]
    inputs += [height, width, scale, array(grad_loss.reshape(1), wp.float32)]
    threads, outputs = THREADS * blocks_of(height, width), [array(gradient.view(-1), wp.float32)]
    launch(image, ssim_tile_kernels().gradient, threads, inputs, outputs, block_dim=THREADS)
    return gradient


class _Context(Context):
    scale: float
    tiles: bool


class _DSSIM(torch.autograd.Function):
    @staticmethod
    def forward(ctx: _Context, image: torch.Tensor, target: torch.Tensor, factor: float) -> torch.Tensor:
        derivatives = image.new_empty(3, image.numel()) if ctx.needs_input_grad[0] else None
        ctx.scale = factor / image.numel()
        ctx.tiles = image.is_cuda and image.dtype == torch.float32
        if derivatives is not None:
            ctx.save_for_backward(image, target, derivatives)
        if ctx.tiles:
            return _score_tiles(image, target, ctx.scale, derivatives)
        b = _Blocks(image)
        moments = b.blur_columns(b.kernels.moments, image.view(-1), target.view(-1))
        losses = image.new_empty(image.numel())
        b.blur_rows(b.kernels.score, moments, [b.width, ctx.scale], [b.array(losses), b.array(derivatives)])
        return losses.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: _Context, grad_loss: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        image, target, derivatives = ctx.saved_tensors
        if ctx.tiles:
            return _gradient_tiles(image, target, ctx.scale, derivatives, grad_loss), None, None
        b = _Blocks(image)
        blurred = b.blur_columns(b.kernels.blur, *derivatives)
        gradient = torch.empty_like(image)
        pictures = [b.array(x.view(-1)) for x in (image, target)]
        inputs = [*pictures, b.width, ctx.scale, array(grad_loss.reshape(1), real_of(image))]
        b.blur_rows(b.kernels.gradient, blurred, inputs, [b.array(gradient.view(-1))])
        return gradient, None, None
