"""Colours of surfels in directions that no photo looked from: smooth, at a small cost in those that photos have.

A surfel's spherical harmonics are learnt from the directions that photos have of it, often few and close to each other.
What they give elsewhere is an accident of the optimizer's way, and degree 3 strays far: pink and green, where a capture
has a gap. Once trained, each surfel's coefficients c are therefore taken by ridge regression to

    argmin over x of  sum_v w_v |Y(d_v) (x - c)|^2 / sum_v w_v  +  strength |D x|^2,

where w_v is the sum of the surfel's blending weights in training view v, its textured hits' included, d_v its direction
there, Y the harmonics, before colours are limited to >= 0, and D the Laplacian on the sphere, -l (l + 1) for degree l,
over that of degree 3: what training views show stays almost as it is, and the rest is as even as that allows. Not in
the paper.
"""

from collections.abc import Iterable

import torch

from nexwarp import ops
from nexwarp.data import View
from nexwarp.model.model import Model

SURFELS = 2**15  # whose equations are added to and solved at once
LEAST = 1e-6  # pixels that a surfel has in all views, at least, if it is seen
MIN_STRENGTH, MAX_STRENGTH = 1e-6, 1e6  # beside 0; less would be lost in the harmonics' rounding


@torch.no_grad()
def smooth_sh(model: Model, views: Iterable[View], strength: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the surfels' coefficients, `sh0` (N, 1, 3) and `shN` (N, C - 1, 3), as smooth as training views allow.

    A surfel that no view shows gets one colour, that of its `sh0`. Coefficients above the degree that is rendered stay.

    Args:
        model: its N surfels and options count; they stay as they are.
        views: all training views, on any device; what their masks leave out tells nothing.
        strength: `MIN_STRENGTH` to `MAX_STRENGTH`, what smoothness counts; all of a surfel's weight counts 1.
    """
    surfels = model.surfels
    sh0, shN = surfels.sh0.detach(), surfels.shN.detach()
    count = _count(model)
    if count == 1 or not len(surfels):
        return sh0.clone(), shN.clone()
    products, total = seen_directions(model, views)
    row, column = _pairs(count, surfels.device)
    degrees = torch.arange(count, device=surfels.device, dtype=torch.float64).sqrt().floor()
    penalty = strength * (degrees * (degrees + 1) / 12).square()
    every = torch.cat([sh0, shN], dim=1)
    found = every[:, :count]
    for part in torch.arange(len(surfels), device=surfels.device).split(SURFELS):
        known = total[part] > LEAST
        some = part[known]
        left = products.new_zeros(len(some), count, count)
        left[:, row, column] = left[:, column, row] = products[some] / total[some, None]
        left += torch.diag(penalty)
        # Of what is to be taken away, which is nothing where training views tell all.
        rough = penalty[:, None] * found[some].double()
        found[some] -= torch.linalg.solve(left, rough).to(found)
        found[part[~known], 1:] = 0.0
    return every[:, :1].contiguous(), every[:, 1:].contiguous()


@torch.no_grad()
def seen_directions(model: Model, views: Iterable[View]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return which directions views have of each surfel: sum_v w_v Y_i(d_v) Y_j(d_v), (N, P), and sum_v w_v, (N,).

    In float64: what float32 rounds away of a sum of products is more than a weak smoothing adds to it.

    Args:
        model: its N surfels and options count; C is the number of their coefficients a channel that are rendered; pairs
            i <= j are P = C (C + 1) / 2, row by row of a matrix's upper triangle.
        views: v, on any device; pixels that their masks leave out do not count.
    """
    bare = model.bare()
    surfels = bare.surfels
    count = _count(model)
    row, column = _pairs(count, surfels.device)
    products = torch.zeros(len(surfels), len(row), dtype=torch.float64, device=surfels.device)
    total = products.new_zeros(len(surfels))
    for view in views:
        camera = view.camera.to(surfels.device)
        out = bare.render(camera)
        counts = torch.ones_like(out.alpha) if view.mask is None else view.mask.to(out.alpha)
        weights = out.splat_error(counts).double()
        for seen in weights.nonzero()[:, 0].split(SURFELS):
            basis = _basis(surfels.means.detach()[seen], camera.position, count).double()
            products[seen] += weights[seen, None] * basis[:, row] * basis[:, column]
        total += weights
    return products, total


def _pairs(count: int, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows and columns of the upper triangle."""
    row, column = torch.triu_indices(count, count, device=device)
    return row, column


def _count(model: Model) -> int:
    """Coefficients a channel that are rendered."""
    return min(model.surfels.shN.shape[1] + 1, (model.options.sh_degree + 1) ** 2)


def _basis(means: torch.Tensor, position: torch.Tensor, count: int) -> torch.Tensor:
    """Spherical harmonics (N, C) of the directions to surfels, as their colours have them: the derivative of those."""
    sh = means.new_zeros(len(means), count, 3).requires_grad_()
    with torch.enable_grad():
        colors = ops.plain_colors(sh, means, position, round(count**0.5) - 1)
        return torch.autograd.grad(colors.sum(), sh)[0][..., 0]
