"""Orders surfels by their share of the pictures, so that the first ones of a model are a coarser model."""

from collections.abc import Iterable

import torch

from nexwarp.cameras.camera import Camera, reduced
from nexwarp.model.detail import ORDERED, pick_surfels
from nexwarp.model.model import Model

HEIGHT = 540  # pixels of the pictures that shares are measured in, at most


@torch.no_grad()
def picture_shares(model: Model, cameras: Iterable[Camera]) -> torch.Tensor:
    """Return the sums (N,) of each surfel's blending weights over all pictures, each by its mean over the pixels."""
    bare = model.bare()
    shares = torch.zeros_like(model.surfels.logit_opacities)
    for camera in cameras:
        out = bare.render(reduced(camera, HEIGHT))
        shares += out.splat_error(torch.full_like(out.alpha, 1.0 / out.alpha.numel()))
    return shares


def ordered(model: Model, cameras: Iterable[Camera]) -> Model:
    """Return a model with the same surfels, those of the largest shares of the cameras' pictures first."""
    if not len(model.surfels):
        return model
    shares = picture_shares(model, cameras)
    result = pick_surfels(model, shares.argsort(descending=True, stable=True))
    result.meta[ORDERED] = True
    return result
