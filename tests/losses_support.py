"""A loss of the paper by itself, of which training has only the sum."""

import torch

from nexwarp.ops.photometric import photometric_terms
from tests.narrowing import present


def texture_loss(textured: torch.Tensor, weights: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """L1 between `target` (H, W, 3) and the un-premultiplied texture, sum_k W T / (sum_k W + 1e-6)."""
    return present(photometric_terms(None, textured, weights, target, texture=1.0)[1])
