"""Floaters: surfels in empty space that few training views agree on.

A view shows a surfel if its blending weights there reach a tenth of what it would have if it were opaque and nothing
were before it. Suspects are surfels that at most 2 % of the views show, or one. A view speaks against a surfel if its
picture holds the surfel's centre and has a solid surface behind it, by a tenth of its depth or more; for it, if it has
the surface at that depth. Fog is suspects with 20 times more views against than for them. Blobs are suspects that the
views speak so against once all suspects are taken away, as before one camera, if no chain of surfels that touch leads
from them to the rest.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from nexwarp.cameras.camera import Camera, in_image
from nexwarp.model.edit import select
from nexwarp.model.model import Model
from nexwarp.model.render import Rendering
from nexwarp.model.surfels import Surfels

VISIBLE = 0.1  # share of a surfel's picture that a view shows
FEW = 0.02  # of the views
SOLID = 0.5  # least alpha of a surface
BEHIND = 0.1  # of the depth of the surface
AGREEING = 0.05  # of the views that see a surface behind
TOUCHING = 2.0  # distance of centres, in sums of the larger scales
NEIGHBORS = 8  # of a surfel that may touch it


@torch.no_grad()
def find_floaters(
    model: Model, cameras: Sequence[Camera], observe: Callable[[str, int, int], object] = lambda *_: None
) -> torch.Tensor:
    """Return (N,) bool, on the CPU: which surfels of a model are floaters, as its training cameras tell.

    `observe` is called with the name of each of two stages, how many views of it are done, and of how many.
    """
    bare = model.bare()
    means = bare.surfels.means
    cameras = [camera.to(means.device) for camera in cameras]
    votes, votes_without = torch.zeros(2, 2, len(means), device=means.device)
    shown = torch.zeros(len(means), device=means.device)
    for number, camera in enumerate(cameras):
        out = bare.render(camera)
        weights = out.splat_error(torch.ones_like(out.alpha))
        shown += weights >= VISIBLE * _areas(bare.surfels, camera)
        votes += _votes(means, camera, out)
        observe("looking for suspects", number + 1, len(cameras))
    suspects = shown <= max(1, int(FEW * len(cameras)))
    others = select(bare, ~suspects)
    for number, camera in enumerate(cameras):
        votes_without += _votes(means, camera, others.render(camera))
        observe("looking behind them", number + 1, len(cameras))
    fog, blobs = (suspects & (x[0] > 0) & (x[1] <= AGREEING * x[0]) for x in (votes, votes_without))
    solid = ~fog
    fog[solid] = _isolated(select(bare, solid).surfels, blobs[solid])
    return fog.cpu()


def _votes(means: torch.Tensor, camera: Camera, out: Rendering) -> torch.Tensor:
    """Return the votes of a view against and for surfels with means (N, 3): (2, N), 0 or 1."""
    pixels, depths = camera.project(means)
    inside = in_image(pixels, depths - camera.near, camera.width, camera.height)
    column, row = pixels.where(inside[:, None], 0.0).long().unbind(1)
    surface = out.median_depth[row, column]
    inside &= out.alpha[row, column] >= SOLID
    behind = (surface - depths) / surface
    return torch.stack([inside & (behind > BEHIND), inside & (behind.abs() <= BEHIND)]).float()


def _areas(surfels: Surfels, camera: Camera) -> torch.Tensor:
    """Return the pixels (N,) that opaque Gaussians of the surfels' sizes cover: one at least; infinite behind it."""
    rays = surfels.means - camera.position
    depths = camera.project(surfels.means)[1]
    slant = (torch.nn.functional.normalize(rays, dim=1) * surfels.normals).sum(1).abs()
    areas = 2 * math.pi * surfels.scales.prod(1) * slant * (camera.focal / depths).square()
    return areas.clamp_min(1.0).where(depths > camera.near, math.inf)


def _isolated(surfels: Surfels, some: torch.Tensor) -> torch.Tensor:
    """Return which of `some` (N,) bool surfels no chain of touching ones connects with the rest, (N,) bool."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not some.any():
        return some
    means, reach, chosen = (x.cpu().numpy() for x in (surfels.means, surfels.scales.amax(1), some))
    distances, near = cKDTree(means).query(means[chosen], k=min(NEIGHBORS + 1, len(means)))
    touching = distances <= TOUCHING * (reach[chosen, None] + reach[near])
    node = np.where(chosen, chosen.cumsum(), 0)  # the rest is node 0
    ends = np.broadcast_to(node[chosen, None], near.shape)[touching], node[near][touching]
    count = node.max() + 1
    labels = connected_components(coo_matrix((np.ones(len(ends[0])), ends), (count, count)), directed=False)[1]
    return torch.from_numpy((labels != labels[0])[node]).to(surfels.device)
