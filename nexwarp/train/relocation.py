"""Finds the surfels that the training views need least, whose place density control can use. Not in the paper.

Once the budget is used up, the paper's density control splits a surfel only where another becomes transparent: few do.
"""

from collections.abc import Callable, Sequence

import torch

from nexwarp.cameras.camera import Camera, reduced
from nexwarp.model.model import Model


@torch.no_grad()
def least_contributing(
    model: Model,
    cameras: Sequence[Camera],
    share: float,
    largest: Callable[[torch.Tensor], torch.Tensor] = lambda values: values,
) -> torch.Tensor:
    """Return (N,) bool, True for the share of the surfels that contribute least to any image.

    A surfel's contribution to an image is the sum of its blending weights over the pixels; what counts is the image to
    which it contributes most. Images are rendered at half the size, each weighing all its pixels alike. `largest` takes
    the contributions (N,) to these images, and returns the largest of all ranks.
    """
    bare = model.bare()
    most = torch.zeros_like(bare.surfels.logit_opacities)
    for camera in cameras:
        out = bare.render(reduced(camera, max(camera.height // 2, 1)))
        most = torch.maximum(most, out.splat_error(torch.full_like(out.alpha, 1.0 / out.alpha.numel())))
    most = largest(most)
    chosen = torch.zeros(len(most), dtype=torch.bool, device=most.device)
    chosen[most.argsort(stable=True)[: int(share * len(most))]] = True
    return chosen
