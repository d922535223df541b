"""What a training step reports, and the health of a training: numbers that are not finite, lacking memory."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from nexwarp.errors import DivergedError
from nexwarp.train.state import TrainingState


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


def check_health(
    iteration: int, losses: Sequence[tuple[int, str, torch.Tensor]], tensors: Mapping[str, torch.Tensor]
) -> None:
    """Raise DivergedError unless losses, by iteration and name, and all tensors are finite; waits for the GPU."""
    values = torch.stack([value for _, _, value in losses]).tolist() if losses else []
    bad_losses = (
        f"iteration {step}: the loss {name!r} is {value}"
        for (step, name, _), value in zip(losses, values, strict=True)
        if not math.isfinite(value)
    )
    faults = [*list(bad_losses)[:1], *(f"{name} is not finite" for name in not_finite(tensors)[:1])]
    if faults:
        start = "" if faults[0].startswith("iteration") else f"iteration {iteration}: "
        raise DivergedError(start + "; ".join(faults))


def not_finite(tensors: Mapping[str, torch.Tensor]) -> list[str]:
    """Return the names of the tensors that hold NaN or infinity: one reduction of each, one wait for the GPU."""
    filled = {name: x.detach() for name, x in tensors.items() if x.numel()}
    if not filled:
        return []
    # A maximum hands NaN on, and cannot overflow as a sum does.
    largest = torch.stack([torch.linalg.vector_norm(x, math.inf).float() for x in filled.values()])
    return [name for name, x in zip(filled, largest.tolist(), strict=True) if not math.isfinite(x)]


def oom_message(state: TrainingState, needed: str, *, graphs: bool) -> str:
    """Return what to say when memory does not suffice: what it was needed for, and what to lower."""
    place, used, advice = "memory", "", ""
    if state.device.type == "cuda":
        free, total = torch.cuda.mem_get_info(state.device)
        place, used = "GPU memory", f", with {(total - free) / 2**30:.1f} of {total / 2**30:.1f} GiB in use"
        advice = ", or do without CUDA graphs (--set cuda_graphs=false)" if graphs else ""
    camera, config = state.scene.train[0].camera, state.config
    return (
        f"out of {place} at iteration {state.iteration}: it needed {needed}{used}, for {len(state.surfels):,} "
        f"surfels and photos of {camera.width}x{camera.height}; lower --max-surfels (now "
        f"{config.max_surfels:,}) or --max-hits (now {config.max_hits}), or raise --downscale{advice}"
    )
