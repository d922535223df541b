"""Training on several ranks: each renders another view, and all keep the same bits.

A step has one view for each rank. Gradients are averaged, and the surfels' error sums added, before the parameters
change, so that all ranks change them alike. `Config.iterations` and all schedules count views, not steps.
"""

import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from nexwarp.data import Scene
from nexwarp.errors import DivergedError, RankError, SceneError
from nexwarp.machine import derived_seed, needed_memory
from nexwarp.model.graphs import Gradients, StepResult, UpdateError, capturing
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import NeuralTexture, Texture
from nexwarp.train.checkpoint import Snapshot
from nexwarp.train.ranks.ranks import GradientReducer, Ranks
from nexwarp.train.recipe import Config
from nexwarp.train.target import Target
from nexwarp.train.trainer import Trainer

# Gradients of more bytes are summed after a step's CUDA graph, not inside. On two H100s a step with 18 MB takes 2.60 ms
# with them inside and 3.63 after, one with 113 MB 7.99 and 7.15: there the sums slow down the kernels beside them.
MOST_CAPTURED_BYTES = 48_000_000


class ParallelTrainer(Trainer):
    """A training run on several ranks, each of which has one of these; all methods of `Trainer` are collective.

    Views are drawn in one order, which all ranks know. The random numbers of a view follow from the seed and its place
    in the training, whatever rank renders it; other choices come from generators that are alike on all ranks. Rank 0
    writes and reads checkpoints, which any number of ranks can resume.
    """

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device | str,
        ranks: Ranks,
        *,
        beside: bool | None = None,
        **options: Any,
    ) -> None:
        """Make the same initial surfels and texture on all ranks, of the same scene, config and options of `Trainer`.

        `beside` sums gradients after a CUDA graph instead of inside; None decides by `sums_beside`. SceneError where
        there are fewer training views than ranks, RankError where scene or settings differ between ranks.
        """
        views = len(scene.train)
        if views < ranks.size:
            raise SceneError(
                f"{scene.path}: expected at most as many ranks as training views, {views}, got {ranks.size}"
            )
        super().__init__(scene, config, device, **options)
        self.ranks = ranks
        ranks.check_same(
            {
                "settings": hashlib.sha256(json.dumps(config.as_dict(), sort_keys=True).encode()).hexdigest()[:12],
                "training cameras": self.origin["views"][:12],
                "scene": self.origin["scene"][:12],
                "background": str(self.background),
                "teachers": self.origin.get("teachers", "")[:12],
            }
        )
        # The same already, unless the ranks' processors round differently.
        ranks.share_tensors(x for _, x in self._named_parameters())
        if self.poses is not None:
            ranks.share_tensors(self.poses.buffers())
        self.texture.drop_half_copy()
        grid = self.texture.grid if isinstance(self.texture, NeuralTexture) and config.max_hits else None
        if beside is None:
            beside = sums_beside(ranks.backend, self.surfels, self.texture, config)
        self.beside = self.graphs is not None and beside
        self.reducer = GradientReducer(grid)
        self.reducer.overlapped = not self.beside
        self.targets.generator, self.targets.noise = torch.Generator(), torch.Generator(self.device)
        self.share = 1.0 / ranks.size
        scale_for_batch(self.optimizer, ranks.size)

    def _next_target(self) -> Target:
        ranks, first = self.ranks, self.iteration
        self.views_a_step = max(1, min(ranks.size, self.config.iterations - first))
        chosen = [self.targets.next_view(number) for number in range(first + 1, first + 1 + self.views_a_step)]
        # Where views of the last step are fewer than ranks, the others repeat one with weight 0.
        self.share = 1.0 / self.views_a_step if ranks.rank < self.views_a_step else 0.0
        mine = ranks.rank % self.views_a_step
        self.iteration += self.views_a_step
        for offset, generator in enumerate((self.targets.generator, self.targets.noise)):
            generator.manual_seed(derived_seed(self.config.seed, first + mine + 1, offset))
        return self.targets.make(chosen[mine], first + mine + 1)

    def _run_step(self, target: Target) -> StepResult:
        result = super()._run_step(target)
        if result.gradients is not None:
            gradients, errors = result.gradients
            for parameter, gradient in zip(self._trained(), gradients, strict=True):
                parameter.grad = gradient  # summed in place: the next replay overwrites it
            try:
                self._reduce(errors)
            finally:
                self.optimizer.zero_grad(set_to_none=True)
            result = result._replace(losses=result.losses | self.take_grid_loss())
        return result

    def _optimize(self, target: Target) -> StepResult:
        try:
            return super()._optimize(target)
        except (MemoryError, RuntimeError) as error:
            sent, self.reducer.sent = self.reducer.sent, None
            needed = needed_memory(error)
            if sent is None or needed is None or capturing(self.device):
                raise
            # The other ranks have part of the step: it cannot be repeated here.
            raise UpdateError(f"out of memory while gradients were sent: needed {needed}", needed) from None

    def _update(self, errors: torch.Tensor | None) -> Gradients | None:
        if self.beside:
            return Gradients([x.grad for x in self._trained()], errors)
        self._reduce(errors)
        return None

    def _reduce(self, errors: torch.Tensor | None) -> None:
        if errors is not None and self.share == 0:
            errors = torch.zeros_like(errors)
        super()._update(self.reducer.finish(self._trained(), errors))

    def _unneeded(self) -> torch.Tensor:
        cameras = self.views.refined_cameras(self.poses)[self.ranks.rank :: self.ranks.size]
        return self.densifier.unneeded(self.model(), cameras, self.ranks.largest)

    def _trained(self) -> list[nn.Parameter]:
        return [x for group in self.optimizer.param_groups for x in group["params"]]

    def check(self) -> None:
        """Raise DivergedError, the same on all ranks, unless all numbers are finite; RankError where ranks differ."""
        fault: DivergedError | None = None
        try:
            super().check()
        except DivergedError as error:
            fault = error
        sums = [x.detach().view(torch.int32).sum(dtype=torch.int64) for _, x in self._named_parameters()]
        mine = {"fault": None if fault is None else str(fault), "sums": torch.stack(sums).tolist()}
        records = self.ranks.gather(mine)
        for rank, record in enumerate(records):
            if record["fault"] is not None:
                raise DivergedError(record["fault"])
            if record["sums"] != records[0]["sums"]:
                raise RankError(
                    f"rank {rank}: its parameters at iteration {self.iteration:,} differ from those of rank 0"
                )

    def _write(self, run: Path, snapshot: Snapshot) -> None:
        if self.ranks.first:
            super()._write(run, snapshot)

    def _read(self, run: Path, warn: Callable[[str], None]) -> Snapshot:
        from safetensors.torch import load, save

        snapshot = super()._read(run, warn) if self.ranks.first else None
        content = None if snapshot is None else save(snapshot.tensors)
        state = self.ranks.share(None if snapshot is None else snapshot.state)
        return Snapshot(load(self.ranks.share_bytes(content)), state)

    def load_snapshot(self, snapshot: Snapshot) -> None:
        """Return to a snapshot of this run, on whatever number of ranks it was taken."""
        super().load_snapshot(snapshot)
        scale_for_batch(self.optimizer, self.ranks.size)


def sums_beside(backend: str, surfels: Surfels, texture: Texture, config: Config) -> bool:
    """Whether gradients are better summed after a step's CUDA graph: the backend cannot be captured, or there are many.

    The surfels are counted as many as they may become.
    """
    a_surfel = sum(x.numel() // max(len(surfels), 1) for x in surfels.parameters())
    count = a_surfel * config.max_surfels + sum(x.numel() for x in texture.parameters() if config.max_hits)
    return backend != "nccl" or 4 * count > MOST_CAPTURED_BYTES


def scale_for_batch(optimizer: torch.optim.Optimizer, views: int) -> None:
    """Change the rates of a fresh optimizer from those for single views to those for a mean over several.

    The square-root rule for Adam (Malladi et al. 2022, On the SDEs and scaling rules for adaptive gradient algorithms):
    rates are multiplied by the square root of the number of views, and moments forget as much in a step as in that
    many steps of one view.
    """
    for group in optimizer.param_groups:
        first, last = group["ends"]
        group["ends"] = first * math.sqrt(views), last * math.sqrt(views)
        group["betas"] = tuple(beta**views for beta in group["betas"])
