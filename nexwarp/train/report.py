"""What a training step reports."""

import math
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class StepReport:
    """What a training step reports to its observers, without a gradient. Reading a number waits for the GPU.

    Attributes:
        iteration: number of the step, from 1.
        surfels: how many surfels there are after it.
        losses: terms of the loss by name, factors included, scalars; own losses have their own names.
        image: (H, W, 3) the rendering, not clamped, before the step changed anything.
        target: (H, W, 3) float, the photo that it was compared with.
        views: number of views of the step, one for each rank; losses, image and target are those of this rank's.
    """

    iteration: int
    surfels: int
    losses: dict[str, torch.Tensor]
    image: torch.Tensor
    target: torch.Tensor
    views: int = 1

    def passed(self, every: int) -> bool:
        """Whether a multiple of `every` is among the iterations of the step."""
        return self.iteration % every < self.views

    def loss(self) -> float:
        """Return the value of the loss: the sum of all terms."""
        return float(sum(x.detach() for x in self.losses.values()))

    def psnr(self) -> float:
        """Return the PSNR of the step's training view in dB, from unrounded values."""
        error = (self.image.detach().clamp(0, 1) - self.target).square().mean()
        return -10.0 * math.log10(max(error.item(), 1e-10))
