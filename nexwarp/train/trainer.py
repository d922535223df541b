"""Training: the loop of paper Sec. 4.3, as a class that the command line and `nexwarp.train` drive."""

import os
import time
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property, partial
from pathlib import Path

import torch
from typing_extensions import Unpack

from nexwarp.cameras.cameras_file import CAMERAS_FILE, save_cameras
from nexwarp.data import Scene
from nexwarp.errors import CheckpointError, OutOfMemoryError, SceneError
from nexwarp.io.files import one_line
from nexwarp.machine import deterministic, needed_memory, seed_everything, torch_threads
from nexwarp.model.graphs import Gradients, GraphKey, StepGraphs, StepResult, beside, updating
from nexwarp.model.model import Model
from nexwarp.model.render import Frame, draw
from nexwarp.train.checkpoint import Snapshot, load_checkpoint, save_checkpoint
from nexwarp.train.exposure import Calibrate, calibrate_exposures
from nexwarp.train.finish import FinishObserver, finish_model
from nexwarp.train.initial import Start, check_start
from nexwarp.train.losses import OwnLoss, as_taken, check_own_losses, step_losses
from nexwarp.train.optimizer import set_rates
from nexwarp.train.recipe import Config
from nexwarp.train.report import StepReport, check_health, oom_message
from nexwarp.train.state import TrainingState, check_origin, check_snapshot, scene_digest
from nexwarp.train.target import Target, TargetSource, TaughtTargets, check_teachers, refined, teachers_digest

CHECK_EVERY = 100  # iterations between checks that all numbers are finite
SHARPEN_EVERY = 10  # iterations between two calls of `Surfels.sharpen`


class Trainer(TrainingState):
    """A training run: `run` is the loop, `step` one iteration of it, `finish` makes the model.

    Attributes, beside those of `TrainingState`:
        targets: what steps compare their renderings with.
        exposures: of the training photos; None where they have one exposure.
        graphs: CUDA graphs of steps; None where steps are launched kernel by kernel.
        views_a_step: number of views of the last step: 1, or that of the ranks.
        share: factor of the gradients: 1, or this rank's share in the mean over these views.
    """

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device | str,
        *,
        losses: Mapping[str, OwnLoss] | None = None,
        teachers: Iterable[Model] = (),
        calibrate: Calibrate = calibrate_exposures,
        **start: Unpack[Start],
    ) -> None:
        """Make the initial surfels and texture.

        Args:
            scene: what to learn from.
            config: settings.
            device: where to train.
            losses: own losses by name, as for `nexwarp.train`.
            teachers: trained models of the scene, to learn from their renderings too.
            calibrate: estimates the photos' exposures.
            start: `surfels`, `init` and `texture`, as for `nexwarp.train`.

        Raises:
            SceneError: the scene has no training views.
            TypeError, ValueError: own losses, teachers or what to start from do not fit.
        """
        if not scene.train:
            raise SceneError(f"{scene.path}: expected at least one training view, got none")
        device, self.own_losses = torch.device(device), check_own_losses(losses)
        models = check_teachers(teachers, scene, config)
        check_start(scene, config, start)
        seed_everything(config.seed)
        calibration = calibrate(scene, config)
        super().__init__(scene, config, device, None if calibration is None else calibration.colors, start)
        self.exposures = None if calibration is None else calibration.exposures
        self.graphs = StepGraphs(device) if config.cuda_graphs and device.type == "cuda" else None
        self.targets = (
            TaughtTargets(self, calibration, models, partial(beside, self.graphs))
            if models
            else TargetSource(self, calibration)
        )
        self.views, self.background = self.targets.views, self.targets.background
        self.views_a_step, self.share = 1, 1.0
        self.noted: list[tuple[int, str, torch.Tensor]] = []  # losses since the last check

    def run(self, observe: Callable[[StepReport], None] | None = None, until: int | None = None) -> None:
        """Train until `config.iterations`, or `until` an earlier one, calling `observe` after each step.

        Losses, parameters and the optimizer's state are checked every CHECK_EVERY iterations, before each checkpoint
        and at the end.

        Raises:
            DivergedError: something is not finite.
            OutOfMemoryError: a step needs more memory than there is; the trainer is in the middle of that step.
        """
        total = self.config.iterations
        last = total if until is None else min(until, total)
        with torch_threads(self.views.torch_threads(self.config.max_hits)):
            while self.iteration < last:
                try:
                    start = time.perf_counter()
                    report = self.step()
                    self.noted += [(self.iteration, name, value.detach()) for name, value in report.losses.items()]
                    if report.passed(CHECK_EVERY) or self.iteration >= last:
                        self.check()  # which waits for the GPU
                    self.seconds += time.perf_counter() - start
                    if observe is not None:
                        observe(report)
                except (MemoryError, RuntimeError) as error:
                    if (needed := needed_memory(error)) is None:
                        raise
                    raise OutOfMemoryError(oom_message(self, needed, graphs=self.graphs is not None)) from error

    def step(self) -> StepReport:
        """Do one iteration: a view, its rendering, the losses, the optimizer, and density control when it is due."""
        fixed_order = deterministic(self.config.deterministic and self.device.type == "cuda")
        with fixed_order, torch.autocast(self.device.type, enabled=False):
            target = self._next_target()
            set_rates(self.optimizer, self.iteration, self.config.iterations)
            result = self._run_step(target)
            if self.densifier.due(self.iteration, self.views_a_step):
                self._control_density()
            report = StepReport(
                self.iteration, len(self.surfels), result.losses, result.image, target.photo, self.views_a_step
            )
            if report.passed(SHARPEN_EVERY) or self.iteration >= self.config.iterations:
                self.surfels.sharpen(self.config.least_gamma_at(self.iteration))
            return report

    def _next_target(self) -> Target:
        self.iteration += 1
        index = self.targets.next_view(self.iteration)
        return self.targets.make(index, self.iteration)

    def _run_step(self, target: Target) -> StepResult:
        graphs = self.graphs
        return self._optimize(target) if graphs is None else graphs.run(target, self._optimize, self._graph_key())

    def _optimize(self, target: Target) -> StepResult:
        """Render, compare, differentiate and update: the GPU's part of a step, which a CUDA graph can repeat."""
        try:
            target, options = refined(target, self.poses), self.render_options()
            texture, jitter = self.texture if options.max_hits else None, target.depth_jitter
            out = draw(Frame(self.surfels, texture, target.camera, options, target.background, jitter=jitter))
            taken = as_taken(out, target, plain=bool(self.own_losses))
            losses = step_losses(taken, target, self, self.own_losses)
            image, room, request = taken.image.detach(), out.intermediates.tiles.room, None
            if self.densifier.active(self.iteration):
                errors = (image - target.photo).abs().mean(dim=-1)
                request = out.request_splat_error(errors if target.counts is None else errors * target.counts)
            del out, taken  # so that what the backward pass does not need is freed
            terms = [x for x in losses.values() if x.requires_grad]
            # The gradient of their sum, without adding them up.
            torch.autograd.backward(terms if self.share == 1 else [x * self.share for x in terms])
            gradients = self._update(None if request is None else request.sums_after_backward)
        finally:
            self.optimizer.zero_grad(set_to_none=True)
        # Without the autograd graph, which would keep this step's lists and buffers until the next step has its own.
        losses = {name: value.detach() for name, value in losses.items()}
        if gradients is None:
            losses |= self.take_grid_loss()
        return StepResult(losses, image, room, gradients)

    def _update(self, errors: torch.Tensor | None) -> Gradients | None:
        """Update the parameters by their gradients, and the densifier's sums by the errors (N,) of the step's view."""
        with updating():
            self.optimizer.step()
            if self.poses is not None:
                self.poses.keep_gauge()
            if errors is not None:
                self.densifier.accumulate(errors)
        return None

    def _control_density(self) -> None:
        """Split surfels of large errors, and remove those that are transparent or needed least."""
        unneeded = None
        if self.densifier.relocates(self.iteration):
            unneeded = beside(self.graphs, self._unneeded)
        along = [(self.texture, name) for name in self.texture.per_surfel]
        self.densifier.step(self.optimizer, self.generator, unneeded, along)

    def _unneeded(self) -> torch.Tensor:
        return self.densifier.unneeded(self.model(), self.views.refined_cameras(self.poses))

    def _graph_key(self) -> GraphKey:
        options, groups = self.render_options(), self.optimizer.param_groups
        moments = [x for state in self.optimizer.state.values() for x in state.values() if isinstance(x, torch.Tensor)]
        tensors = [self.densifier.errors, *(parameter for _, parameter in self._named_parameters()), *moments]
        return GraphKey(
            kernels=(
                self.densifier.active(self.iteration),
                options.max_hits,
                options.sh_degree,
                torch.are_deterministic_algorithms_enabled(),
                self.texture.half_copy_key(),
                self.share,
            ),
            tensors=(*((x.data_ptr(), x.shape) for x in tensors), *(group["lr"].data_ptr() for group in groups)),
        )

    def finish(self, observe: FinishObserver = lambda *_: None) -> Model:
        """Return a finished model of new surfels and the trainer's texture: smooth SH, detail limits, exposures."""
        if self.graphs is not None:
            self.graphs.clear()  # frees their memory; later steps are captured anew
        self.texture.drop_half_copy()
        with torch.autocast(self.device.type, enabled=False):
            views = self.views.refined(self.poses)
            return finish_model(self.model(), views, self.exposures, self.config, observe)

    def check(self) -> None:
        """Raise DivergedError unless all losses since the last check, parameters and optimizer state are finite."""
        noted, self.noted = self.noted, []
        check_health(self.iteration, noted, self._watched())

    def _watched(self) -> dict[str, torch.Tensor]:
        """Return what must stay finite, by the names that messages give it."""
        watched = {"densify.errors": self.densifier.errors}
        for name, parameter in self._named_parameters():
            # The gradient itself is freed by now; a gradient that is not finite shows in the optimizer's state.
            for key, value in self.optimizer.state.get(parameter, {}).items():
                if isinstance(value, torch.Tensor) and value.shape == parameter.shape:
                    watched[f"{key} of {name}"] = value
            watched[name] = parameter
        return watched

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write a checkpoint, the model as it is, and the cameras into a folder, which the commands open."""
        Path(folder).mkdir(parents=True, exist_ok=True)
        self.model().save(folder)  # which refuses a texture that files cannot hold
        self.save_checkpoint(Path(folder))
        save_cameras(Path(folder, CAMERAS_FILE), self.scene.cameras)

    def save_checkpoint(self, run: Path) -> None:
        """Write a checkpoint into a folder; DivergedError where something is not finite, OSError on a failing disk."""
        self.check()
        self._write(run, self.snapshot())

    def _write(self, run: Path, snapshot: Snapshot) -> None:
        save_checkpoint(run, *snapshot)

    def _read(self, run: Path, warn: Callable[[str], None]) -> Snapshot:
        return load_checkpoint(run, warn)

    def restore(self, run: Path | str, warn: Callable[[str], None] = lambda _: None, *, extend: bool = False) -> None:
        """Continue from the newest whole checkpoint of the same scene and settings; `warn` is told of damaged ones.

        `extend` also accepts one of a run of fewer iterations; schedules are those of `config.iterations`.

        Raises:
            MissingError: there is none.
            CheckpointError: they are damaged, or scene, settings or teachers differ.
        """
        snapshot = self._read(Path(run), warn)
        try:
            self.take_table_size(snapshot)
            check_origin(self.origin, self.config, snapshot.state, extend=extend)
            check_snapshot(snapshot, len(self.views), self.config.iterations)
            self.load_snapshot(snapshot)
        except (LookupError, TypeError, AttributeError, OverflowError, ValueError, RuntimeError) as error:
            reason = one_line(f"it has no {error}" if isinstance(error, KeyError) else str(error))  # torch's are long
            raise CheckpointError(f"{run}: expected a checkpoint of this run, but it does not fit ({reason})") from None

    def snapshot(self) -> Snapshot:
        """Return everything that shapes the future of the run, as copies on the CPU, and where it comes from."""
        tensors, state = super().snapshot()
        return Snapshot(tensors, state | self.origin | {"config": self.config.as_dict()})

    def load_snapshot(self, snapshot: Snapshot) -> None:
        """Return to a snapshot of this run, which stays as it is."""
        super().load_snapshot(snapshot)
        if self.graphs is not None:
            self.graphs.clear()
        self.noted = []

    @cached_property
    def origin(self) -> dict[str, str]:
        """Digests of what a checkpoint must have in common with this run: views, scene and, with any, teachers."""
        origin = {"views": self.views.fingerprint(), "scene": scene_digest(self.scene, self.texture)}
        return origin | ({"teachers": teachers_digest(self.targets.teachers)} if self.targets.teachers else {})
