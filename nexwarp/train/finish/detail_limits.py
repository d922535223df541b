"""Measures the detail limits of trained surfels: how close and how far the training views saw each one."""

from collections.abc import Iterable

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.kernels.types import ALPHA_MIN
from nexwarp.model.model import Model
from nexwarp.model.texture import NEVER, DetailLimits


@torch.no_grad()
def measure_detail_limits(model: Model, cameras: Iterable[Camera]) -> DetailLimits:
    """Return the detail limits of a model's surfels: the pixel sizes (depth / focal) at which cameras saw them."""
    bare = model.bare(max_hits=max(model.options.max_hits, 1))
    surfels = bare.surfels
    nearest = surfels.means.new_full((len(surfels),), NEVER)
    if not len(surfels):
        return DetailLimits(nearest, nearest.clone())
    farthest, front = torch.zeros_like(nearest), torch.zeros_like(nearest)
    for camera in cameras:
        camera = camera.to(surfels.device)
        out = bare.render(camera)
        seen, ids = out.weights >= ALPHA_MIN, out.ids.clamp_min(0).long()
        centres = camera.project(surfels.means)[1]
        front = torch.maximum(front, centres.where(centres > camera.near, 0.0) / camera.focal)
        near = (out.depths / camera.focal).where(seen, NEVER)
        far = (torch.maximum(out.depths, centres[ids]) / camera.focal).where(seen, 0.0)
        nearest.scatter_reduce_(0, ids.flatten(), near.flatten(), "amin")
        farthest.scatter_reduce_(0, ids.flatten(), far.flatten(), "amax")
    # Surfels without a visible texture have the limit of their centres in the views that they are in front of.
    farthest = farthest.where(farthest > 0, front)
    return DetailLimits(nearest, farthest.where(farthest > 0, NEVER))
