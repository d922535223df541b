"""Finds floaters: surfels in the empty space close to cameras."""

import math
from collections.abc import Sequence

import torch

from nexwarp.camera import Camera, reduced, visible_points
from nexwarp.cameras.between import between
from nexwarp.data import View
from nexwarp.distributed.ranks import Ranks
from nexwarp.kernels.types import ALPHA_MIN
from nexwarp.model.model import Model

PROBES = 60  # views between the training views, at least; at least one for each training view
LAST_PROBES = 240  # the same for the last search
LEAST_SHARE = 3e-4  # share of an image that a floater covers, at least
HEIGHT = 80  # of the images, pixels: the share is two or three of them
LAST_SHARE = 3e-3  # share in the last search: the surfels behind a removed floater can no longer be trained
NEARER = 0.6  # share of the nearest points' depth: real surfaces may be somewhat nearer than these points
FLOATERS_EVERY = 10  # rounds of densification from one search to the next
FEWEST_POINTS = 20  # points in a view that give its nearest depth, at least


@torch.no_grad()
def floaters(
    model: Model,
    cameras: Sequence[Camera],
    nearest: Sequence[float],
    generator: torch.Generator,
    *,
    last: bool = False,
    ranks: Ranks | None = None,
) -> torch.Tensor:
    """Return (N,) bool, True for floaters: surfels that cover 3 in 10,000 pixels of an image, or more, from too near.

    The images are those of the training cameras and of random cameras between them (`between`). The surfaces that a
    training camera sees are at least as far away as its nearest points. For a camera between, this distance is shorter
    by the distance to its training camera, which is at most half of it. A surfel that is nearer than 0.6 times the
    distance is too near.

    Args:
        model: its surfels and options are used; K = 0 counts as 1.
        cameras: cameras of the training views, on any device.
        nearest: the `nearest_depth` of each camera.
        generator: CPU generator for the cameras between.
        last: the last search of a run, after which nothing behind a floater can be trained: return surfels that cover
            3 in 1,000 pixels, or more, and use four times as many cameras between.
        ranks: share the cameras, and return the same on all of them; None is this process alone.
    """
    bare = model.bare(max_hits=max(model.options.max_hits, 1))
    least, count = (LAST_SHARE, LAST_PROBES) if last else (LEAST_SHARE, PROBES)
    probes = [*zip(cameras, nearest, strict=True)]
    for _ in range(math.ceil(count / len(cameras))):
        moved = between(cameras, [0.5 * depth for depth in nearest], generator)
        for old, new, depth in zip(cameras, moved, nearest, strict=True):
            probes.append((new, depth - torch.dist(new.position, old.position).item()))
    found = torch.zeros(len(bare.surfels), dtype=torch.bool, device=bare.device)
    for camera, depth in probes if ranks is None else probes[ranks.rank :: ranks.size]:
        if depth > 0:
            found |= _shares(bare, camera, NEARER * depth) >= least
    return found if ranks is None else ranks.union(found)


def nearest_depth(view: View, points: torch.Tensor) -> float:
    """Return the z-depth of the nearest points in front of a view's camera, world units; 0 if they are too few.

    It is the first percentile, so that a few wrong points do not matter. All points of the scene count: a surface close
    to this camera may have been triangulated from other photos only.

    Args:
        view: the view; 0 is returned if no points were triangulated from its photo.
        points: (P, 3) points of the scene, world frame.
    """
    if view.points is None or not len(view.points):
        return 0.0
    camera = view.camera
    found = visible_points(*camera.project(points), camera.width, camera.height)
    if found is None or len(found[1]) < FEWEST_POINTS:
        return 0.0
    depths = found[1]
    return depths.kthvalue(1 + len(depths) // 100).values.item()


def _shares(bare: Model, camera: Camera, nearest: float) -> torch.Tensor:
    """Return (N,): each surfel's share of the image, by the weights of its textured hits nearer than `nearest`."""
    camera = reduced(camera, HEIGHT)
    out = bare.render(camera)
    near = (out.weights >= ALPHA_MIN) & (out.depths < nearest)
    weights = torch.where(near, out.weights, 0) / (camera.width * camera.height)
    sums = out.weights.new_zeros(len(bare.surfels))
    return sums.scatter_add_(0, out.ids.clamp_min(0).long().flatten(), weights.flatten())
