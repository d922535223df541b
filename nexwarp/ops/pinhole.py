"""The image plane that the passes see: a camera without its pose."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics and size of an image.

    Attributes:
        K: (3, 3) intrinsics in pixels, on the surfels' device and of their dtype; pixel centres lie at +0.5.
        width, height: pixels.
        near: hits with a z-depth of at most this (world units) are ignored.
    """

    K: torch.Tensor
    width: int
    height: int
    near: float
