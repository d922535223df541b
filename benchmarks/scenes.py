"""Seeded scenes that all benchmarks share. Made on the CPU, so that they are the same on every device."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import nexwarp as nw
from benchmarks.suite import Options, Stage
from benchmarks.timing import Measurement
from nexwarp import ops
from nexwarp.cameras.cameras_file import CAMERAS_FILE, load_cameras
from nexwarp.cameras.paths import look_at
from nexwarp.model.surfels import Activated

SH_DC = 0.28209479177387814
GARDEN_WIDTH = 648  # of the images that garden_points.npz's intrinsics are for
GARDEN, SAHAROV = 400_000, 40_000
SHIPPED = {"levels": 8, "features": 4, "residual": True}  # the shape that `nexwarp train` gives a texture by default
GARDEN_SPREAD = 1.5  # SCALE of the first measurements (2.80 million entries by bounding boxes), which targets refer to
# The synthetic cloud is as large as the garden: (share of the surfels, area in square world units).
GROUND_RADIUS, BALL_RADIUS, DOME_RADIUS = 3.0, 0.5, 4.0


@dataclass(frozen=True)
class SurfelScene:
    """A model and the cameras that see it.

    Attributes:
        name: of the scene, with its sizes.
        model: its surfels have SH of degree 3, and gamma = 1 (but for 1e-6) unless they were trained; only a trained
            one has a texture, exposures, detail limits and options of its own.
        cameras: benchmarks of frames time the first one; training draws from all.
        photos: (H, W, 3) uint8 of these cameras, where there are any.
        note: how the scene differs from the one that was asked for.
    """

    name: str
    model: nw.Model
    cameras: tuple[nw.Camera, ...]
    photos: tuple[torch.Tensor, ...] = ()
    note: str = ""

    @property
    def surfels(self) -> nw.Surfels:
        """The model's surfels."""
        return self.model.surfels

    @property
    def camera(self) -> nw.Camera:
        """The camera of the timed frame."""
        return self.cameras[0]

    @property
    def facts(self) -> dict[str, Any]:
        """Facts of the scene that every measurement on it records."""
        sizes = {"surfels": len(self.surfels), "width": self.camera.width, "height": self.camera.height}
        return {"scene": self.name, "sizes": sizes, "note": self.note}

    def to(self, device: torch.device | str) -> "SurfelScene":
        """Return this scene on a device; the photos stay on the CPU. Moves the model in place, as modules do."""
        return replace(self, model=self.model.to(device), cameras=tuple(c.to(device) for c in self.cameras))


@dataclass(frozen=True)
class Geometry:
    """Activated surfels as leaf tensors, for timing passes alone.

    Attributes:
        shape: means, quats, scales, opacities, gammas.
        colors: (N, 3) plain colours.
        viewmat: (4, 4), needs no gradient.
        pinhole: the image plane.
    """

    shape: Activated
    colors: torch.Tensor
    viewmat: torch.Tensor
    pinhole: ops.Pinhole

    @property
    def leaves(self) -> tuple[torch.Tensor, ...]:
        """The tensors that need gradients."""
        return (*self.shape, self.colors)

    def project(self) -> ops.Projection:
        """Take the surfels to the camera frame."""
        return ops.project(*self.shape, self.colors, self.viewmat)

    def tiles(self, projection: ops.Projection) -> ops.Tiles:
        """List the surfels of each tile."""
        return ops.intersect_tiles(self.shape, projection, self.viewmat, self.pinhole)

    def collect(self, projection: ops.Projection, tiles: ops.Tiles, max_hits: int = 2) -> ops.Hits:
        """Walk the lists."""
        return ops.collect(projection, tiles, self.pinhole, max_hits=max_hits)

    def hits(self, max_hits: int = 2) -> ops.Hits:
        """Run the whole collection stage: project, tiles, collect."""
        projection = self.project()
        return self.collect(projection, self.tiles(projection), max_hits)


@torch.no_grad()
def geometry(scene: SurfelScene) -> Geometry:
    """Activate a scene's surfels, and their colours as its camera sees them."""
    s, c = scene.surfels, scene.camera
    shape = Activated(*(x.clone().requires_grad_() for x in (s.means, s.quats, s.scales, s.opacities, s.gammas)))
    colors = ops.plain_colors((s.sh0, s.shN), s.means, c.position, 3).requires_grad_()
    pinhole = ops.Pinhole(c.K, c.width, c.height, c.near)
    return Geometry(shape, colors, c.viewmat, pinhole)


def entries(tiles: ops.Tiles) -> int:
    """Return the number of (tile, surfel) entries; waits for a GPU."""
    return int(tiles.ends[-1]) if len(tiles.ends) else 0


def outputs(hits: ops.Hits) -> tuple[torch.Tensor, ...]:
    """Return the differentiable buffers of hits."""
    return hits.plain, hits.depths, hits.weights, hits.alpha


def random_like(tensors: tuple[torch.Tensor, ...], seed: int = 1) -> list[torch.Tensor]:
    """Return seeded normal values, used as incoming gradients."""
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(x.shape, generator=generator, dtype=x.dtype).to(x.device) for x in tensors]


def both_ways(
    forward: Callable[[], tuple[torch.Tensor, ...]], leaves: Sequence[torch.Tensor]
) -> Callable[[], tuple[torch.Tensor, ...]]:
    """Return a function that does the forward and the backward pass, and returns the gradients of the leaves."""
    signals = random_like(forward())
    return lambda: torch.autograd.grad(forward(), leaves, signals)


def texture(scene: SurfelScene, **shape: Any) -> nw.NeuralTexture:
    """Return the scene's own texture, or a random one.

    Args:
        scene: a random texture has a table of 2^20 on scenes of 40,000 surfels or more, else of 2^15.
        shape: arguments of `NeuralTexture` for a random texture.
    """
    if isinstance(scene.model.texture, nw.NeuralTexture):
        return scene.model.texture
    large = len(scene.surfels) >= SAHAROV
    defaults = {"table_size": 2**20 if large else 2**15, "min_resolution": 16.0, "max_resolution": 1024.0}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(2)
        made = nw.NeuralTexture(**(defaults | shape))
        with torch.no_grad():
            made.grid.uniform_(-0.5, 0.5)
    return made.to(scene.surfels.device)


def large_scene(options: Options) -> SurfelScene:
    """Return the garden."""
    return garden(20_000, 400, 259, options.data) if options.quick else garden(data=options.data)


def small_scene(options: Options) -> SurfelScene:
    """Return a cloud that is small enough for a CPU."""
    return cloud(500, 64, 48) if options.quick else cloud(20_000, 480, 320)


def workload(options: Options) -> list[SurfelScene]:
    """Return the scenes for a stage: the garden on CUDA, a small cloud for any device, and the trained fox if named."""
    scenes = [small_scene(options)]
    if options.cuda:
        scenes.insert(0, large_scene(options))
    if options.model is not None:
        scenes.append(fox(options.model, options.data))
    return [scene.to(options.device) for scene in scenes]


def on_each_scene(measure: Callable[[SurfelScene, Options], list[Measurement]]) -> Stage:
    """Return a stage that measures on each scene of the workload."""
    return lambda options: [row for scene in workload(options) for row in measure(scene, options)]


def garden(n: int = GARDEN, width: int = 1600, height: int = 1037, data: Path = Options.data) -> SurfelScene:
    """Surfels of random orientations over Mip-NeRF 360 "garden"; a synthetic cloud where its points are absent."""
    file = data / "garden_points.npz"
    if not file.is_file():
        stand_in = cloud(n, width, height)
        return replace(stand_in, name=f"garden stand-in, {stand_in.name}", note=f"synthetic: no {file}")
    arrays = np.load(file)
    points = torch.from_numpy(arrays["means3d"]).float()
    colors = torch.from_numpy(arrays["colors"]).float() / 255
    cameras = []
    for viewmat, K in zip(arrays["viewmats"], arrays["Ks"], strict=True):
        K = torch.from_numpy(K).float()
        K[:2] *= width / GARDEN_WIDTH
        cameras.append(nw.Camera(torch.from_numpy(viewmat).float(), K, width, height))
    surfels = _cover(points, colors, n, GARDEN_SPREAD)
    return SurfelScene(f"garden {_sizes(n, width, height)}", nw.Model(surfels, None), tuple(cameras))


def saharov(n: int = SAHAROV, data: Path = Options.data) -> SurfelScene:
    """Surfels over the sparse points of "saharov", with its photos; a synthetic cloud where it is absent."""
    folder = data / "saharov"
    if not folder.is_dir():
        stand_in = cloud(n, 670, 1013)
        return replace(stand_in, name=f"saharov stand-in, {stand_in.name}", note=f"synthetic: no {folder}")
    loaded = nw.load_scene(folder)
    surfels = _cover(loaded.points, loaded.colors.float() / 255, n)
    cameras = tuple(view.camera for view in loaded.train)
    name = f"saharov {_sizes(n, cameras[0].width, cameras[0].height)}"
    return SurfelScene(name, nw.Model(surfels, None), cameras, tuple(view.image for view in loaded.train))


def fox(model: Path, data: Path = Options.data) -> SurfelScene:
    """Take the model of a run of `nexwarp train` on "fox", and the cameras of its training views.

    Unlike those of the other scenes, these surfels are as training leaves them: of all sizes, in layers, most of them
    hidden by others.
    """
    trained = nw.load(model)
    file = model / CAMERAS_FILE
    if file.is_file():
        cameras = tuple(load_cameras(file)["train"].values())
    else:
        cameras = tuple(view.camera for view in nw.load_scene(data / "fox").train)
    name = f"fox, trained, {_sizes(len(trained.surfels), cameras[0].width, cameras[0].height)}"
    return SurfelScene(name, trained, cameras)


def cloud(n: int, width: int, height: int) -> SurfelScene:
    """Make a synthetic scene as large as the garden: a ball on a disc under a dome.

    The surfels' sizes follow n, so that they cover as much for any n.
    """
    generator = torch.Generator().manual_seed(0)
    counts = [n // 2, n // 4, n - n // 2 - n // 4]
    areas = torch.tensor([np.pi * GROUND_RADIUS**2, 4 * np.pi * BALL_RADIUS**2, 2 * np.pi * DOME_RADIUS**2])
    radius = GROUND_RADIUS * torch.rand(counts[0], generator=generator).sqrt()
    angle = 2 * np.pi * torch.rand(counts[0], generator=generator)
    ground = torch.stack([radius * angle.cos(), radius * angle.sin(), torch.zeros_like(angle)], dim=1)
    ball = BALL_RADIUS * _directions(counts[1], generator) + torch.tensor([0.0, 0.0, BALL_RADIUS])
    dome = DOME_RADIUS * _directions(counts[2], generator)
    dome[:, 2].abs_()
    points = torch.cat([ground, ball, dome])
    spacing = (areas / torch.tensor(counts).clamp_min(1)).sqrt().repeat_interleave(torch.tensor(counts))
    surfels = _surfels(points, spacing, torch.rand(n, 3, generator=generator), generator)
    focal = 0.74 * width
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    target, up = torch.tensor([0.0, 0.0, 0.3]).double(), torch.tensor([0.0, 0.0, 1.0]).double()
    centers = [torch.tensor([1.5 * np.cos(a), 1.5 * np.sin(a), 0.8]) for a in np.linspace(0, 2 * np.pi, 8, False)]
    cameras = tuple(nw.Camera(look_at(c, target, up).float(), K, width, height) for c in centers)
    return SurfelScene(f"cloud {_sizes(n, width, height)}", nw.Model(surfels, None), cameras)


def _sizes(n: int, width: int, height: int) -> str:
    return f"{n:,} at {width}x{height}"


def _directions(count: int, generator: torch.Generator) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


def _cover(points: torch.Tensor, colors: torch.Tensor, n: int, spread: float = 1.0) -> nw.Surfels:
    """Spread n surfels over points, as large as those lie apart, times `spread`."""
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(points.numpy()).query(points.numpy(), k=4, workers=-1)
    spacing = torch.from_numpy(distances[:, 1:].mean(axis=1)).float()
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(len(points) * -(-n // len(points)), generator=generator)[:n] % len(points)
    size = spacing[chosen] * max((len(points) / n) ** 0.5, 0.6) * spread
    means = points[chosen] + torch.randn(n, 3, generator=generator) * size[:, None] * 0.5
    return _surfels(means, size, colors[chosen], generator)


def _surfels(means: torch.Tensor, size: torch.Tensor, colors: torch.Tensor, generator: torch.Generator) -> nw.Surfels:
    """Random orientations, sizes around the given ones, mostly high opacities, and a little view dependence."""
    n = len(means)
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=1)
    scales = size[:, None] * torch.exp(torch.randn(n, 2, generator=generator) * 0.3)
    opacities = torch.sigmoid(torch.randn(n, generator=generator) * 1.5 + 1.0)
    sh = torch.randn(n, 16, 3, generator=generator) * 0.02
    sh[:, 0] = (colors - 0.5) / SH_DC
    return nw.Surfels.from_activated(means, quats, scales.clamp_min(1e-9), opacities, torch.ones(n, 2), sh)
