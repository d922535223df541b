"""Training: the loop of paper Sec. 3.3, as a class that the command line drives."""

import copy
import dataclasses
import hashlib
import math
import random
import time
import zlib
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nexwarp.camera import visible_points
from nexwarp.data import Scene
from nexwarp.determinism import deterministic, seed_everything
from nexwarp.errors import CheckpointError, DivergedError, OutOfMemoryError, SceneError
from nexwarp.finish.auto_exposure import with_auto_exposure
from nexwarp.finish.detail_limits import measure_detail_limits
from nexwarp.finish.finish import counted
from nexwarp.finish.sh_smoothing import smooth_sh
from nexwarp.io.json_files import Json
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.render import Rendering, jitter_factors
from nexwarp.representation.surfels import Surfels
from nexwarp.representation.texture import NeuralTexture
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from nexwarp.train.config import Config
from nexwarp.train.densify import Densifier
from nexwarp.train.exposure_calibration import calibrate_exposures
from nexwarp.train.floaters import floaters, nearest_depth
from nexwarp.train.graphs import StepGraphs, StepResult
from nexwarp.train.health import LossLog, describe, needed_memory, not_finite
from nexwarp.train.initial import cells_unit, initial_surfels, texture_shape
from nexwarp.train.losses import border_loss, depth_loss, training_losses
from nexwarp.train.presets import config_from_dict
from nexwarp.train.schedules import densify_schedule, make_optimizer
from nexwarp.train.target import Target
from nexwarp.train.views import TrainingViews, mean_color

# Iterations between looks at whether all numbers are finite, and how many states a run keeps, one after another, to go
# back to when they are not.
CHECK_EVERY = 100
SNAPSHOTS = 10
LOWERED_RATES = 0.5

# Looks for floaters are so many times as far apart as rounds of densification.
FLOATERS_EVERY = 10


@dataclass(frozen=True)
class Progress:
    """What a training step tells its observer; the numbers cost a wait for the GPU, so they are asked for."""

    iteration: int
    surfels: int
    losses: dict[str, torch.Tensor]
    image: torch.Tensor
    target: torch.Tensor

    def loss(self) -> float:
        """Value of the loss."""
        return float(sum(x.detach() for x in self.losses.values()))

    def psnr(self) -> float:
        """PSNR of the step's training view in dB, from unrounded values."""
        error = (self.image.detach().clamp(0, 1) - self.target).square().mean()
        return -10.0 * math.log10(max(error.item(), 1e-10))


class Trainer:
    """State of a training run; `run` is the loop, `step` one iteration of it."""

    def __init__(self, scene: Scene, config: Config, device: torch.device | str) -> None:
        """Make the initial surfels and texture.

        Args:
            scene: what to learn from.
            config: settings.
            device: where to train.
        """
        if not scene.train:
            raise SceneError(f"{scene.path}: expected at least one training view, got none")
        self.scene, self.config, self.device = scene, config, torch.device(device)
        seed_everything(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.noise = torch.Generator(self.device).manual_seed(config.seed)
        self.surfels = initial_surfels(scene, config, self.generator).to(self.device)
        self.texture = NeuralTexture(**texture_shape(scene, config)).to(self.device)
        self.cells_unit = cells_unit(scene, config)
        self.optimizer = make_optimizer(self.surfels, self.texture, config, scene.scale)
        self.densifier = Densifier(densify_schedule(config), self.surfels, config.max_surfels)
        self.iteration = 0
        self.seconds = 0.0
        self.order: list[int] = []
        self.points: dict[tuple[int, int], tuple[torch.Tensor, torch.Tensor]] = {}
        self.exposures, gains = calibrate_exposures(scene, config)
        self.views = TrainingViews(scene.train, self.device, gains, self.exposures)
        self.background = config.background or scene.background or mean_color(scene.train)
        self.behind = torch.tensor(self.background, device=self.device)
        self.rate_factor = 1.0
        self.graphs = StepGraphs(self.device) if config.cuda_graphs and self.device.type == "cuda" else None
        self.loss_log, self.checked = LossLog(), 0
        self.good: tuple[dict[str, torch.Tensor], dict[str, Any]] | None = None

    def run(
        self,
        observe: Callable[[Progress], None] | None = None,
        warn: Callable[[str], None] = lambda _: None,
        until: int | None = None,
    ) -> None:
        """Train until `config.iterations`, or `until` an earlier one, calling `observe` after each step.

        Losses, parameters and Adam's moments are looked at every CHECK_EVERY iterations, before each checkpoint and at
        the end. Where one is not finite, training goes back to the last good state, once, with half the learning
        rates, and tells `warn`.

        Raises:
            DivergedError: something was not finite again; the trainer is in its last good state.
            OutOfMemoryError: a step needs more memory than there is; the trainer is in the middle of that step.
        """
        total = self.config.iterations
        last = total if until is None else min(until, total)
        if self.iteration < last:
            self.good = self._state()
        while self.iteration < last:
            try:
                start = time.perf_counter()
                progress = self.step()
                if self.iteration == last and self.device.type == "cuda":
                    torch.cuda.synchronize(self.device)
                self.seconds += time.perf_counter() - start
                self.loss_log.note(self.iteration, progress.losses)
                keep = self.iteration % max(total // SNAPSHOTS, 1) == 0
                if keep or self.iteration % CHECK_EVERY == 0 or self.iteration == last:
                    self.check()
                if keep:
                    self.good = self._state()
                if observe is not None:
                    observe(progress)
            except DivergedError as fault:
                self._go_back(fault, warn)
            except (MemoryError, RuntimeError) as error:
                if (needed := needed_memory(error)) is None:
                    raise
                raise OutOfMemoryError(self._oom_message(needed)) from error

    def check(self) -> None:
        """Raise DivergedError unless all losses since the last check, all parameters and Adam's moments are finite."""
        loss = self.loss_log.first_bad()
        tensors = self._watched()
        bad = not_finite(tensors)
        since, self.checked = self.checked, self.iteration
        if loss is None and not bad:
            return
        if loss is not None:
            when, name, value = loss
            told = f"iteration {when}: the loss {name!r} is {value}"
        else:
            span = f"{since + 1} to " if since + 1 < self.iteration else ""
            told = f"iteration {span}{self.iteration}: not finite"
        facts = [describe(name, tensors[name]) for name in bad]
        if len(facts) > 1:
            others = dict.fromkeys(name.rpartition(" ")[2] for name in bad)
            facts[0] += f" (in all: {', '.join(others)})"
        report = {
            "iteration": self.iteration,
            "checked_before": since,
            "loss": None if loss is None else {"iteration": loss[0], "term": loss[1], "value": str(loss[2])},
            "tensors": facts,
            "surfels": len(self.surfels),
            "rate_factor": self.rate_factor,
        }
        raise DivergedError("; ".join([told, *facts[:1]]), report)

    def _watched(self) -> dict[str, torch.Tensor]:
        watched: dict[str, torch.Tensor] = {}
        for name, parameter in self._named_parameters():
            state = self.optimizer.state.get(parameter, {})
            # A gradient is gone by now, but what it did to the moments is not.
            watched |= {f"gradient of {name}": state[key] for key in ("exp_avg",) if key in state}
            watched |= {f"squared gradient of {name}": state[key] for key in ("exp_avg_sq",) if key in state}
            watched[name] = parameter
        return watched | {"densify.errors": self.densifier.errors}

    def _go_back(self, fault: DivergedError, warn: Callable[[str], None]) -> None:
        """Return to the last good state with half the learning rates; raise when that was done before."""
        assert self.good is not None
        again = self.rate_factor < 1.0
        fault = self._locate_first_fault(fault)
        self._restore(*self.good)
        self.rate_factor = LOWERED_RATES
        if again:
            told = f"{fault}; it had gone back and halved its learning rates before, so training gives up"
            raise DivergedError(told, fault.report | {"good_iteration": self.iteration}) from None
        warn(f"{fault}; going back to iteration {self.iteration:,} with half the learning rates")

    def _locate_first_fault(self, fault: DivergedError) -> DivergedError:
        """Repeat the steps since the last good state, looking after each: what is not finite spreads within a few.

        Returns:
            The first fault met; where it does not come again, the one given.
        """
        assert self.good is not None
        until, rate_factor = self.iteration, self.rate_factor
        self._restore(*self.good)
        self.rate_factor = rate_factor
        try:
            while self.iteration < until:
                self.loss_log.note(self.iteration + 1, self.step().losses)
                self.check()
        except DivergedError as first:
            return first
        return fault

    def _oom_message(self, needed: str) -> str:
        camera = self.scene.train[0].camera
        place, used, graphs = "memory", "", ""
        if self.device.type == "cuda":
            free, total = torch.cuda.mem_get_info(self.device)
            place, used = "GPU memory", f", with {(total - free) / 2**30:.1f} of {total / 2**30:.1f} GiB in use"
            graphs = ", or do without CUDA graphs (--set cuda_graphs=false)" if self.graphs is not None else ""
        return (
            f"out of {place} at iteration {self.iteration}: it needed {needed}{used}, for {len(self.surfels):,} "
            f"surfels and photos of {camera.width}x{camera.height}; lower --max-surfels (now "
            f"{self.config.max_surfels:,}) or --max-hits (now {self.config.max_hits}), or raise --downscale{graphs}"
        )

    def step(self) -> Progress:
        """Do one iteration: a view, its rendering, the losses, Adam, and density control when it is due."""
        with deterministic(self.config.deterministic and self.device.type == "cuda"):
            return self._step()

    def _step(self) -> Progress:
        self.iteration += 1
        config = self.config
        coarse = self.iteration <= config.coarse * config.iterations
        index = self._next_view()
        view = self._view(index, 2 if coarse else 1)
        self._schedule_rates()
        if config.border > 0 and self.iteration % config.border_every == 0:
            view = self._beyond_the_frame(view)
        else:
            view = self._with_points(view, index)
        if config.depth_jitter > 0 and config.max_hits:
            hits = config.hits_at(self.iteration)
            drawn = jitter_factors(view.camera, hits, config.depth_jitter, generator=self.noise)
            view = dataclasses.replace(view, depth_jitter=drawn)
        learnt = self._learn(view) if self.graphs is None else self.graphs.run(view, self._learn, self._graph_key())
        if self.densifier.due(self.iteration):
            self.densifier.step(self.surfels, self.optimizer, self.generator)
        if self._floaters_due():
            self._remove_floaters(last=self.iteration == config.iterations)
        return Progress(self.iteration, len(self.surfels), learnt.losses, learnt.image, view.photo)

    def _floaters_due(self) -> bool:
        """Once densification is over, which would make others; and at the end."""
        densify = self.densifier.config
        due = self.iteration % (FLOATERS_EVERY * densify.every) == 0 or self.iteration == self.config.iterations
        return due and densify.floaters and self.iteration >= densify.stop and any(self._nearest)

    @cached_property
    def _nearest(self) -> list[float]:
        # Not before a look for floaters asks: it takes a second where photos and points are many.
        return [nearest_depth(view, self.scene.points) for view in self.scene.train]

    def _remove_floaters(self, last: bool) -> None:
        # What was behind has to be learnt: at the end, only large ones go, one of which can hide a whole view.
        # A generator of its own: where there are no floaters, nothing else changes.
        generator = torch.Generator().manual_seed(self.config.seed ^ self.iteration)
        chosen = floaters(self.model(), self.views.cameras, self._nearest, generator, last=last)
        self.densifier.remove(self.surfels, self.optimizer, chosen)

    def _learn(self, view: "Target") -> StepResult:
        """Render, compare, go back and step: the GPU's part, whose launches follow from `_graph_key` and shapes."""
        try:
            out = self.model().render(view.camera, background=view.background, depth_jitter=view.depth_jitter)
            losses = self._losses(out, view)
            request = None
            if self.densifier.active(self.iteration):
                errors = (out.image.detach() - view.photo).abs().mean(dim=-1)
                request = out.request_splat_error(errors if view.counts is None else errors * view.counts)
            sum(losses.values()).backward()
            self.optimizer.step()
            if request is not None and request.sums_after_backward is not None:
                self.densifier.accumulate(request.sums_after_backward)
        finally:
            self.optimizer.zero_grad(set_to_none=True)
        # Without their graph, which would keep this step's lists and buffers until the next one has its own.
        losses = {name: value.detach() for name, value in losses.items()}
        return StepResult(losses, out.image.detach(), out.intermediates.tiles.room)

    def _graph_key(self) -> Hashable:
        """What the launches of a step follow from, beside its target."""
        options, tensors = self.render_options(), [self.densifier.errors]
        for _, parameter in self._named_parameters():
            tensors += [parameter, *self.optimizer.state.get(parameter, {}).values()]
        return (
            len(self.surfels),
            self.densifier.active(self.iteration),
            options.max_hits,
            options.sh_degree,
            torch.are_deterministic_algorithms_enabled(),
            *(x.data_ptr() for x in tensors),
            *(group["lr"].data_ptr() for group in self.optimizer.param_groups),
        )

    def render_options(self) -> RenderOptions:
        """How the scene is rendered at this point of the run."""
        config = self.config
        unlocked = self.iteration // config.scaled(config.sh_every)
        return RenderOptions(
            max_hits=config.hits_at(self.iteration),
            background=self.background,
            sh_degree=min(max(config.sh_degree, self.texture.sh_degree), unlocked),
            low_pass=config.low_pass,
            clamp_texture=config.clamp_texture,
        )

    def _view(self, index: int, factor: int) -> "Target":
        """What a step is to show, from view `index` reduced by `factor`."""
        camera, photo = self.views.get(index, factor, self.order[:-3:-1])
        background: Any = self.background
        if self.scene.random_background:
            background = torch.rand(3, generator=self.generator).to(self.device, non_blocking=True)
            alpha = self.views.alpha(index, factor)
            if alpha is not None:
                photo = photo + (1 - alpha)[..., None] * (background - self.behind)
        mask = self.views.mask(index, factor)
        if mask is None or self.config.mask_mode == "ignore":
            return Target(camera, photo, background, counts=mask)
        behind = background if isinstance(background, torch.Tensor) else self.behind
        return Target(camera, torch.where(mask[..., None], photo, behind), background, empty=~mask)

    def _beyond_the_frame(self, view: "Target") -> "Target":
        """Shift the window at random; where it leaves the photo, the photo's edge goes on.

        What no photo shows would otherwise be left to chance, and every test view shows some of it at its edges.
        """
        camera, device = view.camera, self.device
        sizes = (camera.height, camera.width)
        shifts = (2 * torch.rand(2, generator=self.generator) - 1) * self.config.border * torch.tensor(sizes)
        top, left = (round(x) for x in shifts.tolist())
        rows = torch.arange(top, top + sizes[0], device=device)
        columns = torch.arange(left, left + sizes[1], device=device)
        inside = ((rows >= 0) & (rows < sizes[0]))[:, None] & ((columns >= 0) & (columns < sizes[1]))
        rows, columns = rows.clamp(0, sizes[0] - 1)[:, None], columns.clamp(0, sizes[1] - 1)
        known = None if view.counts is None else view.counts[rows, columns]
        return dataclasses.replace(
            view,
            camera=camera.crop(left, top, camera.width, camera.height),
            photo=view.photo[rows, columns],
            counts=inside if known is None else inside & known,
            empty=None if view.empty is None else view.empty[rows, columns],
            beyond=~inside if known is None else ~inside & known,
        )

    def _with_points(self, view: "Target", index: int) -> "Target":
        """Add the points that a view's depths are compared with, if there are any and somebody asks.

        Looks beyond the frame go without: theirs would be found anew for each, and a step is short.
        """
        points = self.scene.train[index].points
        if self.config.losses.depth == 0 or self.config.max_hits == 0 or points is None:
            return view
        camera = view.camera
        key = (index, camera.width)
        if key not in self.points:
            mask = view.counts if view.empty is None else ~view.empty
            seen = camera.project(points.to(self.device))
            found = visible_points(*seen, camera.width, camera.height, mask)
            none = torch.zeros(0, dtype=torch.int64, device=self.device), torch.zeros(0, device=self.device)
            self.points[key] = none if found is None else found
        places, expected = self.points[key]
        # As many for every view, so that all their steps are launched alike; also where they are not recorded, since
        # sums of other lengths are other bits.
        fill = self._most_points - len(places) if self.device.type == "cuda" else 0
        places, expected = (torch.nn.functional.pad(x, (0, fill)) for x in (places, expected))
        return dataclasses.replace(view, places=places, expected=expected)

    @cached_property
    def _most_points(self) -> int:
        return max(len(view.points) for view in self.scene.train if view.points is not None)

    def finish(self, observe: Callable[[str, int, int], None] = lambda *_: None) -> Model:
        """Return a model with surfels of its own: as they are now, and what the settings ask of a finished model.

        That is smooth SH, footprints and exposures, metered or not. The texture is the trainer's own.

        Args:
            observe: called with each stage's name, how many views of it are rendered, and of how many.
        """
        if self.graphs is not None:
            self.graphs.clear()  # for their memory; steps to come are recorded anew
        raw = {name: value.detach().clone() for name, value in self.surfels.state_dict().items()}
        model, cameras = Model(Surfels(raw), self.texture, options=self.render_options()), self.views.cameras
        if self.config.smooth_sh > 0:
            # The rest is the same whatever the order of threads.
            with deterministic(self.config.deterministic and self.device.type == "cuda"):
                views = counted(self.scene.train, "smoothing SH", observe)
                found = smooth_sh(model, views, self.config.smooth_sh)
            model.surfels.sh0.data, model.surfels.shN.data = found
        if self.config.footprints:
            looks = counted(cameras, "measuring footprints", observe)
            model.detail_limits = measure_detail_limits(model, looks)
        if self.exposures is not None:
            exposures = copy.deepcopy(self.exposures)
            if self.config.metering:
                progress = partial(observe, "metering exposures")
                exposures = with_auto_exposure(exposures, model, cameras, progress=progress)
            model.exposures = exposures.to(self.device)
        model.meta = self._meta() | {"smooth_sh": self.config.smooth_sh}
        return model

    def model(self) -> Model:
        """Return the model as it is now: the trainer's own surfels and texture, at the photos' mean exposure."""
        return Model(self.surfels, self.texture, options=self.render_options(), meta=self._meta())

    def _meta(self) -> dict[str, Json]:
        return {
            "near": self.scene.train[0].camera.near,
            "scene_scale": self.scene.scale,
            "preset": self.config.preset,
            "iteration": self.iteration,
        }

    def save(self, run: Path) -> None:
        """Write a checkpoint: everything that shapes the future of the run.

        Raises:
            DivergedError: something in it is not finite.
            OSError: it cannot be written; those before it are as they were.
        """
        self.check()
        if self.good is None or self.good[1]["iteration"] != self.iteration:
            self.good = self._state()
        save_checkpoint(run, *self.good)

    def checkpoint_size(self) -> int:
        """Bytes that a checkpoint takes at most, with as many surfels as the budget allows; the model takes less."""
        each = sum(p.numel() for p in self.surfels.parameters()) / max(len(self.surfels), 1)
        count = each * max(self.config.max_surfels, len(self.surfels)) + sum(
            p.numel() for p in self.texture.parameters()
        )
        return int(3 * 4 * count) + 2**20

    def _state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Everything that shapes the future of the run, as copies on the CPU."""
        tensors = {f"surfels.{k}": v for k, v in self.surfels.state_dict().items()}
        tensors |= {f"texture.{k}": v for k, v in self.texture.state_dict().items()}
        for name, parameter in self._named_parameters():
            for key, value in self.optimizer.state.get(parameter, {}).items():
                tensors[f"adam.{name}.{key}"] = torch.as_tensor(value)
        tensors["densify.errors"] = self.densifier.errors
        tensors["rng.views"] = self.generator.get_state()
        tensors["rng.noise"] = self.noise.get_state()
        tensors["rng.torch"] = torch.get_rng_state()
        if self.device.type == "cuda":
            tensors["rng.cuda"] = torch.cuda.get_rng_state(self.device)
        kind, keys, *rest = np.random.get_state()  # noqa: NPY002
        tensors["rng.numpy"] = torch.from_numpy(keys.astype(np.int64))
        state = {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "order": list(self.order),
            "views": self.views.fingerprint(),
            "numpy": [kind, *rest],
            "python": random.getstate(),
            "rate_factor": self.rate_factor,
            "scene": self._scene_digest,
            "config": self.config.as_dict(),
        }
        return {name: x.detach().to("cpu", copy=True) for name, x in tensors.items()}, state

    def restore(self, run: Path, warn: Callable[[str], None] = lambda _: None) -> None:
        """Continue from the newest whole checkpoint of the same scene and settings.

        Args:
            run: run folder.
            warn: is told of a damaged checkpoint that is passed over.

        Raises:
            FileNotFoundError: there is none.
            ValueError: they are damaged, or scene or settings differ.
        """
        tensors, state = load_checkpoint(run, warn)
        try:
            saved = dataclasses.replace(config_from_dict(state["config"]), cuda_graphs=self.config.cuda_graphs)
            if saved != self.config:
                raise ValueError("its settings are others")
            if state["views"] != self.views.fingerprint():
                raise ValueError("it has seen other training views than the scene has")
            if state["scene"] != self._scene_digest:
                raise ValueError("the scene's photos, masks or points have changed since")
            self._check_state(tensors, state)
            self._restore(tensors, state)
        except (KeyError, IndexError, TypeError, AttributeError, OverflowError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())  # torch's go over several lines
            raise CheckpointError(f"{run}: expected a checkpoint of this run, but it does not fit ({reason})") from None

    def _check_state(self, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> None:
        """Raise ValueError unless a checkpoint that others may have made says what one of this run can."""
        wrong = [k for k, v in tensors.items() if not k.startswith("rng.") and v.dtype != torch.float32]
        if wrong:
            raise ValueError(f"{wrong[0]}: expected float32, got {tensors[wrong[0]].dtype}")
        views, total = len(self.views), self.config.iterations
        for name, good in (
            ("iteration", lambda x: type(x) is int and 0 <= x <= total),
            ("seconds", lambda x: type(x) in (int, float) and 0 <= x < math.inf),
            ("order", lambda x: isinstance(x, list) and all(type(i) is int and 0 <= i < views for i in x)),
            ("rate_factor", lambda x: type(x) in (int, float) and 0 < x <= 1),
        ):
            if not good(state[name]):
                raise ValueError(f"{name}: cannot be {state[name]!r:.60}")

    def _restore(self, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> None:
        # Copies: what is restored may be restored again.
        tensors = {k: v.clone() for k, v in tensors.items()}
        raw = {k[8:]: v for k, v in tensors.items() if k.startswith("surfels.")}
        self.surfels = Surfels(raw).to(self.device)
        self.texture.load_state_dict({k[8:]: v for k, v in tensors.items() if k.startswith("texture.")})
        self.optimizer = make_optimizer(self.surfels, self.texture, self.config, self.scene.scale)
        for name, parameter in self._named_parameters():
            prefix = f"adam.{name}."
            entries = {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}
            wrong = [k for k, v in entries.items() if v.shape != (() if k == "step" else parameter.shape)]
            if wrong:
                raise ValueError(f"{prefix}{wrong[0]}: expected the shape of its parameter, {tuple(parameter.shape)}")
            if entries:
                self.optimizer.state[parameter] = {
                    k: v.to(parameter.device) if k != "step" or self.device.type == "cuda" else v
                    for k, v in entries.items()
                }
        self.densifier = Densifier(densify_schedule(self.config), self.surfels, self.config.max_surfels)
        if tensors["densify.errors"].shape != self.densifier.errors.shape:
            raise ValueError(f"densify.errors: expected one for each of {len(self.surfels)} surfels")
        self.densifier.errors = tensors["densify.errors"].to(self.device)
        self.generator.set_state(tensors["rng.views"])
        self.noise.set_state(tensors["rng.noise"])
        torch.set_rng_state(tensors["rng.torch"])
        if self.device.type == "cuda" and "rng.cuda" in tensors:
            torch.cuda.set_rng_state(tensors["rng.cuda"], self.device)
        kind, *rest = state["numpy"]
        np.random.set_state((kind, tensors["rng.numpy"].numpy().astype(np.uint32), *rest))  # noqa: NPY002
        version, internal, gauss = state["python"]
        random.setstate((version, tuple(internal), gauss))
        if self.graphs is not None:
            self.graphs.clear()
        self.iteration, self.seconds, self.order = state["iteration"], state["seconds"], list(state["order"])
        self.rate_factor = state["rate_factor"]
        self.loss_log, self.checked = LossLog(), self.iteration

    @cached_property
    def _scene_digest(self) -> str:
        """Digest of what training takes from the scene beside its cameras: photos, masks, points, scale."""
        digest = hashlib.sha256(f"{self.scene.scale} {self.texture.config}".encode())
        for view in self.scene.train:
            for values in (view.image, view.mask, view.alpha, view.points):
                if values is not None:  # CRC: photos are many, and nobody forges them
                    digest.update(zlib.crc32(values.contiguous().numpy()).to_bytes(4, "little"))
        for values in (self.scene.points, self.scene.colors):
            digest.update(values.contiguous().numpy())
        return digest.hexdigest()

    def _named_parameters(self) -> Iterator[tuple[str, torch.nn.Parameter]]:
        yield from ((f"surfels.{k}", v) for k, v in self.surfels.named_parameters())
        yield from ((f"texture.{k}", v) for k, v in self.texture.named_parameters())

    def _next_view(self) -> int:
        if not self.order:
            self.order = torch.randperm(len(self.views), generator=self.generator).tolist()
        return self.order.pop()

    def _losses(self, out: Rendering, view: "Target") -> dict[str, torch.Tensor]:
        textured, factors = self.config.max_hits > 0, self.config.losses
        losses = training_losses(
            image=out.image.clamp(0, 1) if self.config.clamp_image else out.image,
            textured=out.textured,
            weights=out.weights,
            target=view.photo,
            opacities=self.surfels.opacities,
            grid=self.texture.grid if textured else None,
            resolutions=self.texture.resolutions * self.cells_unit if textured else None,
            loss_weights=factors,
            mask=view.counts,
            empty=view.empty,
        )
        if view.beyond is not None and factors.border > 0:
            losses["border"] = factors.border * border_loss(out.image, view.photo, view.beyond)
        if view.empty is not None and factors.empty > 0:
            losses["empty"] = factors.empty * (out.alpha * view.empty).mean()
        if view.places is not None and view.expected is not None:
            losses["depth"] = factors.depth * depth_loss(out.depths, out.weights, view.places, view.expected)
        return losses

    def _schedule_rates(self) -> None:
        progress = (self.iteration - 1) / max(self.config.iterations - 1, 1)
        for group in self.optimizer.param_groups:
            first, last = group["ends"]
            rate = math.exp((1 - progress) * math.log(first) + progress * math.log(last)) if first else 0.0
            rate *= self.rate_factor
            if isinstance(group["lr"], torch.Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate
