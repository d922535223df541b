"""Detail limits: how close and how far the training views saw each surfel. Not in the paper."""

import torch
from torch import nn

from nexwarp.checks import check_tensors

NEVER = 1e30  # depth / focal of a surfel that no training view saw: its texture has no detail anywhere


class DetailLimits(nn.Module):
    """The range of pixel sizes at which training views saw each of N surfels, in world units (depth / focal length).

    A rendering from closer than `nearest` gets the texture's detail of that closest training view: the training never
    constrained finer levels. A rendering from farther than `farthest` gets the texture's detail of that farthest view,
    and the surfel is blurred by the difference in pixel size, so that surfels smaller than a pixel do not alias.

    Buffers:
        nearest: (N,) depth / focal of the closest training view in which the surfel's texture was visible, `NEVER`
            where there is none.
        farthest: (N,) likewise of the farthest training view; of the surfel's centre where its texture was not visible.

    Raises:
        TypeError, ValueError: naming the argument, when types, shapes or devices do not fit.
    """

    nearest: torch.Tensor
    farthest: torch.Tensor

    def __init__(self, nearest: torch.Tensor, farthest: torch.Tensor) -> None:
        super().__init__()
        check_tensors({"nearest": (nearest, ("N",)), "farthest": (farthest, ("N",))})
        self.register_buffer("nearest", nearest)
        self.register_buffer("farthest", farthest)

    def __len__(self) -> int:
        return len(self.nearest)
