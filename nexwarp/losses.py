"""The training losses of the paper's section "Optimization", one function a term, each a scalar tensor.

Images are (H, W, 3) with values in [0, 1] (others are allowed). `weights` (H, W, K) holds the blending
weights W of the K textured hits of each pixel, empty slots 0, and `textured` (H, W, 3) is sum_k W_k T_k.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F

from nexwarp.ops.checks import check_range, check_tensors

WINDOW_SIZE = 11
WINDOW_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
WEIGHT_EPSILON = 1e-6  # keeps the un-premultiplied texture finite where nothing is textured


@dataclass(frozen=True)
class LossWeights:
    """Factors of the terms of the training loss; a term with factor 0 is not computed."""

    dssim: float = 0.2
    """Share of D-SSIM in the image loss; L1 has the rest."""
    alpha: float = 0.005
    """Penalty on blending weight that is not textured."""
    texture: float = 0.5
    """L1 between the un-premultiplied texture and the photograph."""
    opacity: float = 0.01
    """Mean opacity of the surfels, for sparsity."""
    grid: float = 0.01
    """Squared values of the hash grid, each level over its resolution cubed."""

    def __post_init__(self) -> None:
        check_range("dssim", self.dssim, 0.0, 1.0)
        for name in ("alpha", "texture", "opacity", "grid"):
            check_range(name, getattr(self, name), 0.0)


def training_losses(
    *,
    image: torch.Tensor,
    textured: torch.Tensor,
    weights: torch.Tensor,
    target: torch.Tensor,
    opacities: torch.Tensor,
    grid: torch.Tensor | None,
    resolutions: torch.Tensor | None,
    loss_weights: LossWeights,
) -> dict[str, torch.Tensor]:
    """Return the terms of the training loss, already multiplied by their factors: their sum is the loss.

    Args:
        image: (H, W, 3), the rendering with its background.
        textured: (H, W, 3), sum_k W T.
        weights: (H, W, K), W; with K = 0 there is no texture and no alpha term.
        target: (H, W, 3), the photograph.
        opacities: (N,) in [0, 1].
        grid: (L, T, F), hash-grid values; None without a texture: no grid term.
        resolutions: (L,), cells per world unit; may be None when `grid` is.
        loss_weights: the factors; a term whose factor is 0 is neither computed nor returned.

    Returns:
        Term ("l1", "dssim", "texture", "alpha", "opacity", "grid") -> weighted scalar tensor.
    """
    has_slots = weights.shape[-1] > 0
    terms = {
        "l1": (1.0 - loss_weights.dssim, lambda: l1(image, target)),
        "dssim": (loss_weights.dssim, lambda: dssim(image, target)),
        "texture": (loss_weights.texture * has_slots, lambda: texture_loss(textured, weights, target)),
        "alpha": (loss_weights.alpha * has_slots, lambda: alpha_loss(weights)),
        "opacity": (loss_weights.opacity, lambda: opacity_loss(opacities)),
        "grid": (loss_weights.grid * (grid is not None), lambda: grid_loss(grid, resolutions)),
    }
    return {name: factor * term() for name, (factor, term) in terms.items() if factor > 0.0}


def l1(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """L_1: mean absolute difference of two (H, W, 3) images."""
    check_tensors({"image": (image, ("H", "W", 3)), "target": (target, ("H", "W", 3))})
    return F.l1_loss(image, target)


def dssim(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """L_D-SSIM = 1 - SSIM of two (H, W, 3) images; differentiable once, and with respect to `image` only.

    SSIM with a Gaussian window of 11 x 11 pixels and sigma 1.5 on each channel, zeros outside the image
    ("same" padding), C1 = 0.01^2 and C2 = 0.03^2, averaged over all pixels and channels.

    Raises:
        ValueError: `target` requires a gradient, which it would not get.
    """
    check_tensors({"image": (image, ("H", "W", 3)), "target": (target, ("H", "W", 3))})
    if target.requires_grad:
        raise ValueError("target: expected a tensor that needs no gradient, got requires_grad=True")
    return _DSSIM.apply(image, target)


def image_loss(image: torch.Tensor, target: torch.Tensor, weight: float = 0.2) -> torch.Tensor:
    """L_image = (1 - weight) L_1 + weight L_D-SSIM of two (H, W, 3) images."""
    check_range("weight", weight, 0.0, 1.0)
    return (1.0 - weight) * l1(image, target) + weight * dssim(image, target)


def texture_loss(textured: torch.Tensor, weights: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """L_texture: L1 between `target` and the un-premultiplied texture, sum_k W T / (sum_k W + 1e-6).

    Args:
        textured: (H, W, 3), sum_k W T.
        weights: (H, W, K), W.
        target: (H, W, 3).
    """
    image = ("H", "W", 3)
    check_tensors({"textured": (textured, image), "weights": (weights, ("H", "W", "K")), "target": (target, image)})
    return F.l1_loss(textured / (weights.sum(-1, keepdim=True) + WEIGHT_EPSILON), target)


def alpha_loss(weights: torch.Tensor) -> torch.Tensor:
    """L_alpha: mean over the pixels of 1 - sum_k W, for (H, W, K) weights."""
    sizes = check_tensors({"weights": (weights, ("H", "W", "K"))})
    return 1.0 - weights.sum() / (sizes["H"] * sizes["W"])


def opacity_loss(opacities: torch.Tensor) -> torch.Tensor:
    """L_opacity: mean of (N,) opacities."""
    check_tensors({"opacities": (opacities, ("N",))})
    return opacities.mean()


def grid_loss(grid: torch.Tensor, resolutions: torch.Tensor) -> torch.Tensor:
    """L_grid = sum_l sum(H_l^2) / s_l^3. The paper prints H without its square; the square is meant.

    Args:
        grid: (L, T, F), H.
        resolutions: (L,), s in cells per world unit.
    """
    check_tensors({"grid": (grid, ("L", "T", "F")), "resolutions": (resolutions, ("L",))})
    # A norm: its forward pass makes no (L, T, F) temporary, its backward pass only the gradient itself.
    return (torch.linalg.vector_norm(grid, dim=(1, 2)).square() / resolutions**3).sum()


class _DSSIM(torch.autograd.Function):
    """1 - SSIM by hand, in half the time that autograd takes (on a CPU); it runs 30,000 times in a training.

    With mx, my the blurred images, q = blur((x^2 + y^2) / 2) and p = blur(x y), the map of SSIM is
        s = a b / (c d),   a = mx my + C1 / 2,   b = p - mx my + C2 / 2,
        c = (mx^2 + my^2) / 2 + C1 / 2,   d = q - (mx^2 + my^2) / 2 + C2 / 2,
    so that four blurs suffice, and its derivatives are
        ds/dmx = my (b - a) / (c d) + mx (s / d - s / c),   ds/dq = -s / d,   ds/dp = a / (c d).
    The blur is its own adjoint, hence dS/dx = blur(ds/dmx) + x blur(ds/dq) + y blur(ds/dp).
    """

    @staticmethod
    def forward(ctx: Any, image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        moments = image.new_empty(4, 3, *image.shape[:2])
        x, y = moments[0].copy_(image.permute(2, 0, 1)), moments[1].copy_(target.permute(2, 0, 1))
        torch.mul(x, x, out=moments[2]).addcmul_(y, y).mul_(0.5)
        torch.mul(x, y, out=moments[3])
        mx, my, q, p = _blur(moments)
        del moments, x, y

        # From here each line reuses a buffer that has had its day.
        a = mx * my
        c = (mx * mx).addcmul_(my, my).mul_(0.5)
        b = p.sub_(a).add_(C2 / 2)
        d = q.sub_(c).clamp_(min=0.0).add_(C2 / 2)  # rounding can take a variance below zero
        a.add_(C1 / 2)
        c.add_(C1 / 2)
        cd = c * d
        derivatives = image.new_empty(3, *a.shape)
        ds_dmx, ds_dq, ds_dp = derivatives
        torch.div(a, cd, out=ds_dp)
        s = ds_dp * b
        loss = 1.0 - s.mean()
        if ctx.needs_input_grad[0]:
            torch.div(s, d, out=ds_dq)
            torch.sub(ds_dq, s.div_(c), out=ds_dmx).mul_(mx).addcmul_(b.sub_(a).div_(cd), my)
            ds_dq.neg_()
            ctx.save_for_backward(image, target, derivatives)
        return loss

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_loss: torch.Tensor) -> tuple[torch.Tensor, None]:
        image, target, derivatives = ctx.saved_tensors
        dmx, dq, dp = _blur(derivatives).permute(0, 2, 3, 1)
        gradient = torch.addcmul(dmx, dq, image).addcmul_(dp, target).mul_(grad_loss / -image.numel())
        return gradient.contiguous(), None


def _blur(maps: torch.Tensor) -> torch.Tensor:
    """Blur (M, C, H, W) maps with the window, zeros outside.

    Two depthwise 1D convolutions of all maps at once. kornia's separable filter is the same after a copy with
    a zero border (20 % slower on a CPU). Forward and backward of `dssim` at 1600 x 1037 on an H200:
    this 1.7 ms, one 11 x 11 depthwise convolution 2.5, maps as one-channel images or pixels with channels
    last over 4, products with banded matrices 5.6.
    """
    count, channels, height, width = maps.shape
    row = _window(maps.dtype, maps.device).expand(count * channels, 1, 1, WINDOW_SIZE)
    half, planes = WINDOW_SIZE // 2, maps.view(1, count * channels, height, width)
    if maps.device.type == "cpu":  # where channels last convolve twice as fast; on a GPU three times slower
        planes = planes.contiguous(memory_format=torch.channels_last)
    planes = F.conv2d(planes, row, padding=(0, half), groups=count * channels)
    planes = F.conv2d(planes, row.transpose(2, 3), padding=(half, 0), groups=count * channels)
    return planes.view(maps.shape)


@lru_cache(maxsize=8)
def _window(dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """(WINDOW_SIZE,) Gaussian that sums to 1; kept, because making it anew would synchronise with a GPU."""
    offset = torch.arange(WINDOW_SIZE, dtype=torch.float64) - WINDOW_SIZE // 2
    window = torch.exp(-(offset**2) / (2.0 * WINDOW_SIGMA**2))
    return (window / window.sum()).to(device, dtype)
