"""Training: the loop of paper Sec. 4.3, as a class that the command line and `nexwarp.train` drive."""

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property, partial, reduce
from pathlib import Path

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.cameras_file import CAMERAS_FILE, save_cameras
from nexwarp.data import Scene, View
from nexwarp.errors import CheckpointError, DivergedError, OutOfMemoryError, SceneError
from nexwarp.io.files import one_line
from nexwarp.machine import deterministic, needed_memory, seed_everything, torch_threads
from nexwarp.model.exposures import Exposures
from nexwarp.model.graphs import Gradients, GraphKey, StepGraphs, StepResult, beside, can_capture, graph_key, updating
from nexwarp.model.model import Model
from nexwarp.model.model_file import save_model
from nexwarp.model.options import RenderOptions
from nexwarp.model.render import draw
from nexwarp.model.surfels import PARAMETERS, Surfels
from nexwarp.model.texture import NeuralTexture
from nexwarp.train.adam import FusedAdam
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from nexwarp.train.densify import Densifier
from nexwarp.train.exposure import Calibrate, calibrate_exposures
from nexwarp.train.finish.finish import FinishObserver, FinishSettings, finish_model
from nexwarp.train.health import LossLog, StepFacts, check_health, go_back, oom_message, watched_tensors
from nexwarp.train.initial import cells_unit, initial_poses, initial_surfels, model_facts, texture_shape
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.recipe import Config
from nexwarp.train.relocation import least_contributing
from nexwarp.train.report import StepReport
from nexwarp.train.schedules import OptimizerMaker, densify_schedule, make_optimizer, options_at, set_rates
from nexwarp.train.state import (
    Snapshot,
    check_origin,
    check_snapshot,
    gather_optimizer,
    gather_random,
    known_part,
    learned_tensors,
    named_parameters,
    restore_optimizer,
    restore_random,
    scene_digest,
)
from nexwarp.train.step_losses import OwnLoss, as_taken, check_own_losses, step_losses
from nexwarp.train.target import Target, TargetMaker, refined
from nexwarp.train.teachers import make_teachers
from nexwarp.train.views import TrainingViews, mean_color, with_cameras

# Iterations between checks that all numbers are finite, and snapshots that a run takes, one replacing the other.
CHECK_EVERY = 100
SNAPSHOTS = 10


class Trainer:
    """A training run: `run` is the loop, `step` one iteration of it, `finish` makes the model.

    Attributes:
        scene: what is learned from.
        config: settings.
        device: of the training.
        surfels: as they are now.
        texture: as it is now; untrained where K is 0.
        optimizer: of both.
        densifier: density control.
        views: the training views on the device.
        exposures: of the training photos; None where they have one exposure.
        poses: corrections of the training poses; None where they stay as given.
        teachers: other models of the scene that every other step learns from; None where there are none.
        background: colour behind everything, three numbers.
        iteration: steps done.
        seconds: that the steps took, in all sessions of the run.
        rate_factor: multiplies all learning rates; less than 1 after the run has gone back.
        views_a_step: number of views of the last step: 1, or that of the ranks.
        ranks: the processes that train together; here one.
    """

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device | str,
        *,
        losses: Mapping[str, OwnLoss] | None = None,
        optimizer: OptimizerMaker | None = None,
        teachers: Iterable[Model] = (),
        calibrate: Calibrate = calibrate_exposures,
    ) -> None:
        """Make the initial surfels and texture.

        Args:
            scene: what to learn from.
            config: settings.
            device: where to train.
            losses: own losses by name, added to ours; see `nexwarp.train`.
            optimizer: makes an optimizer of the parameter groups; None is Adam; see `nexwarp.train`.
            teachers: trained models of the scene, to learn from their renderings too; see `nexwarp.train`.
            calibrate: estimates the photos' exposures.

        Raises:
            SceneError: the scene has no training views.
            TypeError, ValueError: own losses, the optimizer or teachers do not fit.
        """
        if not scene.train:
            raise SceneError(f"{scene.path}: expected at least one training view, got none")
        self.scene, self.config, self.device = scene, config, torch.device(device)
        self.own_losses, self.own_optimizer = check_own_losses(losses), optimizer
        self.teachers = make_teachers(teachers, scene, config, self.device)
        seed_everything(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.noise = torch.Generator(self.device).manual_seed(config.seed)
        calibration = calibrate(scene, config)
        self.surfels, self.texture = self._initial_model(None if calibration is None else calibration.colors)
        self.cells_unit, self.poses = cells_unit(scene, config), initial_poses(scene, config, self.device)
        self.optimizer = self._make_optimizer()
        self.densifier = Densifier(densify_schedule(config), self.surfels, config.max_surfels)
        self.iteration, self.seconds, self.rate_factor, self.order = 0, 0.0, 1.0, list[int]()
        self.exposures: Exposures | None = None if calibration is None else calibration.exposures
        gains = None if calibration is None else calibration.gains
        self.views = TrainingViews(scene.train, self.device, gains, self.exposures)
        self.background = config.background or scene.background or mean_color(scene.train, calibration)
        self.targets = TargetMaker(scene, config, self.views, self.background, self.generator, self.noise, self.poses)
        self.views_a_step, self.ranks = 1, Ranks.alone(self.device)
        capture = config.cuda_graphs and self.device.type == "cuda" and can_capture(self.optimizer)
        self.graphs: StepGraphs[Target] | None = StepGraphs(self.device) if capture else None
        self.loss_log, self.checked = LossLog(), 0
        self.good: Snapshot | None = None

    def run(
        self,
        observe: Callable[[StepReport], None] | None = None,
        warn: Callable[[str], None] = lambda _: None,
        until: int | None = None,
    ) -> None:
        """Train until `config.iterations`, or `until` an earlier one, calling `observe` after each step.

        Losses, parameters and the optimizer's state are checked every CHECK_EVERY iterations, before each checkpoint
        and at the end. Where one is not finite, training goes back to the last good state, once, with half the
        learning rates, and tells `warn`.

        Raises:
            DivergedError: something was not finite again; the trainer is in its last good state.
            OutOfMemoryError: a step needs more memory than there is; the trainer is in the middle of that step.
        """
        total = self.config.iterations
        last = total if until is None else min(until, total)
        if self.iteration < last:
            self.good = self.snapshot()
        with torch_threads(self.views.torch_threads(self.config.max_hits)):
            while self.iteration < last:
                try:
                    start = time.perf_counter()
                    report = self.step()
                    if self.iteration >= last and self.device.type == "cuda":
                        torch.cuda.synchronize(self.device)
                    self.seconds += time.perf_counter() - start
                    self.loss_log.note(self.iteration, report.losses)
                    keep = report.passed(max(total // SNAPSHOTS, 1))
                    if keep or report.passed(CHECK_EVERY) or self.iteration >= last:
                        self.check()
                    if keep:
                        self.good = self.snapshot()
                    if observe is not None:
                        observe(report)
                except DivergedError as fault:
                    assert self.good is not None
                    warn(go_back(self, self.good, fault))
                except (MemoryError, RuntimeError) as error:
                    if (needed := needed_memory(error)) is None:
                        raise
                    camera, graphs = self.scene.train[0].camera, self.graphs is not None
                    told = oom_message(needed, self._facts(), camera, self.config, self.device, graphs=graphs)
                    raise OutOfMemoryError(told) from error

    def step(self) -> StepReport:
        """Do one iteration: a view, its rendering, the losses, the optimizer, and density control when it is due."""
        fixed_order = deterministic(self.config.deterministic and self.device.type == "cuda")
        with fixed_order, torch.autocast(self.device.type, enabled=False):
            target = self._next_target()
            set_rates(self.optimizer, self.iteration, self.config.iterations, self.rate_factor)
            result = self._run_step(target)
            if self.densifier.due(self.iteration, self.views_a_step):
                unneeded = None
                if self.densifier.relocates(self.iteration, len(self.surfels)):
                    cameras, share = self.views.refined_cameras(self.poses), self.config.densify.relocate
                    find = partial(least_contributing, self.model(), cameras, share, self.ranks)
                    unneeded = beside(self.graphs, find)
                self.densifier.step(self.surfels, self.optimizer, self.generator, unneeded)
            report = (self.iteration, len(self.surfels), result.losses, result.image, target.photo)
            return StepReport(*report, self.views_a_step)

    def _next_target(self) -> Target:
        self.iteration += 1
        return self._target(self._next_view(self.iteration), self.iteration, self.order[:-3:-1])

    def _target(self, index: int, number: int, upcoming: list[int]) -> Target:
        """Make the target of the view with that number in the training; see `TargetMaker.make`."""
        target = self.targets.make(index, self.iteration, upcoming)
        if self.teachers is None or not self.teachers.teaches(number):
            return target
        return beside(self.graphs, partial(self.teachers.target, target, number))

    def _initial_model(self, colors: torch.Tensor | None) -> tuple[Surfels, NeuralTexture]:
        surfels = initial_surfels(self.scene, self.config, self.generator, colors)
        return surfels.to(self.device), NeuralTexture(**texture_shape(self.scene, self.config)).to(self.device)

    def _make_optimizer(self) -> torch.optim.Optimizer:
        made = (self.config, self.scene.scale, self.own_optimizer, self.cells_unit, self.poses)
        return make_optimizer(self.surfels, self.texture, *made)

    def _next_view(self, number: int) -> int:
        """Return the index of the training view with that number in the training, from 1."""
        if self.teachers is not None and self.teachers.teaches(number):
            return self.teachers.choice(number)[0]
        if not self.order:
            self.order = torch.randperm(len(self.views), generator=self.generator).tolist()
        return self.order.pop()

    def _run_step(self, target: Target) -> StepResult:
        graphs = self.graphs
        return self._optimize(target) if graphs is None else graphs.run(target, self._optimize, self._graph_key())

    def _optimize(self, target: Target) -> StepResult:
        """Render, compare, differentiate and update: the GPU's part of a step, which a CUDA graph can repeat."""
        fused = self.optimizer if isinstance(self.optimizer, FusedAdam) else None
        try:
            target = refined(target, self.poses)
            own, poses, grid = self.own_losses, self.poses, fused is None
            options, background, jitter = self.render_options(), target.background, target.depth_jitter
            texture = self.texture if options.max_hits else None
            out = draw(self.surfels, texture, target.camera, options, background=background, jitter=jitter)
            taken = as_taken(out, target, plain=bool(own))
            given = (taken, target, self.surfels, self.texture, self.config)
            losses = step_losses(*given, cells_unit=self.cells_unit, own=own, grid_term=grid, poses=poses)
            image, room, request = taken.image.detach(), out.intermediates.tiles.room, None
            if self.densifier.active(self.iteration):
                errors = (image - target.photo).abs().mean(dim=-1)
                request = out.request_splat_error(errors if target.counts is None else errors * target.counts)
            del out, taken, given  # so that what the backward pass does not need is freed
            self._weighted(reduce(torch.add, losses.values())).backward()
            kept = self._update(None if request is None else request.sums_after_backward)
        finally:
            self.optimizer.zero_grad(set_to_none=True)
        # Without the autograd graph, which would keep this step's lists and buffers until the next step has its own.
        losses = {name: value.detach() for name, value in losses.items()}
        if kept is None and fused is not None and fused.grid_loss is not None:
            losses["grid"], fused.grid_loss = fused.grid_loss, None
        return StepResult(losses, image, room, kept)

    def _weighted(self, loss: torch.Tensor) -> torch.Tensor:
        return loss

    def _update(self, errors: torch.Tensor | None) -> Gradients | None:
        """Update the parameters by their gradients, and the densifier's sums by the errors (N,) of the step's view."""
        with updating():
            self.optimizer.step()
            if self.poses is not None:
                self.poses.keep_gauge()
            if errors is not None:
                self.densifier.accumulate(errors)
        return None

    def _graph_key(self) -> GraphKey:
        tensors = [self.densifier.errors, *(parameter for _, parameter in self._named_parameters())]
        key = graph_key(self.render_options(), self.optimizer, tensors, densify=self.densifier.active(self.iteration))
        return key._replace(kernels=(key.kernels, self.texture.half_copy_key()))

    def model(self) -> Model:
        """Return the model as it is now: the trainer's own surfels and texture, at the photos' mean exposure."""
        meta = model_facts(self.scene, self.config, self.iteration)
        return Model(self.surfels, self.texture, options=self.render_options(), meta=meta)

    def render_options(self) -> RenderOptions:
        """Return how the scene is rendered at this point of the run."""
        return options_at(self.config, self.iteration, self.background, self.texture.sh_degree)

    def finish(self, observe: FinishObserver = lambda *_: None) -> Model:
        """Return a finished model of new surfels and the trainer's texture: smooth SH, detail limits, exposures.

        Args:
            observe: called with each stage's name, how many views of it are rendered, and of how many.
        """
        if self.graphs is not None:
            self.graphs.clear()  # frees their memory; later steps are captured anew
        self.texture.drop_half_copy()
        settings = FinishSettings(self.config.smooth_sh, self.config.footprints, self.config.deterministic)
        with torch.autocast(self.device.type, enabled=False):
            return finish_model(self.model(), *self._finish_views(), self.exposures, settings, observe)

    def _finish_views(self) -> tuple[list[View], list[Camera]]:
        cameras = self.views.refined_cameras(self.poses)
        return with_cameras(self.scene.train, cameras), cameras

    def check(self) -> None:
        """Raise DivergedError unless all losses since the last check, parameters and optimizer state are finite."""
        facts, self.checked = self._facts(), self.iteration
        check_health(self.loss_log, self._watched(), facts)

    def _facts(self) -> StepFacts:
        return StepFacts(self.iteration, self.checked, len(self.surfels), self.rate_factor)

    def _watched(self) -> dict[str, torch.Tensor]:
        return watched_tensors(self._named_parameters(), self.optimizer) | {"densify.errors": self.densifier.errors}

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write a checkpoint, the model as it is, and the cameras into a folder, which the commands open."""
        Path(folder).mkdir(parents=True, exist_ok=True)
        self.save_checkpoint(Path(folder))
        save_model(folder, self.model())
        save_cameras(Path(folder, CAMERAS_FILE), self.scene.cameras)

    def save_checkpoint(self, run: Path) -> None:
        """Write a checkpoint into a folder: everything that shapes the future of the run.

        Raises:
            DivergedError: something in it is not finite.
            OSError: it cannot be written; those before it are as they were.
        """
        self.check()
        if self.good is None or self.good.state["iteration"] != self.iteration:
            self.good = self.snapshot()
        self._write(run, self.good)

    def _write(self, run: Path, snapshot: Snapshot) -> None:
        save_checkpoint(run, *snapshot)

    def _read(self, run: Path, warn: Callable[[str], None]) -> Snapshot:
        return Snapshot(*load_checkpoint(run, warn))

    def restore(self, run: Path | str, warn: Callable[[str], None] = lambda _: None, *, extend: bool = False) -> None:
        """Continue from the newest whole checkpoint of the same scene and settings.

        Args:
            run: run folder.
            warn: is told of a damaged checkpoint that is passed over.
            extend: also accept a checkpoint of a run of fewer iterations; schedules are those of `config.iterations`.

        Raises:
            FileNotFoundError: there is none.
            ValueError: they are damaged, or scene, settings, optimizer or teachers differ.
        """
        snapshot = self._read(Path(run), warn)
        try:
            origin = self.views.fingerprint(), self._scene_digest, self._teachers_digest
            check_origin(snapshot, self.config, *origin, extend=extend)
            check_snapshot(snapshot, len(self.views), self.config.iterations)
            self.load_snapshot(snapshot)
        except (KeyError, IndexError, TypeError, AttributeError, OverflowError, ValueError, RuntimeError) as error:
            told = one_line(f"it has no {error}" if isinstance(error, KeyError) else str(error))  # torch's are long
            raise CheckpointError(f"{run}: expected a checkpoint of this run, but it does not fit ({told})") from None

    def snapshot(self) -> Snapshot:
        """Return everything that shapes the future of the run, as copies on the CPU."""
        moments, optimizer = gather_optimizer(self.optimizer, dict(self._named_parameters()))
        numbers, generators = gather_random(self.generator, self.noise, self.device)
        tensors = learned_tensors(self.surfels, self.texture, self.poses) | moments
        tensors |= {"densify.errors": self.densifier.errors, **numbers}
        state = {"iteration": self.iteration, "seconds": self.seconds, "order": list(self.order), **generators}
        state |= {"views": self.views.fingerprint(), "scene": self._scene_digest, "config": self.config.as_dict()}
        state |= {"rate_factor": self.rate_factor} | ({} if optimizer is None else {"optimizer": optimizer})
        state |= {"teachers": self._teachers_digest} if self.teachers is not None else {}
        return Snapshot({name: x.detach().to("cpu", copy=True) for name, x in tensors.items()}, state)

    def load_snapshot(self, snapshot: Snapshot) -> None:
        """Return to a snapshot of this run, which stays as it is; ValueError or RuntimeError where it does not fit."""
        tensors, state = {name: x.clone() for name, x in snapshot.tensors.items()}, snapshot.state
        self.surfels = Surfels(known_part(tensors, "surfels.", PARAMETERS)).to(self.device)
        self.texture.load_state_dict(known_part(tensors, "texture.", self.texture.state_dict()))
        if self.poses is not None:
            self.poses.load(tensors["poses.corrections"])
        self.optimizer = self._make_optimizer()
        restore_optimizer(self.optimizer, dict(self._named_parameters()), tensors, state.get("optimizer"))
        self.densifier = Densifier(densify_schedule(self.config), self.surfels, self.config.max_surfels)
        if tensors["densify.errors"].shape != self.densifier.errors.shape:
            raise ValueError(f"densify.errors: expected one for each of {len(self.surfels)} surfels")
        self.densifier.errors = tensors["densify.errors"].to(self.device)
        restore_random(self.generator, self.noise, self.device, Snapshot(tensors, state))
        if self.graphs is not None:
            self.graphs.clear()
        self.iteration, self.seconds, self.order = state["iteration"], state["seconds"], list(state["order"])
        self.rate_factor, self.loss_log, self.checked = state["rate_factor"], LossLog(), self.iteration

    @cached_property
    def _scene_digest(self) -> str:
        return scene_digest(self.scene, self.texture)

    @cached_property
    def _teachers_digest(self) -> str:
        return "" if self.teachers is None else self.teachers.digest()

    def _named_parameters(self) -> Iterator[tuple[str, torch.nn.Parameter]]:
        return named_parameters(self.surfels, self.texture, self.poses)
