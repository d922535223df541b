"""Training: the loop of paper Sec. 3.3, as a class that the command line drives."""

import dataclasses
import math
import random
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nexwarp.camera import Camera
from nexwarp.checkpoint import Model, load_checkpoint, save_checkpoint
from nexwarp.data import Scene, View, initial_points
from nexwarp.densify import PARAMETERS, Densifier, DensifyConfig
from nexwarp.kernels.types import MAX_HITS
from nexwarp.losses import LossWeights, training_losses
from nexwarp.ops.checks import check_range
from nexwarp.render import Rendering, render
from nexwarp.surfels import Surfels
from nexwarp.texture import NeuralTexture

# Schedules are given for runs of this length and stretch with `iterations`.
REFERENCE_ITERATIONS = 30_000
MIN_SURFELS = 16
SH_DC = 0.28209479177387814
INITIAL_OPACITY = 0.1
INITIAL_RAW_GAMMA = -5.0
# Photos stay on the GPU when they take less than this share of its free memory.
PHOTO_SHARE = 0.25


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates; pairs decay log-linearly over the run."""

    means: tuple[float, float] = (1.6e-4, 1.6e-6)
    """Times the scene scale."""
    quats: float = 1e-3
    """Of the raw quaternions."""
    scales: float = 5e-3
    """Of the logarithms of the scales."""
    opacities: float = 0.025
    """Of the logits of the opacities."""
    gammas: float = 1e-3
    """Of the logarithms of gamma - 1."""
    sh0: float = 2.5e-3
    """Of the plain colours' constant coefficients."""
    shN: float = 1.25e-4
    """Of the other ones."""
    grid: tuple[float, float] = (1e-3, 1e-5)
    """Of the hash grid."""
    mlp: tuple[float, float] = (1e-3, 1e-4)
    """Of the MLP."""


@dataclass(frozen=True)
class TextureConfig:
    """Shape of the neural texture (paper Sec. 4)."""

    levels: int = 16
    """L, resolution levels."""
    table_size: int = 2**20
    """T, entries a level, a power of two."""
    features: int = 2
    """F, features an entry."""
    min_resolution: float | None = None
    """Of the coarsest level, cells per world unit; None derives it from the scene's scale."""
    max_resolution: float | None = None
    """Of the finest level; None derives it from the footprint of the training pixels."""
    width: int = 64
    """Of the hidden layers."""
    hidden_layers: int = 2
    """Number of hidden layers."""


@dataclass(frozen=True)
class Config:
    """Everything that a run depends on, beside the scene."""

    preset: str = "default"
    """Name of the preset that this is, or started from."""
    iterations: int = REFERENCE_ITERATIONS
    """Training steps, one view each; schedules stretch with them."""
    max_surfels: int = 400_000
    """P, the budget: never exceeded. Half of it at most comes from the point cloud."""
    max_hits: int = 2
    """K, hits a pixel textures, 0 to 8; 0 trains without a texture."""
    sh_degree: int = 3
    """Highest degree of both appearances; one more is unlocked every 1,000 iterations."""
    sh_every: int = 1000
    """Iterations, of a run of 30,000, between those."""
    coarse: float = 0.0
    """Share of the run, at its start, that trains on photos of half the size: a quarter of the work a step."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind everything."""
    low_pass: bool = False
    """Screen-space low-pass for surfels smaller than a pixel."""
    clamp_texture: bool = False
    """Limit textured colours to >= 0."""
    clamp_image: bool = False
    """Limit the rendering to [0, 1] before the loss, as the authors' code does."""
    filter_points: bool = True
    """Drop uncertain points of the cloud before sampling."""
    orient_points: bool = True
    """Lay the initial surfels on planes fitted to the cloud; otherwise their rotations are random."""
    seed: int = 0
    """Of every random choice."""
    losses: LossWeights = field(default_factory=LossWeights)
    """Factors of the loss terms."""
    rates: LearningRates = field(default_factory=LearningRates)
    """Learning rates."""
    texture: TextureConfig = field(default_factory=TextureConfig)
    """Shape of the texture."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    """Density control."""

    def __post_init__(self) -> None:
        check_range("iterations", self.iterations, 1)
        check_range("max_surfels", self.max_surfels, MIN_SURFELS)
        check_range("max_hits", self.max_hits, 0, MAX_HITS)
        check_range("sh_degree", self.sh_degree, 0, 3)
        check_range("coarse", self.coarse, 0.0, 1.0)

    def scaled(self, iteration: float) -> int:
        """Iteration of this run that stands for one of a run of 30,000."""
        return max(1, round(iteration * self.iterations / REFERENCE_ITERATIONS))

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Config":
        """Rebuild a config from `as_dict`; ValueError names an unknown key."""
        parts = {
            "losses": LossWeights,
            "rates": LearningRates,
            "texture": TextureConfig,
            "densify": DensifyConfig,
        }
        try:
            data = {k: parts[k](**_tuples(v)) if k in parts else v for k, v in data.items()}
            return cls(**_tuples(data))
        except (TypeError, AttributeError) as error:
            raise ValueError(f"config: expected the settings of a nexwarp run ({error})") from None


def _tuples(data: dict[str, Any]) -> dict[str, Any]:
    return {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}


PRESETS: dict[str, Config] = {
    "default": Config(),
    "paper": Config(
        preset="paper",
        clamp_image=True,
        filter_points=False,
        orient_points=False,
        rates=LearningRates(mlp=(1e-3, 1e-3)),
        texture=TextureConfig(min_resolution=16.0, max_resolution=256.0),
        densify=DensifyConfig(prune_at_cap=False),
    ),
}


def preset(name: str) -> Config:
    """Return a preset; ValueError lists the known ones."""
    if name not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(sorted(PRESETS))}, got {name!r}")
    return PRESETS[name]


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
            raise ValueError(f"{scene.path}: expected at least one training view, got none")
        self.scene, self.config, self.device = scene, config, torch.device(device)
        _seed(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.surfels = initial_surfels(scene, config, self.generator).to(self.device)
        self.texture = NeuralTexture(**texture_shape(scene, config), sh_degree=config.sh_degree).to(self.device)
        self.optimizer = _make_optimizer(self.surfels, self.texture, config, scene.scale)
        self.densifier = Densifier(_densify_schedule(config), self.surfels, config.max_surfels)
        self.iteration = 0
        self.seconds = 0.0
        self.order: list[int] = []
        self.views = _Views(scene.train, self.device)

    def run(self, observe: Callable[[Progress], None] | None = None) -> None:
        """Train until `config.iterations`, calling `observe` after each step."""
        while self.iteration < self.config.iterations:
            start = time.perf_counter()
            progress = self.step()
            if self.iteration == self.config.iterations and self.device.type == "cuda":
                torch.cuda.synchronize(self.device)
            self.seconds += time.perf_counter() - start
            if observe is not None:
                observe(progress)

    def step(self) -> Progress:
        """Do one iteration: a view, its rendering, the losses, Adam, and density control when it is due."""
        self.iteration += 1
        config = self.config
        coarse = self.iteration <= config.coarse * config.iterations
        camera, target = self.views.get(self._next_view(), 2 if coarse else 1)
        self._schedule_rates()
        out = render(self.surfels, self.texture if config.max_hits else None, camera, **self.render_options())
        losses = self._losses(out, target)
        watch = None
        if self.densifier.active(self.iteration):
            watch = out.watch_error((out.image.detach() - target).abs().mean(dim=-1))
        sum(losses.values()).backward()
        if watch is not None:
            self.densifier.accumulate(watch.sums)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        if self.densifier.due(self.iteration):
            self.densifier.step(self.surfels, self.optimizer, self.generator)
        return Progress(self.iteration, len(self.surfels), losses, out.image, target)

    def render_options(self) -> dict[str, Any]:
        """Keyword arguments of `nexwarp.render` at this point of the run."""
        config = self.config
        unlocked = self.iteration // config.scaled(config.sh_every)
        return {
            "max_hits": config.max_hits,
            "background": config.background,
            "sh_degree": min(config.sh_degree, unlocked),
            "low_pass": config.low_pass,
            "clamp_texture": config.clamp_texture,
        }

    def model(self) -> Model:
        """Return the model as it is now."""
        meta = {
            **self.render_options(),
            "near": self.scene.train[0].camera.near,
            "scene_scale": self.scene.scale,
            "preset": self.config.preset,
            "iteration": self.iteration,
        }
        return Model(self.surfels, self.texture, meta)

    def save(self, run: Path) -> None:
        """Write a checkpoint: everything that shapes the future of the run."""
        tensors = {f"surfels.{k}": v for k, v in self.surfels.state_dict().items()}
        tensors |= {f"texture.{k}": v for k, v in self.texture.state_dict().items()}
        for name, parameter in self._named_parameters():
            for key, value in self.optimizer.state.get(parameter, {}).items():
                tensors[f"adam.{name}.{key}"] = torch.as_tensor(value)
        tensors["densify.errors"] = self.densifier.errors
        tensors["rng.views"] = self.generator.get_state()
        tensors["rng.torch"] = torch.get_rng_state()
        if self.device.type == "cuda":
            tensors["rng.cuda"] = torch.cuda.get_rng_state(self.device)
        kind, keys, *rest = np.random.get_state()  # noqa: NPY002
        tensors["rng.numpy"] = torch.from_numpy(keys.astype(np.int64))
        state = {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "order": self.order,
            "views": len(self.views),
            "numpy": [kind, *rest],
            "python": random.getstate(),
            "config": self.config.as_dict(),
        }
        save_checkpoint(run, tensors, state)

    def restore(self, run: Path) -> None:
        """Continue from a checkpoint of the same scene and settings; ValueError where they differ."""
        tensors, state = load_checkpoint(run)
        try:
            if Config.from_dict(state["config"]) != self.config:
                raise ValueError("its settings are others")
            if state["views"] != len(self.views):
                raise ValueError(f"it has seen {state['views']} training views, the scene has {len(self.views)}")
            self._restore(tensors, state)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())  # torch's go over several lines
            raise ValueError(f"{run}: expected a checkpoint of this run, but it does not fit ({reason})") from None

    def _restore(self, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> None:
        raw = {k[8:]: v for k, v in tensors.items() if k.startswith("surfels.")}
        self.surfels = Surfels(raw).to(self.device)
        self.texture.load_state_dict({k[8:]: v for k, v in tensors.items() if k.startswith("texture.")})
        self.optimizer = _make_optimizer(self.surfels, self.texture, self.config, self.scene.scale)
        for name, parameter in self._named_parameters():
            prefix = f"adam.{name}."
            entries = {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}
            if entries:
                self.optimizer.state[parameter] = {
                    k: v.to(parameter.device) if k != "step" or self.device.type == "cuda" else v
                    for k, v in entries.items()
                }
        self.densifier = Densifier(_densify_schedule(self.config), self.surfels, self.config.max_surfels)
        self.densifier.errors = tensors["densify.errors"].to(self.device)
        self.generator.set_state(tensors["rng.views"])
        torch.set_rng_state(tensors["rng.torch"])
        if self.device.type == "cuda" and "rng.cuda" in tensors:
            torch.cuda.set_rng_state(tensors["rng.cuda"], self.device)
        kind, *rest = state["numpy"]
        np.random.set_state((kind, tensors["rng.numpy"].numpy().astype(np.uint32), *rest))  # noqa: NPY002
        version, internal, gauss = state["python"]
        random.setstate((version, tuple(internal), gauss))
        self.iteration, self.seconds, self.order = state["iteration"], state["seconds"], state["order"]

    def _named_parameters(self) -> Iterator[tuple[str, torch.nn.Parameter]]:
        yield from ((f"surfels.{k}", v) for k, v in self.surfels.named_parameters())
        yield from ((f"texture.{k}", v) for k, v in self.texture.named_parameters())

    def _next_view(self) -> int:
        if not self.order:
            self.order = torch.randperm(len(self.views), generator=self.generator).tolist()
        return self.order.pop()

    def _losses(self, out: Rendering, target: torch.Tensor) -> dict[str, torch.Tensor]:
        textured = self.config.max_hits > 0
        return training_losses(
            image=out.image.clamp(0, 1) if self.config.clamp_image else out.image,
            textured=out.textured,
            weights=out.weights,
            target=target,
            opacities=self.surfels.opacities,
            grid=self.texture.grid if textured else None,
            resolutions=self.texture.resolutions if textured else None,
            loss_weights=self.config.losses,
        )

    def _schedule_rates(self) -> None:
        progress = (self.iteration - 1) / max(self.config.iterations - 1, 1)
        for group in self.optimizer.param_groups:
            first, last = group["ends"]
            group["lr"] = math.exp((1 - progress) * math.log(first) + progress * math.log(last))


class _Views:
    """Training views on the device they are used on; photos stay 8-bit, in pinned memory when they are many."""

    def __init__(self, views: list[View], device: torch.device) -> None:
        self.device = device
        self.cameras = [view.camera.to(device) for view in views]
        photos = [view.image for view in views]
        if device.type == "cuda":
            free, _ = torch.cuda.mem_get_info(device)
            if sum(p.numel() for p in photos) < PHOTO_SHARE * free:
                photos = [p.to(device) for p in photos]
            else:
                photos = [p.pin_memory() for p in photos]
        self.photos = photos
        self.reduced: dict[tuple[int, int], Camera] = {}

    def __len__(self) -> int:
        return len(self.photos)

    def get(self, index: int, factor: int) -> tuple[Camera, torch.Tensor]:
        """Camera and photo (H, W, 3) float in [0, 1], reduced by a factor; what does not fill a pixel is cut off."""
        photo = self.photos[index].to(self.device, non_blocking=True).float() / 255.0
        camera = self.cameras[index]
        if factor == 1 or min(camera.width, camera.height) < factor:
            return camera, photo
        if (index, factor) not in self.reduced:
            K = camera.K.clone()
            K[:2] /= factor
            size = (camera.width // factor, camera.height // factor)
            self.reduced[index, factor] = Camera(camera.viewmat, K, *size, near=camera.near)
        small = torch.nn.functional.avg_pool2d(photo.permute(2, 0, 1), factor)
        return self.reduced[index, factor], small.permute(1, 2, 0).contiguous()


def initial_surfels(scene: Scene, config: Config, generator: torch.Generator) -> Surfels:
    """Surfels on points of the cloud chosen by farthest point sampling: half the budget at most (paper Sec. 3.3)."""
    points = initial_points(
        scene.points,
        scene.colors,
        max(config.max_surfels // 2, 1),
        track_lengths=scene.track_lengths,
        errors=scene.reprojection_errors,
        filter_outliers=config.filter_points,
    )
    count = len(points.means)
    quats = torch.randn(count, 4, generator=generator)
    raw = {
        "means": points.means,
        "raw_quats": quats_towards(points.normals, quats) if config.orient_points else quats,
        "log_scales": points.scales.log()[:, None].repeat(1, 2),
        "logit_opacities": torch.logit(torch.full((count,), INITIAL_OPACITY)),
        "raw_gammas": torch.full((count, 2), INITIAL_RAW_GAMMA),
        "sh0": ((points.colors - 0.5) / SH_DC)[:, None],
        "shN": torch.zeros(count, (config.sh_degree + 1) ** 2 - 1, 3),
    }
    return Surfels(raw)


def quats_towards(normals: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
    """Turn rotations by the least angle so that their z axes lie along normals.

    Args:
        normals: (N, 3) unit.
        quats: (N, 4) wxyz, any length but zero.

    Returns:
        (N, 4) unit, wxyz.
    """
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    axis = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=-1)
    normals = torch.where((axis * normals).sum(-1, keepdim=True) < 0, -normals, normals)
    # Half-way quaternion from axis to normal; their angle is at most 90 degrees, so it is never 0.
    turn = torch.cat([1 + (axis * normals).sum(-1, keepdim=True), torch.linalg.cross(axis, normals)], dim=-1)
    a, b, c, d = torch.nn.functional.normalize(turn, dim=-1).unbind(-1)
    return torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        dim=-1,
    )


def texture_shape(scene: Scene, config: Config) -> dict[str, Any]:
    """Arguments of `NeuralTexture`, with resolutions that follow the scene when the config leaves them open.

    The finest level's cells are as small as the pixels of nearly all training views at the points they see (95th
    percentile of f / t), the coarsest's a 64th of the scene's scale: rescaling a scene changes nothing.
    """
    shape = dataclasses.asdict(config.texture)
    if shape["max_resolution"] is None:
        shape["max_resolution"] = _pixel_resolution(scene)
    if shape["min_resolution"] is None:
        shape["min_resolution"] = min(64.0 / scene.scale, shape["max_resolution"] / 4)
    return shape


def _pixel_resolution(scene: Scene) -> float:
    """95th percentile, over training views and the points in them, of pixels per world unit."""
    densities = []
    for view in scene.train:
        camera = view.camera
        x = scene.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        depth = x[:, 2]
        pixel = x[:, :2] / depth[:, None] * torch.tensor([camera.fx, camera.fy])
        pixel = pixel + torch.tensor([camera.cx, camera.cy])
        size = torch.tensor([camera.width, camera.height])
        seen = (depth > camera.near) & ((pixel >= 0) & (pixel < size)).all(dim=1)
        densities.append(camera.focal / depth[seen])
    density = torch.cat(densities)
    if density.numel() == 0:
        raise ValueError(f"{scene.path}: expected points in front of the training cameras, found none")
    return float(np.quantile(density.numpy(), 0.95))


def _make_optimizer(surfels: Surfels, texture: NeuralTexture, config: Config, scale: float) -> torch.optim.Adam:
    rates = config.rates
    ends: dict[str, tuple[float, float]] = {
        "means": (rates.means[0] * scale, rates.means[1] * scale),
        "raw_quats": (rates.quats,) * 2,
        "log_scales": (rates.scales,) * 2,
        "logit_opacities": (rates.opacities,) * 2,
        "raw_gammas": (rates.gammas,) * 2,
        "sh0": (rates.sh0,) * 2,
        "shN": (rates.shN,) * 2,
    }
    groups = [{"params": [getattr(surfels, name)], "ends": ends[name], "lr": ends[name][0]} for name in PARAMETERS]
    if config.max_hits:
        groups.append({"params": [texture.grid], "ends": rates.grid, "lr": rates.grid[0]})
        groups.append({"params": list(texture.mlp.parameters()), "ends": rates.mlp, "lr": rates.mlp[0]})
    return torch.optim.Adam(groups, eps=1e-15, fused=True)


def _densify_schedule(config: Config) -> DensifyConfig:
    """Stretch the schedule to the run's length; rounds of short runs stay at least ten iterations apart."""
    d = config.densify
    every = max(config.scaled(d.every), min(d.every, 10))
    return dataclasses.replace(d, start=config.scaled(d.start), stop=config.scaled(d.stop), every=every)


def _seed(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)
