"""Floaters: surfels that hang in the air close to cameras, where nothing is."""

import math
from collections.abc import Sequence

import torch

from nexwarp.camera import Camera, reduced, visible_points
from nexwarp.cameras.between import between
from nexwarp.data import View
from nexwarp.kernels.types import ALPHA_MIN
from nexwarp.model.model import Model

LOOKS = 60  # at least so many views between the training views, and one for each
LAST_LOOKS = 240  # the last time
LEAST_SHARE = 3e-4  # of a picture
HEIGHT = 80  # of that, pixels: two or three of them are such a share
LAST_SHARE = 3e-3  # the last time, when what is behind can no more be learnt
NEARER = 0.6  # of the depth of the nearest points, which leaves room for what is nearer than these tell
FEWEST_POINTS = 20  # that tell how near things are to a camera


@torch.no_grad()
def floaters(
    model: Model,
    cameras: Sequence[Camera],
    nearest: Sequence[float],
    generator: torch.Generator,
    *,
    last: bool = False,
) -> torch.Tensor:
    """Return which surfels (N,) bool cover 3 pixels in 10,000 of a picture, or more, from too near.

    The pictures are those of the training cameras and of others on the ways between them (`between`).
    What a training camera shows is at least as far from it as its nearest points; from another one, at least that
    less the way between the two, which is at most half of it. Nearer than six tenths of this is too near.

    Args:
        model: its surfels and options count; K = 0 counts as 1.
        cameras: of the training views, on any device.
        nearest: for each, its `nearest_depth`.
        generator: for the places between, on the CPU.
        last: what is behind will not be learnt: look for those alone that cover 3 pixels in 1,000, or more, but in four
            times as many views between.
    """
    bare = model.bare(max_hits=max(model.options.max_hits, 1))
    least, count = (LAST_SHARE, LAST_LOOKS) if last else (LEAST_SHARE, LOOKS)
    looks = [*zip(cameras, nearest, strict=True)]
    for _ in range(math.ceil(count / len(cameras))):
        moved = between(cameras, [0.5 * depth for depth in nearest], generator)
        for old, new, depth in zip(cameras, moved, nearest, strict=True):
            looks.append((new, depth - torch.dist(new.position, old.position).item()))
    found = torch.zeros(len(bare.surfels), dtype=torch.bool, device=bare.device)
    for camera, depth in looks:
        if depth > 0:
            found |= _shares(bare, camera, NEARER * depth) >= least
    return found


def nearest_depth(view: View, points: torch.Tensor) -> float:
    """Z-depth of the nearest points before a view's camera, world units; 0 when they are too few to tell.

    Of the nearest one in a hundred may be wrong. Not only the view's own points count: what is close to one camera may
    have been triangulated from others alone.

    Args:
        view: tells nothing where it has no triangulated points itself.
        points: (P, 3) of the scene, world frame.
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
    """(N,) of the picture, by the weights of each surfel's textured hits that are nearer than `nearest`."""
    camera = reduced(camera, HEIGHT)
    out = bare.render(camera)
    near = (out.weights >= ALPHA_MIN) & (out.depths < nearest)
    weights = torch.where(near, out.weights, 0) / (camera.width * camera.height)
    sums = out.weights.new_zeros(len(bare.surfels))
    return sums.scatter_add_(0, out.ids.clamp_min(0).long().flatten(), weights.flatten())
