"""Surfels as Gaussians for renderers of 3D Gaussian splatting, which linearise the projection at each centre.

The linearisation is accurate for Gaussians that are small compared with their distance. A large surfel therefore
becomes a grid of smaller, overlapping Gaussians in its plane, whose blended alpha approximates the surfel's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.kernels.types import ALPHA_MAX, ALPHA_MIN

SPACING = 1.4  # between neighbouring pieces, in their standard deviations: leaves a ripple below 2 %
MOST_STEPS = 16  # pieces on either side of a surfel's centre, along one axis
FEWEST_STEPS = 3  # a coarser grid would be one Gaussian that is larger than the surfel
MOST_PIECES, PIECES_EACH = 50_000, 16  # in all, and more for each surfel, before grids get coarser
LEVELS = 128  # opacities that grids are fitted for; other opacities scale the nearest grid
FITTING_STEPS = 40
WIDTHS = (1.0, 0.95, 0.9, 0.85, 0.8, 0.75, 0.7)  # candidates of a row of pieces, in standard deviations of the surfel


@dataclass(frozen=True)
class Pieces:
    """M Gaussians: whole surfels first, then pieces of split surfels."""

    ids: torch.Tensor  # (M,) int64, indices of the surfels
    offsets: torch.Tensor  # (M, 2) of the centres along the surfel's two axes, world units
    scales: torch.Tensor  # (M, 2) standard deviations along the two axes, world units
    opacities: torch.Tensor  # (M,)
    whole: int  # number of whole surfels


@torch.no_grad()
def split_large(
    means: torch.Tensor, scales: torch.Tensor, opacities: torch.Tensor, cameras: Sequence[Camera], max_extent: float
) -> Pieces:
    """Split surfels of which a scale is above `max_extent` of their distance to a camera. Gamma is taken as 1.

    Takes centres (N, 3), standard deviations (N, 2) and opacities (N,). Returns the surfels that are small enough, in
    order, then the pieces of the others; where these are very many, in coarser grids.
    """
    limit = means.new_full((len(means),), math.inf)
    for camera in cameras:
        position = camera.position.to(means)
        limit = torch.minimum(limit, max_extent * (means - position).norm(dim=1))
    peak = opacities.clamp(max=ALPHA_MAX)
    level = (peak * LEVELS).round().clamp(1, LEVELS - 1)
    reach = _reach(level / LEVELS)
    wanted = (reach[:, None] * scales / (SPACING * limit[:, None])).ceil().clamp(1, MOST_STEPS)
    wanted = torch.where((scales > limit[:, None]) & (peak >= ALPHA_MIN)[:, None], wanted, 0.0).long()
    most, steps = MOST_STEPS, wanted
    while most > FEWEST_STEPS and int((2 * steps + 1).prod(dim=1).sum()) > MOST_PIECES + PIECES_EACH * len(steps):
        most -= 1
        steps = wanted.clamp(max=most)
    whole = (steps == 0).all(dim=1)
    ids = [whole.nonzero()[:, 0]]
    offsets, sizes, alphas = [means.new_zeros(len(ids[0]), 2)], [scales[whole]], [opacities[whole]]
    large = (~whole).nonzero()[:, 0]
    kinds, kind = torch.unique(torch.cat([steps[large], level[large, None].long()], dim=1), dim=0, return_inverse=True)
    for index, (across, along, grade) in enumerate(kinds.tolist()):
        members = large[kind == index]
        grid, size, alpha = (x.to(means) for x in _grid(across, along, grade))
        ids.append(members.repeat_interleave(len(grid)))
        offsets.append((scales[members, None] * grid).flatten(0, 1))
        sizes.append((scales[members, None] * size).expand(-1, len(grid), 2).flatten(0, 1))
        alphas.append((peak[members, None] * LEVELS / grade * alpha).clamp(max=ALPHA_MAX).flatten())
    return Pieces(torch.cat(ids), torch.cat(offsets), torch.cat(sizes), torch.cat(alphas), len(ids[0]))


def _reach(peak: torch.Tensor) -> torch.Tensor:
    """Return the distance from the centre, in standard deviations, at which a hit's alpha falls to 1/255."""
    return (2 * (peak / ALPHA_MIN).log().clamp(min=0)).sqrt()


@lru_cache(4096)
def _grid(across: int, along: int, level: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Fit `across` pieces on either side of the centre along x, `along` along y, to an opacity of `level` / `LEVELS`.

    Returns centres (P, 2) and standard deviations (2,), in those of the surfel, and opacities (P,).
    """
    peak = torch.tensor(level / LEVELS, dtype=torch.float64)
    reach = float(_reach(peak))
    spacing = [reach / n if n else 0.0 for n in (across, along)]
    steps = [torch.arange(-n, n + 1, dtype=torch.float64) for n in (across, along)]
    grid = torch.cartesian_prod(*steps) * torch.tensor(spacing, dtype=torch.float64)
    grid = grid[_falloff(grid) * peak >= ALPHA_MIN / 2]
    side = torch.linspace(-reach, reach, 41, dtype=torch.float64)
    places = torch.cartesian_prod(side, side)
    wanted = peak * _falloff(places)
    best = math.inf
    # Opaque pieces of a row blend to a profile that is wider than each of them: try narrower pieces.
    for narrower in WIDTHS if 0.0 in spacing else (1.0,):
        candidate = torch.tensor([step / SPACING if step else narrower for step in spacing], dtype=torch.float64)
        fitted = _fitted(grid, candidate, peak)
        falloff = _falloff((places[:, None] - grid) / candidate)
        error = float((1 - (1 - fitted * falloff).prod(1) - wanted).square().mean())
        if error < best:
            best, size, alpha = error, candidate, fitted
    kept = alpha >= ALPHA_MIN
    return grid[kept], size, alpha[kept]


def _falloff(offsets: torch.Tensor) -> torch.Tensor:
    return torch.exp(-0.5 * offsets.square().sum(-1))


def _fitted(grid: torch.Tensor, size: torch.Tensor, peak: torch.Tensor) -> torch.Tensor:
    """Return the opacities (P,) of pieces whose optical depths, -log(1 - alpha), add up to the surfel's."""
    wanted = -torch.log1p(-peak * _falloff(grid))
    falloff = _falloff((grid[:, None] - grid) / size)
    depths = wanted / falloff.sum(1)
    for _ in range(FITTING_STEPS):
        total = -torch.log1p(torch.expm1(-depths) * falloff).sum(1)
        depths = depths * (wanted / total).clamp(0.25, 4.0)
    return -torch.expm1(-depths)
