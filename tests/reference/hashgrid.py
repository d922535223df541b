"""Hash-grid features H(x) (paper Eq. 2), unbounded, down-weighted by Delta (paper Eq. 4)."""

import itertools
import math

import torch

PRIMES = (1, 2654435761, 805459861)


def map_positive(x: torch.Tensor) -> torch.Tensor:
    """Map integers one to one onto the non-negative ones: 2x - 1 for x > 0, else -2x."""
    return torch.where(x > 0, 2 * x - 1, -2 * x)


def hash_corners(corners: torch.Tensor, table_size: int) -> torch.Tensor:
    """Table entries (...) of integer `corners` (..., 3), with uint32 arithmetic done in int64."""
    products = [(map_positive(corners[..., axis]) * prime) & 0xFFFFFFFF for axis, prime in enumerate(PRIMES)]
    return (products[0] ^ products[1] ^ products[2]) & (table_size - 1)


def encode(
    positions: torch.Tensor, depths: torch.Tensor, grid: torch.Tensor, resolutions: torch.Tensor, focal: float
) -> torch.Tensor:
    """Features (n, L * F), level-major.

    Args:
        positions: (n, 3), world units.
        depths: (n,), z-depths > 0 of the positions.
        grid: (L, T, F).
        resolutions: (L,), cells per world unit.
        focal: focal length in pixels.
    """
    features = []
    for table, resolution in zip(grid, resolutions, strict=True):
        scaled = resolution * positions
        lowest = scaled.detach().floor()
        fraction = scaled - lowest
        level = torch.zeros(len(positions), grid.shape[2], dtype=grid.dtype, device=grid.device)
        for corner in itertools.product((0, 1), repeat=3):
            offset = torch.tensor(corner, device=grid.device)
            weight = torch.where(offset == 1, fraction, 1 - fraction).prod(dim=-1)
            level = level + weight[:, None] * table[hash_corners(lowest.long() + offset, grid.shape[1])]
        ratio = focal / (resolution * depths)
        features.append(level * (1 - torch.exp(-ratio.square() / (2 * math.pi)))[:, None])
    return torch.cat(features, dim=-1)
