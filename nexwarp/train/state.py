"""State of a training: everything that shapes its future, gathered and put back bit for bit."""

import dataclasses
import hashlib
import math
import random
import zlib
from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from nexwarp.data import Scene
from nexwarp.errors import check_finite
from nexwarp.io.json_files import Json
from nexwarp.model.bounds import check_bounds
from nexwarp.model.poses import PoseCorrections
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import NeuralTexture
from nexwarp.train.adam import FusedAdam
from nexwarp.train.recipe import Config
from nexwarp.train.settings import config_from_dict, refuse_removed

MOMENTS = 2  # tensors that Adam keeps of each parameter
ADAM_STATE = ("step", "exp_avg", "exp_avg_sq", "max_exp_avg_sq")  # their names, those of amsgrad too
HEADERS = 2**20  # bytes of a checkpoint beside its parameters, at most
FLOATS = ("surfels.", "texture.", "poses.", "adam.", "densify.")  # of tensors that are float32


class Snapshot(NamedTuple):
    """State of a training, on the CPU.

    Attributes:
        tensors: by name.
        state: the rest, JSON values.
    """

    tensors: dict[str, torch.Tensor]
    state: dict[str, Any]


def named_parameters(
    surfels: Surfels, texture: NeuralTexture, poses: PoseCorrections | None = None
) -> Iterator[tuple[str, torch.nn.Parameter]]:
    """Yield all parameters with their names in a checkpoint."""
    yield from ((f"surfels.{name}", x) for name, x in surfels.named_parameters())
    yield from ((f"texture.{name}", x) for name, x in texture.named_parameters())
    if poses is not None:
        yield from ((f"poses.{name}", x) for name, x in poses.named_parameters())


def learned_tensors(
    surfels: Surfels, texture: NeuralTexture, poses: PoseCorrections | None = None
) -> dict[str, torch.Tensor]:
    """Return what is learned by its names in a checkpoint, and the texture's buffers."""
    tensors = {f"surfels.{name}": x for name, x in surfels.state_dict().items()}
    tensors |= {f"texture.{name}": x for name, x in texture.state_dict().items()}
    return tensors if poses is None else tensors | {f"poses.{name}": x for name, x in poses.state_dict().items()}


def part(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Return the tensors whose names begin with a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): x for name, x in tensors.items() if name.startswith(prefix)}


def known_part(tensors: Mapping[str, torch.Tensor], prefix: str, names: Collection[str]) -> dict[str, torch.Tensor]:
    """Return those of `part` whose names are known; a newer version may have written others."""
    return {name: x for name, x in part(tensors, prefix).items() if name in names}


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
            else:
                plain[f"{name}.{key}"] = _plain(f"{name}.{key}", value)
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
    for name, parameter in parameters.items():
        prefix = f"{_prefix(optimizer)}{name}."
        entries = part(tensors, prefix) if record is not None else known_part(tensors, prefix, ADAM_STATE)
        if record is None:
            wrong = [k for k, x in entries.items() if x.shape != (() if k == "step" else parameter.shape)]
            if wrong:
                raise ValueError(f"{prefix}{wrong[0]}: expected the shape of its parameter, {tuple(parameter.shape)}")
        group = next(g for g in optimizer.param_groups if any(x is parameter for x in g["params"])) if entries else {}
        # Where torch keeps the number of steps: on the CPU, unless the step is a fused kernel or can be captured.
        counts_here = group.get("fused") or group.get("capturable")
        values = {k: x if k == "step" and not counts_here else x.to(parameter.device) for k, x in entries.items()}
        if record is not None:
            values |= {k.removeprefix(f"{name}."): x for k, x in record["values"].items() if k.startswith(f"{name}.")}
        if values:
            optimizer.state[parameter] = values
    for group, stored in zip(optimizer.param_groups, [] if record is None else record["groups"], strict=False):
        group.update({key: x for key, x in stored.items() if key in group and _is_plain(group[key])})


def _is_adam(optimizer: torch.optim.Optimizer) -> bool:
    return type(optimizer) in (torch.optim.Adam, FusedAdam)


def _kind(optimizer: torch.optim.Optimizer) -> str:
    """Name of an optimizer in a checkpoint; the two Adams have the same state."""
    return torch.optim.Adam.__name__ if _is_adam(optimizer) else type(optimizer).__name__


def _prefix(optimizer: torch.optim.Optimizer) -> str:
    return "adam." if _is_adam(optimizer) else "optimizer."


def _is_plain(value: object) -> bool:
    return value is None or isinstance(value, (bool, int, float, str))


def _plain(name: str, value: object) -> Json:
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"optimizer: expected a state of tensors and numbers, got {type(value).__name__} for {name}")


def gather_random(
    generator: torch.Generator, noise: torch.Generator, device: torch.device
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Return the states of all random generators: those of a training, torch's, numpy's and Python's."""
    tensors = {"rng.views": generator.get_state(), "rng.noise": noise.get_state(), "rng.torch": torch.get_rng_state()}
    if device.type == "cuda":
        tensors["rng.cuda"] = torch.cuda.get_rng_state(device)
    kind, keys, *rest = np.random.get_state()  # noqa: NPY002
    tensors["rng.numpy"] = torch.from_numpy(np.asarray(keys).astype(np.int64))
    return tensors, {"numpy": [kind, *rest], "python": random.getstate()}


def restore_random(
    generator: torch.Generator, noise: torch.Generator, device: torch.device, snapshot: Snapshot
) -> None:
    """Put back what `gather_random` returned."""
    tensors, state = snapshot
    generator.set_state(tensors["rng.views"])
    noise.set_state(tensors["rng.noise"])
    torch.set_rng_state(tensors["rng.torch"])
    if device.type == "cuda" and "rng.cuda" in tensors:
        torch.cuda.set_rng_state(tensors["rng.cuda"], device)
    kind, *rest = state["numpy"]
    np.random.set_state((kind, tensors["rng.numpy"].numpy().astype(np.uint32), *rest))  # noqa: NPY002
    version, internal, gauss = state["python"]
    random.setstate((version, tuple(internal), gauss))


def check_origin(
    snapshot: Snapshot, config: Config, views: str, scene: str, teachers: str = "", *, extend: bool = False
) -> None:
    """Raise ValueError unless a snapshot comes from a run of this scene with these settings and teachers.

    Args:
        snapshot: as it was read.
        config: settings.
        views: fingerprint of the training views.
        scene: digest of the scene.
        teachers: digest of the teachers; empty without any.
        extend: whether the run may have had fewer iterations.
    """
    state = snapshot.state
    # Neither CUDA graphs nor how many teachers the run would train first changes what a trainer does.
    refuse_removed(state["config"])
    saved = config_from_dict(state["config"])
    saved = dataclasses.replace(saved, cuda_graphs=config.cuda_graphs, teachers=config.teachers)
    if extend and saved.iterations < config.iterations:
        saved = dataclasses.replace(saved, iterations=config.iterations)
    if saved != config:
        raise ValueError("its settings are others")
    if state["views"] != views:
        raise ValueError("it has seen other training views than the scene has")
    if state["scene"] != scene:
        raise ValueError("the scene's photos, masks or points have changed since")
    if state.get("teachers", "") != teachers:
        raise ValueError("it has learned from other teachers, from others besides, or in another order")


def check_snapshot(snapshot: Snapshot, views: int, iterations: int) -> None:
    """Raise ValueError unless a snapshot, which may come from anywhere, holds what one of this training can.

    Args:
        snapshot: as it was read.
        views: how many training views there are.
        iterations: of the whole training.
    """
    tensors, state = snapshot
    wrong = [name for name, x in tensors.items() if name.startswith(FLOATS) and x.dtype != torch.float32]
    if wrong:
        raise ValueError(f"{wrong[0]}: expected float32, got {tensors[wrong[0]].dtype}")
    for name, x in tensors.items():
        if name.startswith(FLOATS):
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
