"""What a training step compares its rendering with."""

from dataclasses import dataclass
from typing import Any

import torch

from nexwarp.camera import Camera


@dataclass(frozen=True)
class Target:
    """What a step is to show.

    Attributes:
        camera: to render with.
        photo: (H, W, 3) float, what to compare with.
        background: as `render` takes it.
        counts: (H, W) bool, where the photo counts; None is everywhere.
        empty: (H, W) bool, where there is nothing but the background; None is nowhere.
        beyond: (H, W) bool, what lies beyond the photo's frame; None is nothing.
        places, expected: (M,) points to compare depths with, as `depth_loss` takes them; None is no such loss.
        depth_jitter: as `render` takes it.
    """

    camera: Camera
    photo: torch.Tensor
    background: Any
    counts: torch.Tensor | None = None
    empty: torch.Tensor | None = None
    beyond: torch.Tensor | None = None
    places: torch.Tensor | None = None
    expected: torch.Tensor | None = None
    depth_jitter: float | torch.Tensor = 0.0
