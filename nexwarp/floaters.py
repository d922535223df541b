"""Floaters: surfels that hang in the air where no training view looked, in front of views between those."""

import math
from collections.abc import Sequence
from typing import Any

import torch

from nexwarp.camera import Camera
from nexwarp.data import View
from nexwarp.kernels.types import ALPHA_MIN
from nexwarp.losses import visible_points
from nexwarp.paths import between, resized
from nexwarp.render import render
from nexwarp.surfels import Surfels

LOOKS = 60  # at least so many views between, and one for each training view
LEAST_SHARE = 3e-4  # of a picture
HEIGHT = 80  # of that, pixels: two or three of them are such a share
# A view within a training camera's reach is at least that far from all that this shows beyond twice its reach. The
# share leaves room for what is nearer than the points tell.
NEARER = 0.75
FEWEST_POINTS = 20  # that tell how near things are to a camera


@torch.no_grad()
def floaters(
    surfels: Surfels,
    cameras: Sequence[Camera],
    reaches: Sequence[float],
    generator: torch.Generator,
    *,
    options: dict[str, Any],
) -> torch.Tensor:
    """Return which surfels (N,) bool cover 3 pixels in 10,000 of a picture, or more, from too near.

    The pictures are those of cameras on the ways between the training cameras (`nexwarp.paths.between`), each within
    its training camera's reach; nearer than three quarters of that is too near.

    Args:
        surfels: the surfels.
        cameras: of the training views, on any device.
        reaches: for each, its `reach`.
        generator: for the places between, on the CPU.
        options: keyword arguments of `nexwarp.render`.
    """
    found = torch.zeros(len(surfels), dtype=torch.bool, device=surfels.means.device)
    for _ in range(math.ceil(LOOKS / len(cameras))):
        for camera, limit in zip(between(cameras, reaches, generator), reaches, strict=True):
            if limit > 0:
                found |= _shares(surfels, camera, NEARER * limit, options) >= LEAST_SHARE
    return found


def reach(view: View) -> float:
    """Half of the z-depth of the nearest points that a view shows, world units; 0 when they are too few to tell.

    Of the nearest of them one in a hundred may be wrong.
    """
    camera, found = view.camera, None
    if view.points is not None:
        found = visible_points(*camera.project(view.points), camera.width, camera.height, view.mask)
    if found is None or len(found[1]) < FEWEST_POINTS:
        return 0.0
    depths = found[1]
    return 0.5 * depths.kthvalue(1 + len(depths) // 100).values.item()


def _shares(surfels: Surfels, camera: Camera, nearest: float, options: dict[str, Any]) -> torch.Tensor:
    """(N,) of the picture, by the weights of each surfel's textured hits that are nearer than `nearest`."""
    if camera.height > HEIGHT:
        camera = resized(camera, max(round(camera.width * HEIGHT / camera.height), 1), HEIGHT)
    options = options | {"max_hits": max(options["max_hits"], 1)}
    out = render(surfels, None, camera.to(surfels.means.device), **options)
    near = (out.weights >= ALPHA_MIN) & (out.depths < nearest)
    weights = torch.where(near, out.weights, 0) / (camera.width * camera.height)
    sums = out.weights.new_zeros(len(surfels))
    return sums.scatter_add_(0, out.ids.clamp_min(0).long().flatten(), weights.flatten())
