"""Floaters: surfels that hang in the air where no training view looked, in front of views between those."""

from collections.abc import Iterable, Sequence
from typing import Any

import torch

from nexwarp.camera import Camera
from nexwarp.evaluate import ALPHA_MIN, NEVER
from nexwarp.paths import between, resized
from nexwarp.render import render
from nexwarp.surfels import Surfels

# A camera between the training ones sees what those see from about as far. A floater, which to some of them is a piece
# of the background, it sees from much nearer, and large.
NEARER = 0.5
LEAST_SHARE = 0.01
HEIGHT = 160  # pixels, which suffice for what covers a hundredth of a picture


@torch.no_grad()
def floaters(
    surfels: Surfels,
    cameras: Sequence[Camera],
    reaches: Sequence[float],
    generator: torch.Generator,
    *,
    options: dict[str, Any],
) -> torch.Tensor:
    """Return which surfels (N,) bool views between the training views show large and far too near.

    These are a hundredth of such a picture or more, by their weights, from less than half of the least depth that any
    training view shows them at. Surfels that no training view shows are not judged. Where all that a camera shows is
    beyond twice its reach, a view within that is never nearer to it than half of the camera's depth, so it stays.

    Args:
        surfels: the surfels.
        cameras: of the training views, on any device.
        reaches: for each, how far from it a view between may be, world units: half of the depth of the nearest points.
        generator: for the views between, one for each camera (`nexwarp.paths.between`), on the CPU.
        options: keyword arguments of `nexwarp.render`.
    """
    options = options | {"max_hits": max(options["max_hits"], 1)}
    device, count = surfels.means.device, len(surfels)
    least = surfels.means.new_full((count,), NEVER)
    for ids, depths, _ in _hits(surfels, cameras, options):
        least.scatter_reduce_(0, ids, depths, "amin")
    found = torch.zeros(count, dtype=torch.bool, device=device)
    limits = torch.where(least < NEVER, NEARER * least, 0)
    for ids, depths, shares in _hits(surfels, between(cameras, reaches, generator), options):
        near = torch.where(depths < limits[ids], shares, 0)
        found |= torch.zeros_like(limits).scatter_add_(0, ids, near) >= LEAST_SHARE
    return found


def _hits(
    surfels: Surfels, cameras: Iterable[Camera], options: dict[str, Any]
) -> Iterable[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Ids, depths and weights over the number of pixels, each (M,), of a small picture's textured hits."""
    for camera in cameras:
        if camera.height > HEIGHT:
            camera = resized(camera, max(round(camera.width * HEIGHT / camera.height), 1), HEIGHT)
        out = render(surfels, None, camera.to(surfels.means.device), **options)
        seen = out.weights >= ALPHA_MIN
        depths = torch.where(seen, out.depths, NEVER)
        shares = torch.where(seen, out.weights, 0) / (camera.width * camera.height)
        yield out.ids.clamp_min(0).long().flatten(), depths.flatten(), shares.flatten()
