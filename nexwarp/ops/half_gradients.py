"""Scaling of gradients that are kept in half precision."""

import torch

# Gradients in half precision are scaled, by a power of two, so that the largest incoming one is near this.
HALF_GRADIENT = 64.0


def gradient_scale(grad: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """(1,) power of two that brings the largest gradient near HALF_GRADIENT in half precision; 1 otherwise."""
    if dtype != torch.float16 or grad.numel() == 0:
        return grad.new_ones(1)
    largest = torch.linalg.vector_norm(grad, float("inf")).clamp_min(1e-30)
    return torch.exp2(torch.floor(torch.log2(HALF_GRADIENT / largest))).clamp(2.0**-24, 2.0**60).view(1)
