"""Detail limits: the nearest and farthest training view of each surfel. Not in the paper."""

import torch
from torch import nn

from nexwarp import ops
from nexwarp.errors import check_tensors

NEVER = 1e30  # depth / focal of a surfel that no training view saw: its texture gets no detail


class DetailLimits(nn.Module):
    """Range of pixel sizes at which training views saw each of N surfels: depth / focal length, in world units.

    Closer than `nearest`, the texture keeps the detail of the nearest training view, as no view constrained finer
    levels. Farther than `farthest`, the texture keeps the detail of the farthest training view, and the surfel is
    blurred by the difference in pixel size, so that surfels smaller than a pixel do not alias.

    Buffers:
        nearest: (N,) depth / focal of the nearest training view in which the surfel's texture was visible; `NEVER` if
            there is none.
        farthest: (N,) the same of the farthest training view; of the surfel's centre if its texture was never visible.

    Raises:
        TypeError, ValueError: a type, shape or device does not fit; the message names the argument.
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


def limited_depths(
    ids: torch.Tensor, depths: torch.Tensor, limits: DetailLimits | None, focal: float | torch.Tensor
) -> torch.Tensor:
    """Return the depths (H, W, K) of hits, clamped to the range of the training views, for the down-weighting."""
    if limits is None or not len(limits):
        return depths
    return ops.limit_depths(ids, depths, limits.nearest, limits.farthest, focal)
