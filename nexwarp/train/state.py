"""State of a training: everything that shapes its future, as a value that is gathered and put back bit for bit."""

import dataclasses
import hashlib
import math
import os
import random
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from nexwarp.cameras.cameras_file import CAMERAS_FILE, save_cameras
from nexwarp.data import Scene
from nexwarp.errors import CheckpointError, check_finite
from nexwarp.io.files import one_line
from nexwarp.io.json_files import Json
from nexwarp.model.bounds import check_bounds
from nexwarp.model.surfels import PARAMETERS, Surfels
from nexwarp.model.texture import NeuralTexture
from nexwarp.train.adam import FusedAdam
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from nexwarp.train.densify import Densifier
from nexwarp.train.initial import cells_unit, initial_poses, initial_surfels, texture_shape
from nexwarp.train.recipe import Config
from nexwarp.train.schedules import OptimizerMaker, densify_schedule, make_optimizer
from nexwarp.train.settings import config_from_dict, refuse_removed

ADAM_STATE = ("step", "exp_avg", "exp_avg_sq", "max_exp_avg_sq")  # their names, those of amsgrad too
FLOATS = ("surfels.", "texture.", "poses.", "adam.", "densify.")  # of tensors that are float32


class Snapshot(NamedTuple):
    """State of a training, on the CPU.

    Attributes:
        tensors: by name.
        state: the rest, JSON values.
    """

    tensors: dict[str, torch.Tensor]
    state: dict[str, Any]

    def save(self, run: Path) -> None:
        """Write a checkpoint into a run folder, whole or not at all; see `save_checkpoint`."""
        save_checkpoint(run, self.tensors, self.state)

    @classmethod
    def load(cls, run: Path, warn: Callable[[str], None]) -> "Snapshot":
        """Read the newest whole checkpoint of a run folder; see `load_checkpoint`."""
        return cls(*load_checkpoint(run, warn))


@contextmanager
def checkpoint_errors(run: Path | str) -> Iterator[None]:
    """Turn whatever a snapshot that does not fit raises into one CheckpointError."""
    try:
        yield
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError, ValueError, RuntimeError) as error:
        reason = one_line(f"it has no {error}" if isinstance(error, KeyError) else str(error))  # torch's are long
        raise CheckpointError(f"{run}: expected a checkpoint of this run, but it does not fit ({reason})") from None


class TrainingState:
    """What a training changes; `snapshot` is its value at one moment.

    Attributes:
        scene: what is learned from.
        config: settings.
        device: of the training.
        surfels: as they are now.
        texture: as it is now; untrained where K is 0.
        poses: corrections of the training poses; None where they stay as given.
        optimizer: of all of them.
        densifier: density control.
        generator: random numbers on the CPU.
        noise: random numbers on the device.
        order: indices of the views that are left of the epoch, the next one last.
        iteration: steps done.
        seconds: that the steps took, in all sessions of the run.
        rate_factor: multiplies all learning rates; less than 1 after the run has gone back.
    """

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device,
        colors: torch.Tensor | None = None,
        optimizer: OptimizerMaker | None = None,
    ) -> None:
        """Make the initial surfels and texture.

        Args:
            scene: what to learn from.
            config: settings.
            device: of the training.
            colors: (P, 3) colours of the scene's points; None takes the scene's own.
            optimizer: makes an optimizer of the parameter groups; None is Adam.
        """
        self.scene, self.config, self.device, self.own_optimizer = scene, config, device, optimizer
        self.generator = torch.Generator().manual_seed(config.seed)
        self.noise = torch.Generator(device).manual_seed(config.seed)
        self.surfels = initial_surfels(scene, config, self.generator, colors).to(device)
        self.texture = NeuralTexture(**texture_shape(scene, config)).to(device)
        self.cells_unit, self.poses = cells_unit(scene, config), initial_poses(scene, config, device)
        self.optimizer = self._make_optimizer()
        self.densifier = Densifier(densify_schedule(config), self.surfels, config.max_surfels)
        self.order: list[int] = []
        self.iteration, self.seconds, self.rate_factor = 0, 0.0, 1.0

    def _make_optimizer(self) -> torch.optim.Optimizer:
        options = (self.config, self.scene.scale, self.own_optimizer, self.cells_unit, self.poses)
        return make_optimizer(self.surfels, self.texture, *options)

    def facts(self) -> dict[str, Json]:
        """Return what a model says of its training; see `Model.meta`."""
        near, scale = self.scene.train[0].camera.near, self.scene.scale
        return {"near": near, "scene_scale": scale, "preset": self.config.preset, "iteration": self.iteration}

    def save_cameras(self, folder: str | os.PathLike[str]) -> None:
        """Write the scene's cameras into a folder, so that a model there can be rendered from them."""
        save_cameras(Path(folder, CAMERAS_FILE), self.scene.cameras)

    def take_grid_loss(self) -> dict[str, torch.Tensor]:
        """Return the grid's term of the loss, where the optimizer computes it, once after each of its steps."""
        optimizer = self.optimizer
        if not isinstance(optimizer, FusedAdam) or optimizer.grid_loss is None:
            return {}
        loss, optimizer.grid_loss = optimizer.grid_loss, None
        return {"grid": loss}

    def _named_parameters(self) -> Iterator[tuple[str, torch.nn.Parameter]]:
        """Yield all parameters with their names in a checkpoint."""
        yield from ((f"surfels.{name}", x) for name, x in self.surfels.named_parameters())
        yield from ((f"texture.{name}", x) for name, x in self.texture.named_parameters())
        if self.poses is not None:
            yield from ((f"poses.{name}", x) for name, x in self.poses.named_parameters())

    def snapshot(self) -> Snapshot:
        """Return copies on the CPU of everything that shapes the future."""
        tensors = {f"surfels.{name}": x for name, x in self.surfels.state_dict().items()}
        tensors |= {f"texture.{name}": x for name, x in self.texture.state_dict().items()}
        if self.poses is not None:
            tensors |= {f"poses.{name}": x for name, x in self.poses.state_dict().items()}
        moments, optimizer = gather_optimizer(self.optimizer, dict(self._named_parameters()))
        numbers, generators = _gather_random(self.generator, self.noise)
        tensors |= {**moments, "densify.errors": self.densifier.errors, **numbers}
        state = {"iteration": self.iteration, "seconds": self.seconds, "order": list(self.order), **generators}
        state |= {"rate_factor": self.rate_factor} | ({} if optimizer is None else {"optimizer": optimizer})
        return Snapshot({name: x.detach().to("cpu", copy=True) for name, x in tensors.items()}, state)

    def load_snapshot(self, snapshot: Snapshot) -> None:
        """Return to a snapshot, which stays as it is; ValueError or RuntimeError where it does not fit."""
        tensors, state = {name: x.clone() for name, x in snapshot.tensors.items()}, snapshot.state
        self.surfels = Surfels(_known_part(tensors, "surfels.", PARAMETERS)).to(self.device)
        self.texture.load_state_dict(_known_part(tensors, "texture.", self.texture.state_dict()))
        if self.poses is not None:
            self.poses.load(tensors["poses.corrections"])
        self.optimizer = self._make_optimizer()
        restore_optimizer(self.optimizer, dict(self._named_parameters()), tensors, state.get("optimizer"))
        self.densifier = Densifier(densify_schedule(self.config), self.surfels, self.config.max_surfels)
        if tensors["densify.errors"].shape != self.densifier.errors.shape:
            raise ValueError(f"densify.errors: expected one for each of {len(self.surfels)} surfels")
        self.densifier.errors = tensors["densify.errors"].to(self.device)
        _restore_random(self.generator, self.noise, Snapshot(tensors, state))
        self.order = list(state["order"])
        self.iteration, self.seconds, self.rate_factor = state["iteration"], state["seconds"], state["rate_factor"]


def _part(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Return the tensors whose names begin with a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): x for name, x in tensors.items() if name.startswith(prefix)}


def _known_part(tensors: Mapping[str, torch.Tensor], prefix: str, names: Collection[str]) -> dict[str, torch.Tensor]:
    """Return those of `_part` whose names are known; a newer version may have written others."""
    return {name: x for name, x in _part(tensors, prefix).items() if name in names}


def gather_optimizer(
    optimizer: torch.optim.Optimizer, parameters: Mapping[str, torch.nn.Parameter]
) -> tuple[dict[str, torch.Tensor], dict[str, Json] | None]:
    """Return the tensors of an optimizer's state, and the rest of it; None for Adam, which has only tensors.

    Args:
        optimizer: any of `torch.optim`.
        parameters: by their names in a checkpoint.

    Raises:
        TypeError: its state holds something else than tensors, numbers, text and None.
    """
    prefix, plain = _prefix(optimizer), {}
    tensors: dict[str, torch.Tensor] = {}
    for name, parameter in parameters.items():
        for key, value in optimizer.state.get(parameter, {}).items():
            if isinstance(value, torch.Tensor):
                tensors[f"{prefix}{name}.{key}"] = value
            elif _is_plain(value):
                plain[f"{name}.{key}"] = value
            else:
                kind = type(value).__name__
                raise TypeError(f"optimizer: expected a state of tensors and numbers, got {kind} for {name}.{key}")
    if _is_adam(optimizer):
        return tensors, None
    groups: list[Json] = [
        {key: x for key, x in group.items() if key not in ("params", "lr", "ends") and _is_plain(x)}
        for group in optimizer.param_groups
    ]
    return tensors, {"kind": _kind(optimizer), "values": plain, "groups": groups}


def restore_optimizer(
    optimizer: torch.optim.Optimizer,
    parameters: Mapping[str, torch.nn.Parameter],
    tensors: Mapping[str, torch.Tensor],
    record: dict[str, Any] | None,
) -> None:
    """Put back what `gather_optimizer` returned, into a fresh optimizer of the same kind.

    Raises:
        ValueError: it was another kind of optimizer, or Adam's moments have other shapes than their parameters.
    """
    kind, expected = "Adam" if record is None else record["kind"], _kind(optimizer)
    if kind != expected or (record is None) != _is_adam(optimizer):
        raise ValueError(f"its optimizer is {kind}, expected {expected}")
    plain, groups = ({}, []) if record is None else (record["values"], record["groups"])
    for name, parameter in parameters.items():
        prefix = f"{_prefix(optimizer)}{name}."
        moments = _part(tensors, prefix) if record is not None else _adam_moments(tensors, prefix, parameter)
        values = _placed(moments, parameter, optimizer)
        values |= {key.removeprefix(f"{name}."): x for key, x in plain.items() if key.startswith(f"{name}.")}
        if values:
            optimizer.state[parameter] = values
    for group, stored in zip(optimizer.param_groups, groups, strict=False):
        group.update({key: x for key, x in stored.items() if key in group and _is_plain(group[key])})


def _adam_moments(
    tensors: Mapping[str, torch.Tensor], prefix: str, parameter: torch.nn.Parameter
) -> dict[str, torch.Tensor]:
    moments = _known_part(tensors, prefix, ADAM_STATE)
    for key, x in moments.items():
        if x.shape != (() if key == "step" else parameter.shape):
            raise ValueError(f"{prefix}{key}: expected the shape of its parameter, {tuple(parameter.shape)}")
    return moments


def _placed(
    moments: dict[str, torch.Tensor], parameter: torch.nn.Parameter, optimizer: torch.optim.Optimizer
) -> dict[str, Any]:
    """Move moments to the device of their parameter, but the number of steps where torch keeps it on the CPU."""
    if not moments:
        return {}
    group = next(g for g in optimizer.param_groups if any(x is parameter for x in g["params"]))
    counts_here = group.get("fused") or group.get("capturable")
    return {k: x if k == "step" and not counts_here else x.to(parameter.device) for k, x in moments.items()}


def _is_adam(optimizer: torch.optim.Optimizer) -> bool:
    return type(optimizer) in (torch.optim.Adam, FusedAdam)


def _kind(optimizer: torch.optim.Optimizer) -> str:
    """Name of an optimizer in a checkpoint; the two Adams have the same state."""
    return torch.optim.Adam.__name__ if _is_adam(optimizer) else type(optimizer).__name__


def _prefix(optimizer: torch.optim.Optimizer) -> str:
    return "adam." if _is_adam(optimizer) else "optimizer."


def _is_plain(value: object) -> bool:
    return value is None or isinstance(value, (bool, int, float, str))


def _gather_random(
    generator: torch.Generator, noise: torch.Generator
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Return the states of all random generators: those of a training, torch's, numpy's and Python's."""
    tensors = {"rng.views": generator.get_state(), "rng.noise": noise.get_state(), "rng.torch": torch.get_rng_state()}
    if noise.device.type == "cuda":
        tensors["rng.cuda"] = torch.cuda.get_rng_state(noise.device)
    kind, keys, *rest = np.random.get_state()  # noqa: NPY002
    tensors["rng.numpy"] = torch.from_numpy(np.asarray(keys).astype(np.int64))
    return tensors, {"numpy": [kind, *rest], "python": random.getstate()}


def _restore_random(generator: torch.Generator, noise: torch.Generator, snapshot: Snapshot) -> None:
    """Put back what `_gather_random` returned."""
    tensors, state = snapshot
    generator.set_state(tensors["rng.views"])
    noise.set_state(tensors["rng.noise"])
    torch.set_rng_state(tensors["rng.torch"])
    if noise.device.type == "cuda" and "rng.cuda" in tensors:
        torch.cuda.set_rng_state(tensors["rng.cuda"], noise.device)
    kind, *rest = state["numpy"]
    np.random.set_state((kind, tensors["rng.numpy"].numpy().astype(np.uint32), *rest))  # noqa: NPY002
    version, internal, gauss = state["python"]
    random.setstate((version, tuple(internal), gauss))


@dataclass(frozen=True)
class Origin:
    """What a snapshot must have in common with a training that continues from it.

    Attributes:
        config: settings.
        views: fingerprint of the training views.
        scene: digest of the scene.
        teachers: digest of the teachers; empty without any.
    """

    config: Config
    views: str
    scene: str
    teachers: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the entries of a checkpoint's state."""
        entries = {"views": self.views, "scene": self.scene, "config": self.config.as_dict()}
        return entries | ({"teachers": self.teachers} if self.teachers else {})

    def check(self, state: Mapping[str, Any], *, extend: bool = False) -> None:
        """Raise ValueError unless a snapshot's state comes from a run of this scene with these settings and teachers.

        With `extend`, the run may have had fewer iterations.
        """
        refuse_removed(state["config"])
        # Neither CUDA graphs nor how many teachers the run would train first changes what a trainer does.
        saved, config = config_from_dict(state["config"]), self.config
        saved = dataclasses.replace(saved, cuda_graphs=config.cuda_graphs, teachers=config.teachers)
        if extend and saved.iterations < config.iterations:
            saved = dataclasses.replace(saved, iterations=config.iterations)
        if saved != config:
            raise ValueError("its settings are others")
        if state["views"] != self.views:
            raise ValueError("it has seen other training views than the scene has")
        if state["scene"] != self.scene:
            raise ValueError("the scene's photos, masks or points have changed since")
        if state.get("teachers", "") != self.teachers:
            raise ValueError("it has learned from other teachers, from others besides, or in another order")


def check_snapshot(snapshot: Snapshot, views: int, iterations: int) -> None:
    """Raise ValueError unless a snapshot, which may come from anywhere, holds what one of this training can.

    Args:
        snapshot: as it was read.
        views: how many training views there are.
        iterations: of the whole training.
    """
    tensors, state = snapshot
    for name, x in tensors.items():
        if name.startswith(FLOATS):
            if x.dtype != torch.float32:
                raise ValueError(f"{name}: expected float32, got {x.dtype}")
            check_finite(name, x)
    check_bounds(tensors)
    for name, good in (
        ("iteration", lambda x: type(x) is int and 0 <= x <= iterations),
        ("seconds", lambda x: type(x) in (int, float) and 0 <= x < math.inf),
        ("order", lambda x: isinstance(x, list) and all(type(i) is int and 0 <= i < views for i in x)),
        ("rate_factor", lambda x: type(x) in (int, float) and 0 < x <= 1),
    ):
        if not good(state[name]):
            raise ValueError(f"{name}: cannot be {state[name]!r:.60}")


def scene_digest(scene: Scene, texture: NeuralTexture) -> str:
    """Return a digest of what training takes from a scene beside its cameras: photos, masks, points, scale."""
    digest = hashlib.sha256(f"{scene.scale} {texture.config}".encode())
    for view in scene.train:
        for values in (view.image, view.mask, view.alpha, view.points):
            if values is not None:  # CRC: photos are many, and nobody forges them
                digest.update(zlib.crc32(values.contiguous().numpy().data).to_bytes(4, "little"))
    for values in (scene.points, scene.colors):
        digest.update(values.contiguous().numpy().data)
    return digest.hexdigest()
