"""Adaptive density control (paper Sec. 4.3): splits surfels of large blended error, prunes transparent ones.

Once the budget is used up, the paper's density control splits a surfel only where another becomes transparent: few do.
Relocation, which the paper does not have, therefore removes the surfels that the training views need least.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import nn

from nexwarp.cameras.camera import Camera, reduced
from nexwarp.errors import check_tensors
from nexwarp.model.graphs import on_each_camera
from nexwarp.model.model import Model
from nexwarp.model.render import Frame, draw
from nexwarp.model.surfels import PARAMETERS, Surfels, axes
from nexwarp.ops import ListCapacity
from nexwarp.train.recipe import Config

RELOCATE_EVERY = 10  # rounds: the new surfels have to settle
RELOCATE_UNTIL = 0.6  # share of the densification's iterations
FULL = 0.98  # share of the budget from which it counts as used up: a round that splits few leaves some of it
SHORTEST_ROUND = 10  # iterations between rounds of a short run, unless the settings have fewer


class DensityControl:
    """Splits and prunes the surfels of a training, `nexwarp.train`'s or a loop of your own.

    `accumulate` adds the errors of each step; where a round is `due`, `step` uses them up. It replaces the parameters
    of the surfels, in the optimizer too, and moves the rows of the optimizer's state.

    Attributes:
        config: the schedule, `Config.densify` stretched to the iterations of the run.
        errors: (N,) each surfel's blended error since the last split.
    """

    def __init__(self, surfels: Surfels, config: Config) -> None:
        """Watch surfels, by the settings `densify`, `iterations` and `max_surfels` of a config."""
        schedule = config.densify
        every = max(config.scaled(schedule.every), min(schedule.every, SHORTEST_ROUND))
        start, stop = config.scaled(schedule.start), config.scaled(schedule.stop)
        self.config = dataclasses.replace(schedule, start=start, stop=stop, every=every)
        self.max_surfels = config.max_surfels
        self.surfels = surfels
        self.errors = torch.zeros_like(surfels.logit_opacities.detach())

    def active(self, iteration: int) -> bool:
        """Whether errors seen in this iteration can still lead to a split."""
        return iteration < self.config.stop

    def due(self, iteration: int, views: int = 1) -> bool:
        """Whether a round follows a step that ends with this iteration (counted from 1) and has so many views."""
        c, late = self.config, iteration % self.config.every
        return c.start < iteration - late < c.stop and late < views

    def relocates(self, iteration: int) -> bool:
        """Whether the round after this iteration also prunes the surfels that are needed least."""
        c = self.config
        rare = iteration // c.every % RELOCATE_EVERY == 0
        full = len(self.surfels) >= FULL * self.max_surfels
        return c.relocate > 0 and rare and iteration < RELOCATE_UNTIL * c.stop and full

    @torch.no_grad()
    def unneeded(
        self,
        model: Model,
        cameras: Sequence[Camera],
        largest: Callable[[torch.Tensor], torch.Tensor] = lambda values: values,
    ) -> torch.Tensor:
        """Return the surfels (N,) bool of a model to remove in such a round: those that contribute least to any image.

        A surfel's contribution to an image is the sum of its blending weights over the pixels; what counts is the image
        to which it contributes most. Images are rendered at half the size, each weighing all its pixels alike, by
        cameras in the surfels' frame. `largest` takes the contributions (N,) to these images, and returns the largest
        of all ranks.
        """
        most = torch.zeros_like(model.surfels.logit_opacities)
        background = most.new_zeros(3)

        def add(camera: Camera) -> ListCapacity:
            out = draw(Frame(model.surfels, None, camera, model.options, background))
            torch.maximum(most, out.splat_error(torch.full_like(out.alpha, 1.0 / out.alpha.numel())), out=most)
            return out.intermediates.tiles.room

        on_each_camera(add, (reduced(camera, max(camera.height // 2, 1)) for camera in cameras), most.device)
        most = largest(most)
        chosen = torch.zeros(len(most), dtype=torch.bool, device=most.device)
        chosen[most.argsort(stable=True)[: int(self.config.relocate * len(most))]] = True
        return chosen

    def accumulate(self, errors: torch.Tensor) -> None:
        """Add the blended errors (N,) >= 0 of one view, such as `Rendering.splat_error` returns them."""
        check_tensors({"errors": (errors, tuple(self.errors.shape))}, device=self.errors.device)
        self.errors += errors

    @torch.no_grad()
    def step(
        self,
        optimizer: torch.optim.Optimizer,
        generator: torch.Generator | None = None,
        unneeded: torch.Tensor | None = None,
        along: Iterable[tuple[nn.Module, str]] = (),
    ) -> torch.Tensor:
        """Split and prune the surfels, which keep their order as far as the budget has room for all.

        Children start with optimizer state of zeros; state of other shapes than its parameter's stays as it is. Where
        the number of surfels does not change, no tensor changes its address, and CUDA graphs of steps stay valid.

        Args:
            optimizer: any torch optimizer; parameters that it does not have are replaced all the same.
            generator: draws the surfels to split, on the CPU; None is torch's own.
            unneeded: (N,) bool, surfels to remove besides the transparent ones.
            along: modules and the names of their parameters or buffers that have a row for each surfel, to be treated
                as the surfels' own. Children take their parent's row.

        Returns:
            (M,) int64, for each of the M surfels the row that it, or its parent, had before. `x = x[rows]` takes along
            any tensor with a row for each surfel.
        """
        rows, sides, split = self._plan(generator, unneeded)
        if split:
            self.errors.zero_()
        if len(rows) != len(self.errors):
            self.errors = self.errors[rows]
        if split or len(rows) != len(self.surfels):
            split_surfels(self.surfels, optimizer, rows, sides, along)
        return rows

    def _plan(
        self, generator: torch.Generator | None, unneeded: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor, bool]:
        """Return the rows (M,) that stay or are split, sides (M,) of children, else 0, and whether any is split."""
        opacities, count = self.surfels.opacities.detach(), len(self.surfels)
        gone = torch.zeros_like(opacities, dtype=torch.bool) if unneeded is None else unneeded
        prunes = self.config.prune_at_cap
        transparent = opacities < self.config.prune_opacity
        spared = opacities == opacities.max()  # without the most opaque ones no gradient would be left
        if prunes and int((1 + self.config.fraction) * count) >= self.max_surfels:
            return self._exchange(gone & ~spared, (gone | transparent) & ~spared, generator)
        rows = (~gone | spared).nonzero()[:, 0]
        room = min(self.max_surfels, int((1 + self.config.fraction) * len(rows))) - len(rows)
        chosen = self._choose(self.errors[rows], room, generator)
        sides = torch.zeros_like(rows)
        sides[chosen] = -1
        rows, sides = torch.cat([rows, rows[chosen]]), torch.cat([sides, torch.ones_like(chosen)])
        if len(chosen) or prunes:
            kept = ~transparent[rows] | spared[rows]
            rows, sides = rows[kept], sides[kept]
        return rows, sides, len(chosen) > 0

    def _exchange(
        self, unneeded: torch.Tensor, gone: torch.Tensor, generator: torch.Generator | None
    ) -> tuple[torch.Tensor, torch.Tensor, bool]:
        """As `_plan` within reach of the budget: `fraction` is split, and one for each unneeded, into pruned rows."""
        pruned, count = gone.nonzero()[:, 0], len(gone)
        self.errors[pruned] = 0
        most = int(self.config.fraction * count) + int(unneeded.sum())
        chosen = self._choose(self.errors, min(self.max_surfels - count + len(pruned), most), generator)
        places = torch.cat([pruned, torch.arange(count, count + len(chosen), device=gone.device)])[: len(chosen)]
        rows = torch.arange(max(count, count + len(chosen) - len(pruned)), device=gone.device)
        sides = torch.zeros_like(rows)
        rows[places] = chosen
        sides[places], sides[chosen] = 1, -1
        kept = torch.ones_like(rows, dtype=torch.bool)
        kept[pruned[len(chosen) :]] = False
        return rows[kept], sides[kept], len(chosen) > 0

    def _choose(self, errors: torch.Tensor, count: int, generator: torch.Generator | None) -> torch.Tensor:
        """Draw rows of errors without replacement, with probability proportional to them."""
        device = errors.device
        errors = torch.nan_to_num(errors.double().cpu(), 0.0, 0.0, 0.0).clamp_min(0)
        candidates = int((errors > 0).sum())
        if candidates == 0 or count <= 0:
            return torch.empty(0, dtype=torch.long, device=device)
        # Keys u^(1/p) are those of weighted sampling without replacement; -log keeps them exact (Efraimidis, Spirakis).
        keys = torch.empty_like(errors).exponential_(generator=generator) / errors
        return keys.topk(min(count, candidates), largest=False).indices.sort().values.to(device)


@torch.no_grad()
def split_surfels(
    surfels: Surfels,
    optimizer: torch.optim.Optimizer,
    rows: torch.Tensor,
    sides: torch.Tensor,
    along: Iterable[tuple[nn.Module, str]] = (),
) -> None:
    """Make the surfels the given rows (M,) of themselves, and halves of these where sides (M,) are -1 or 1, not 0.

    Halves lie along the longer axis: scale / 2, centres at -+ scale / 2. `along` is that of `DensityControl.step`.
    """
    children = sides.nonzero()[:, 0]
    moved = (rows != torch.arange(len(rows), device=rows.device)).nonzero()[:, 0]
    for module, name in [*((surfels, name) for name in PARAMETERS), *along]:
        _take_rows(module, name, optimizer, rows, moved, children)
    log_scales, means = surfels.log_scales[children], surfels.means[children]
    axis, at = log_scales.argmax(dim=1), torch.arange(len(children), device=children.device)
    x_axis, y_axis, _ = axes(surfels.quats[children])
    offset = torch.where(axis[:, None] == 0, x_axis, y_axis) * (log_scales[at, axis].exp() / 2)[:, None]
    log_scales[at, axis] -= torch.log(torch.tensor(2.0)).item()
    surfels.means[children] = means + sides[children, None] * offset
    surfels.log_scales[children] = log_scales


def _take_rows(
    module: nn.Module,
    name: str,
    optimizer: torch.optim.Optimizer,
    rows: torch.Tensor,
    moved: torch.Tensor,
    children: torch.Tensor,
) -> None:
    """Replace a parameter or buffer by the given rows (M,) of it, and the optimizer's state; zero state for children.

    Of as many rows as before, those that were `moved` are written in place.
    """
    path, _, leaf = name.rpartition(".")
    owner = module.get_submodule(path)
    old: torch.Tensor = getattr(owner, leaf)
    state = optimizer.state.get(old, {})
    by_row = {key: x for key, x in state.items() if isinstance(x, torch.Tensor) and x.shape == old.shape}
    if len(rows) == len(old):
        for value in (old, *by_row.values()):
            value.index_copy_(0, moved, value[rows[moved]])
        for value in by_row.values():
            value.index_fill_(0, children, 0)
        return
    by_row = {key: x[rows] for key, x in by_row.items()}
    for value in by_row.values():
        value.index_fill_(0, children, 0)
    new = old[rows]
    if isinstance(old, nn.Parameter):
        new = nn.Parameter(new, old.requires_grad)
        for group in optimizer.param_groups:
            group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
        if optimizer.state.pop(old, None) is not None:
            optimizer.state[new] = {**state, **by_row}
    setattr(owner, leaf, new)
