"""The losses of the paper that compare images, as sums over whole images."""

import torch


def window() -> torch.Tensor:
    """(11, 11) Gaussian of sigma 1.5 that sums to 1."""
    offset = torch.arange(-5.0, 6.0, dtype=torch.float64)
    values = torch.exp(-(offset[:, None].square() + offset.square()) / (2 * 1.5**2))
    return values / values.sum()


def blur(image: torch.Tensor) -> torch.Tensor:
    """Weighted mean of the 11 x 11 pixels about each pixel of (H, W, 3), zeros outside."""
    kernel = window().to(image)[None, None]
    return torch.nn.functional.conv2d(image.permute(2, 0, 1)[:, None], kernel, padding=5)[:, 0].permute(1, 2, 0)


def dssim(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """One minus the mean of SSIM over pixels and channels of (H, W, 3) images."""
    mean_x, mean_y = blur(image), blur(target)
    variance_x, variance_y = blur(image.square()) - mean_x.square(), blur(target.square()) - mean_y.square()
    covariance = blur(image * target) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + 0.01**2) / (mean_x.square() + mean_y.square() + 0.01**2)
    structure = (2 * covariance + 0.03**2) / (variance_x + variance_y + 0.03**2)
    return 1 - (luminance * structure).mean()


def l1(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean absolute difference of (H, W, 3) images."""
    return (image - target).abs().mean()


def texture(textured: torch.Tensor, weights: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """L1 of the texture, `textured` (H, W, 3) over the sum of `weights` (H, W, K), against `target` (H, W, 3)."""
    return l1(textured / (weights.sum(-1, keepdim=True) + 1e-6), target)


def alpha(weights: torch.Tensor) -> torch.Tensor:
    """Mean weight that (H, W, K) `weights` leave to something else."""
    return (1 - weights.sum(-1)).mean()
