"""Losses of the paper by themselves, of which training has only the sum."""

import torch

from nexwarp.ops.photometric import photometric_terms
from tests.narrowing import present


def texture_loss(textured: torch.Tensor, weights: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """L1 between `target` (H, W, 3) and the un-premultiplied texture, sum_k W T / (sum_k W + 1e-6)."""
    return present(photometric_terms(None, textured, weights, target, texture=1.0)[1])


def l1(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean absolute difference of two (H, W, 3) images."""
    return present(photometric_terms(image, None, None, target, l1=1.0)[0])


def alpha_loss(weights: torch.Tensor) -> torch.Tensor:
    """Mean over the pixels of 1 - sum_k W, for (H, W, K) weights."""
    return present(photometric_terms(None, None, weights, None, alpha=1.0)[2])
