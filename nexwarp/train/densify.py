"""Adaptive density control (paper Sec. 4.3): splits surfels of large blended error, prunes transparent ones.

Once the budget is used up, the paper's density control splits a surfel only where another becomes transparent: few do.
Relocation, which the paper does not have, therefore removes the surfels that the training views need least.
"""

from collections.abc import Callable, Sequence

import torch
from torch import nn

from nexwarp.cameras.camera import Camera, reduced
from nexwarp.model.model import Model
from nexwarp.model.surfels import PARAMETERS, Surfels
from nexwarp.train.recipe import DensifyConfig

RELOCATE_EVERY = 10  # rounds: the new surfels have to settle
RELOCATE_UNTIL = 0.6  # share of the densification's iterations
FULL = 0.98  # share of the budget from which it counts as used up: a round that splits few leaves some of it


class Densifier:
    """Sums of each surfel's blended error since the last split, and the rounds that use them up."""

    def __init__(self, config: DensifyConfig, surfels: Surfels, max_surfels: int) -> None:
        self.config = config
        self.max_surfels = max_surfels
        self.errors = torch.zeros_like(surfels.logit_opacities.detach())

    def active(self, iteration: int) -> bool:
        """Whether errors seen in this iteration can still lead to a split."""
        return iteration < self.config.stop

    def due(self, iteration: int, views: int = 1) -> bool:
        """Whether a round follows a step that ends with this iteration (counted from 1) and has so many views."""
        c, late = self.config, iteration % self.config.every
        return c.start < iteration - late < c.stop and late < views

    def relocates(self, iteration: int, count: int) -> bool:
        """Whether a round after this iteration, with so many surfels, also prunes those that are needed least."""
        c = self.config
        rare = iteration // c.every % RELOCATE_EVERY == 0
        return c.relocate > 0 and rare and iteration < RELOCATE_UNTIL * c.stop and count >= FULL * self.max_surfels

    def unneeded(
        self,
        model: Model,
        cameras: Sequence[Camera],
        largest: Callable[[torch.Tensor], torch.Tensor] = lambda values: values,
    ) -> torch.Tensor:
        """Return the surfels (N,) bool to relocate; see `least_contributing`."""
        return least_contributing(model, cameras, self.config.relocate, largest)

    def accumulate(self, errors: torch.Tensor) -> None:
        """Add the blended errors (N,) of one view."""
        self.errors += errors

    def step(
        self,
        surfels: Surfels,
        optimizer: torch.optim.Optimizer,
        generator: torch.Generator,
        unneeded: torch.Tensor | None = None,
    ) -> tuple[int, int]:
        """Split and prune, in place, `unneeded` (N,) bool surfels too; return how many were split and how many pruned.

        Children start with optimizer state of zeros. Where the budget is within reach of a round that prunes, second
        children take the rows of pruned surfels. A round at the budget then changes no tensor's size or address, and
        CUDA graphs of training steps stay valid.
        """
        count, prunes = len(surfels), self.config.prune_at_cap
        if prunes and int((1 + self.config.fraction) * count) >= self.max_surfels:
            return self._replace(surfels, optimizer, generator, unneeded)
        pruned = 0 if unneeded is None else self.remove(surfels, optimizer, unneeded)
        count = len(surfels)
        room = min(self.max_surfels, int((1 + self.config.fraction) * count)) - count
        chosen = self._choose(room, generator)
        if len(chosen):
            split_surfels(surfels, optimizer, chosen)
            self.errors = torch.zeros_like(surfels.logit_opacities.detach())
        if len(chosen) or prunes:
            pruned += self.remove(surfels, optimizer, self._transparent(surfels))
        return len(chosen), pruned

    def _replace(
        self,
        surfels: Surfels,
        optimizer: torch.optim.Optimizer,
        generator: torch.Generator,
        unneeded: torch.Tensor | None,
    ) -> tuple[int, int]:
        """Prune and split in one go, `fraction` of the surfels and one for each unneeded; children take pruned rows."""
        if unneeded is None:
            unneeded = torch.zeros_like(surfels.logit_opacities, dtype=torch.bool)
        spared = _most_opaque(surfels)
        gone = (self._transparent(surfels) | unneeded) & ~spared
        rows, count = gone.nonzero()[:, 0], len(surfels)
        self.errors[rows] = 0
        most = int(self.config.fraction * count) + int((unneeded & ~spared).sum())
        chosen = self._choose(min(self.max_surfels - count + len(rows), most), generator)
        if len(chosen):
            appended = torch.arange(count, count + len(chosen), device=rows.device)
            split_surfels(surfels, optimizer, chosen, torch.cat([rows, appended])[: len(chosen)])
            if len(surfels) == count:
                self.errors.zero_()
            else:
                self.errors = torch.zeros_like(surfels.logit_opacities.detach())
        if len(chosen) < len(rows):
            left = torch.zeros(len(surfels), dtype=torch.bool, device=rows.device)
            left[rows[len(chosen) :]] = True
            self.remove(surfels, optimizer, left)
        return len(chosen), len(rows)

    def _transparent(self, surfels: Surfels) -> torch.Tensor:
        return surfels.opacities.detach() < self.config.prune_opacity

    def remove(self, surfels: Surfels, optimizer: torch.optim.Optimizer, chosen: torch.Tensor) -> int:
        """Remove the chosen (N,) bool surfels but for the most opaque ones, without which no gradient would be left."""
        keep = ~chosen | _most_opaque(surfels)
        removed = int((~keep).sum())
        if removed:
            kept = keep.nonzero()[:, 0]
            replace_rows(surfels, optimizer, kept)
            self.errors = self.errors[kept]
        return removed

    def _choose(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Draw surfels without replacement, with probability proportional to their blended error."""
        errors = torch.nan_to_num(self.errors.double().cpu(), 0.0, 0.0, 0.0).clamp_min(0)
        candidates = int((errors > 0).sum())
        if candidates == 0 or count <= 0:
            return torch.empty(0, dtype=torch.long, device=self.errors.device)
        # Keys u^(1/p) are those of weighted sampling without replacement; -log keeps them exact (Efraimidis, Spirakis).
        keys = torch.empty_like(errors).exponential_(generator=generator) / errors
        chosen = keys.topk(min(count, candidates), largest=False).indices.sort().values
        return chosen.to(self.errors.device)


def _most_opaque(surfels: Surfels) -> torch.Tensor:
    opacities = surfels.opacities.detach()
    return opacities == opacities.max()


@torch.no_grad()
def split_surfels(
    surfels: Surfels, optimizer: torch.optim.Optimizer, chosen: torch.Tensor, places: torch.Tensor | None = None
) -> None:
    """Replace each chosen surfel by two halves along its longer axis: scale / 2, centres at +-scale / 2.

    The first child takes the parent's row `chosen` (M,). The second takes that in `places` (M,): rows that are no
    parent's, then N, N + 1 and so on for those to append; None appends all. The optimizer's state is zero for children.
    """
    count = len(surfels)
    if places is None:
        places = torch.arange(count, count + len(chosen), device=chosen.device)
    quats, log_scales = surfels.quats[chosen], surfels.log_scales[chosen]
    axis = log_scales.argmax(dim=1)
    rows = torch.arange(len(chosen), device=chosen.device)
    w, x, y, z = quats.unbind(-1)
    # First two columns of the rotation matrix.
    x_axis = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=-1)
    y_axis = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1)
    offset = torch.where(axis[:, None] == 0, x_axis, y_axis) * (log_scales[rows, axis].exp() / 2)[:, None]
    halved = log_scales.clone()
    halved[rows, axis] -= torch.log(torch.tensor(2.0)).item()
    means = surfels.means[chosen]
    new = int((places >= count).sum())
    if new:
        everyone = torch.arange(count, device=chosen.device)
        replace_rows(surfels, optimizer, torch.cat([everyone, chosen[len(chosen) - new :]]))
    for name in PARAMETERS:
        parameter = getattr(surfels, name)
        parameter[places] = parameter[chosen]
        for value in optimizer.state.get(parameter, {}).values():
            if has_rows_of(value, parameter):
                value[chosen] = 0
                value[places] = 0
    surfels.means[chosen], surfels.means[places] = means - offset, means + offset
    surfels.log_scales[chosen], surfels.log_scales[places] = halved, halved


@torch.no_grad()
def replace_rows(surfels: Surfels, optimizer: torch.optim.Optimizer, rows: torch.Tensor) -> None:
    """Make the surfels the given rows (M,) of themselves, and so all optimizer state of their parameters' shapes."""
    for name in PARAMETERS:
        old = getattr(surfels, name)
        new = nn.Parameter(old.detach()[rows].contiguous())
        setattr(surfels, name, new)
        for group in optimizer.param_groups:
            group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
        state = optimizer.state.pop(old, None)
        if state is not None:
            for key, value in state.items():
                if has_rows_of(value, old):
                    state[key] = value[rows].contiguous()
            optimizer.state[new] = state


def has_rows_of(value: object, parameter: torch.Tensor) -> bool:
    """Whether a value of an optimizer's state holds a number for each number of the parameter."""
    return isinstance(value, torch.Tensor) and value.shape == parameter.shape


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
