"""State of a training: everything that shapes its future, as a value that is gathered and put back bit for bit."""

import dataclasses
import hashlib
import zlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, cast

import torch

from nexwarp.data import Scene
from nexwarp.errors import check_finite
from nexwarp.io.json_files import Json
from nexwarp.model.bounds import check_bounds
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.model.surfels import PARAMETERS, Surfels
from nexwarp.model.texture import NeuralTexture, Texture
from nexwarp.ops.tiles import Order
from nexwarp.train.checkpoint import Snapshot
from nexwarp.train.densify import DensityControl
from nexwarp.train.initial import Start, given_surfels, initial_poses, initial_surfels, initial_texture
from nexwarp.train.optimizer import FusedAdam, make_optimizer
from nexwarp.train.recipe import Config, config_from_dict, refuse_removed

ADAM_STATE = ("step", "exp_avg", "exp_avg_sq")
CPU_GENERATOR = 5056  # bytes of the state of a generator on a CPU, a Mersenne twister
TWISTER = 624  # numbers that it makes at a time
FLOATS = ("surfels.", "texture.", "own_texture.", "poses.", "adam.", "densify.")  # of tensors that are float32


class TrainingState:
    """What a training changes; `snapshot` is its value at one moment.

    Attributes:
        background: colour behind everything, three numbers; known with the photos.
        poses: corrections of the training poses; None where they stay as given.
        generator: random numbers on the CPU.
        noise: random numbers on the device.
        order: indices of the views that are left of the epoch, the next one last.
        iteration: steps done.
        seconds: that the steps and their checks took, in all sessions of the run.
    """

    background: tuple[float, float, float]

    def __init__(
        self, scene: Scene, config: Config, device: torch.device, colors: torch.Tensor | None, start: Start
    ) -> None:
        """Make the initial surfels, of the points' `colors` (P, 3) or else the scene's own, and the texture.

        `start` has those that are given instead.
        """
        self.scene = scene
        self.config = config
        self.device = device
        self.generator = torch.Generator().manual_seed(config.seed)
        self.noise = torch.Generator(device).manual_seed(config.seed)
        surfels = given_surfels(config, start) or initial_surfels(scene, config, self.generator, colors)
        self._surfels = surfels.to(device)
        self._texture = initial_texture(scene, config, surfels, start).to(device)
        given = (config.texture.table_size, start.get("init"), start.get("texture"))
        self._derived_table = all(x is None for x in given)
        self.poses = initial_poses(scene, config, device)
        self.optimizer = self._make_optimizer()
        self.densifier = DensityControl(self.surfels, config)
        self.order: list[int] = []
        self.iteration = 0
        self.seconds = 0.0

    # Not to be assigned: the optimizer would go on to train the old ones.
    @property
    def surfels(self) -> Surfels:
        """The surfels in training."""
        return self._surfels

    @property
    def texture(self) -> Texture:
        """The texture in training."""
        return self._texture

    def _make_optimizer(self) -> FusedAdam:
        return make_optimizer(self.surfels, self.texture, self.poses, self.scene, self.config)

    def _parts(self) -> dict[str, torch.nn.Module]:
        """Return what is trained, by the first words of the names in a checkpoint."""
        texture = "texture" if type(self.texture) is NeuralTexture else "own_texture"  # whose names may be any
        parts: dict[str, torch.nn.Module] = {"surfels": self.surfels, texture: self.texture}
        return parts if self.poses is None else parts | {"poses": self.poses}

    def _named_parameters(self) -> Iterator[tuple[str, torch.nn.Parameter]]:
        """Yield all parameters with their names in a checkpoint."""
        for part, module in self._parts().items():
            yield from ((f"{part}.{name}", x) for name, x in module.named_parameters())

    def take_grid_loss(self) -> dict[str, torch.Tensor]:
        """Return the grid's term of the loss, which the optimizer computes, once after each of its steps."""
        if self.optimizer.grid_loss is None:
            return {}
        loss, self.optimizer.grid_loss = self.optimizer.grid_loss, None
        return {"grid": loss}

    def facts(self) -> dict[str, Json]:
        """Return what a model says of its training; see `Model.meta`."""
        near, scale = self.scene.train[0].camera.near, self.scene.scale
        facts: dict[str, Json] = {"near": near, "scene_scale": scale, "preset": self.config.preset}
        if self.scene.origin.any():
            facts["origin"] = self.scene.origin.tolist()
        if self.scene.white is not None:
            facts["white"] = self.scene.white
        return facts | {"iteration": self.iteration}

    def model(self) -> Model:
        """Return the model as it is now: the surfels and texture in training, at the photos' mean exposure."""
        return Model(self.surfels, self.texture, options=self.render_options(), meta=self.facts())

    def render_options(self) -> RenderOptions:
        """Return how the scene is rendered at this point: more hits and SH degrees are unlocked on the way."""
        config = self.config
        most = max(config.sh_degree, self.texture.sh_degree)
        return RenderOptions(
            max_hits=config.hits_at(self.iteration),
            background=self.background,
            sh_degree=min(most, self.iteration // config.scaled(config.sh_every)),
            order=cast(Order, config.order),
        )

    def snapshot(self) -> Snapshot:
        """Return copies on the CPU of everything that shapes the future."""
        tensors = {f"{part}.{name}": x for part, m in self._parts().items() for name, x in m.state_dict().items()}
        for name, parameter in self._named_parameters():
            tensors |= {f"adam.{name}.{key}": x for key, x in self.optimizer.state.get(parameter, {}).items()}
        tensors["densify.errors"] = self.densifier.errors
        tensors |= {"rng.views": self.generator.get_state(), "rng.noise": self.noise.get_state()}
        tensors["rng.torch"] = torch.get_rng_state()
        if self.device.type == "cuda":
            tensors["rng.cuda"] = torch.cuda.get_rng_state(self.device)
        state: dict[str, Any] = {"iteration": self.iteration, "seconds": self.seconds, "order": list(self.order)}
        return Snapshot({name: x.detach().to("cpu", copy=True) for name, x in tensors.items()}, state)

    def take_table_size(self, snapshot: Snapshot) -> None:
        """Give a texture made for the scene as many entries as a snapshot's: other versions derive other numbers."""
        texture, grid = self.texture, snapshot.tensors.get("texture.grid")
        if not self._derived_table or grid is None or type(texture) is not NeuralTexture:
            return
        if grid.shape[1] != texture.config["table_size"]:
            self._texture = NeuralTexture(**texture.config | {"table_size": grid.shape[1]}).to(self.device)
            self.optimizer = self._make_optimizer()

    def load_snapshot(self, snapshot: Snapshot) -> None:
        """Return to a snapshot, which stays as it is; ValueError or RuntimeError where it does not fit."""
        tensors, state = {name: x.clone() for name, x in snapshot.tensors.items()}, snapshot.state
        self._surfels = Surfels(_part(tensors, "surfels.", PARAMETERS)).to(self.device)
        _load_texture(self.texture, _part(tensors, f"{list(self._parts())[1]}.", self.texture.state_dict()))
        if self.poses is not None:
            self.poses.load(tensors["poses.corrections"])
        self.optimizer = self._make_optimizer()
        self._load_moments(tensors)
        self.densifier = DensityControl(self.surfels, self.config)
        if tensors["densify.errors"].shape != self.densifier.errors.shape:
            raise ValueError(f"densify.errors: expected one for each of {len(self.surfels)} surfels")
        self.densifier.errors = tensors["densify.errors"].to(self.device)
        self.generator.set_state(tensors["rng.views"])
        self.noise.set_state(tensors["rng.noise"])
        torch.set_rng_state(tensors["rng.torch"])
        if self.device.type == "cuda" and "rng.cuda" in tensors:
            torch.cuda.set_rng_state(tensors["rng.cuda"], self.device)
        self.order = list(state["order"])
        self.iteration = state["iteration"]
        self.seconds = state["seconds"]

    def _load_moments(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Put a snapshot's state of Adam into a fresh optimizer."""
        for name, parameter in self._named_parameters():
            values = _part(tensors, f"adam.{name}.", ADAM_STATE)
            for key, value in values.items():
                if value.shape != (() if key == "step" else parameter.shape):
                    shape = tuple(parameter.shape)
                    raise ValueError(f"adam.{name}.{key}: expected the shape of its parameter, {shape}")
                values[key] = value.to(parameter.device)
            if values:
                self.optimizer.state[parameter] = values


def _part(tensors: Mapping[str, torch.Tensor], prefix: str, names: Iterable[str]) -> dict[str, torch.Tensor]:
    """Return the tensors of these names, which have a prefix in a checkpoint; a newer version may have written more."""
    return {name: tensors[prefix + name] for name in names if prefix + name in tensors}


def _load_texture(texture: Texture, state: dict[str, torch.Tensor]) -> None:
    """Copy a state into a texture, which may have another number of rows for surfels."""
    for name in texture.per_surfel:
        path, _, leaf = name.rpartition(".")
        owner = texture.get_submodule(path)
        old: torch.Tensor = getattr(owner, leaf)
        new = torch.empty_like(state[name], device=old.device)
        setattr(owner, leaf, torch.nn.Parameter(new) if isinstance(old, torch.nn.Parameter) else new)
    texture.load_state_dict(state)


def check_origin(origin: Mapping[str, str], config: Config, state: Mapping[str, Any], *, extend: bool = False) -> None:
    """Raise ValueError unless a snapshot's state comes from a run of this scene with these settings and teachers.

    With `extend`, the run may have had fewer iterations.
    """
    refuse_removed(state["config"])
    if "optimizer" in state:
        raise ValueError("it was trained by an optimizer of your own, which this version does not support")
    if state.get("rate_factor", 1.0) != 1.0:
        raise ValueError("it went on at lowered rates after a divergence, which this version does not support")
    # Neither CUDA graphs nor how many teachers the run would train first changes what a trainer does.
    saved = config_from_dict(state["config"])
    iterations = max(saved.iterations, config.iterations) if extend else saved.iterations
    saved = dataclasses.replace(saved, iterations=iterations, cuda_graphs=config.cuda_graphs, teachers=config.teachers)
    if saved != config:
        raise ValueError("its settings are others")
    if state["views"] != origin["views"]:
        raise ValueError("it has seen other training views than the scene has")
    if state["scene"] != origin["scene"]:
        raise ValueError("the scene's photos, masks, depth maps or points have changed since")
    if state.get("teachers", "") != origin.get("teachers", ""):
        raise ValueError("it has learned from other teachers, from others besides, or in another order")


def check_snapshot(snapshot: Snapshot, views: int, iterations: int) -> None:
    """Raise ValueError unless a snapshot from a file holds what one of a training of so many views can."""
    tensors, state = snapshot
    for name, x in tensors.items():
        if name.startswith(FLOATS):
            if x.dtype != torch.float32:
                raise ValueError(f"{name}: expected float32, got {x.dtype}")
            check_finite(name, x)
        if name.startswith("rng.") and x.numel() == CPU_GENERATOR:
            check_generator(name, x)
    if not len(tensors["surfels.means"]):
        raise ValueError("surfels.means: expected at least one surfel, got none")
    check_bounds(tensors)
    if not (type(state["iteration"]) is int and 0 <= state["iteration"] <= iterations):
        raise ValueError(f"iteration: cannot be {state['iteration']!r:.60}")
    if not set(state["order"]) <= set(range(views)):
        raise ValueError(f"order: cannot be {state['order']!r:.60}")


def check_generator(name: str, state: torch.Tensor) -> None:
    """Raise ValueError unless a CPU generator's position lies in its numbers; torch would read what is behind them."""
    content = state.numpy().tobytes()
    left, position = int.from_bytes(content[8:12], "little", signed=True), int.from_bytes(content[16:24], "little")
    if not (left >= 1 and left + position <= TWISTER + 1):
        raise ValueError(f"{name}: expected a position in {TWISTER} numbers, got {position} with {left} left")


def scene_digest(scene: Scene, texture: Texture) -> str:
    """Return a digest of what training takes from a scene beside its cameras: photos, masks, points, depths, scale."""
    kind = texture.config if type(texture) is NeuralTexture else type(texture).__qualname__
    digest = hashlib.sha256(f"{scene.scale} {kind}".encode())
    for view in scene.train:
        for values in (view.image, view.mask, view.alpha, view.points, view.depth):
            if values is not None:  # CRC: photos are many, and nobody forges them
                digest.update(zlib.crc32(values.contiguous().numpy().data).to_bytes(4, "little"))
    for values in (scene.points, scene.colors):
        digest.update(values.contiguous().numpy().data)
    return digest.hexdigest()
