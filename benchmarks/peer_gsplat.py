"""gsplat's 3DGS and 2DGS, trained as its own example trainers do, on our scenes and views.

gsplat is optional: `pip install gsplat==1.5.3`, with a CUDA compiler to build it. Its library does the rendering and
the density control; this module is the loop around them, with the settings of its examples (`simple_trainer.py mcmc`
and `default`, `simple_trainer_2dgs.py`): scene centred on the cameras and scaled to their median distance, points as
initial means, L1 + 0.2 D-SSIM. With MCMC: opacity 0.5, scale a tenth of the distance to 3 neighbours, opacity and
scale regularised by 0.01. D-SSIM is ours, of clamped images, with "same" padding in place of "valid". `PeerSettings`
adds what our default has and the examples lack.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.data import Scene
from nexwarp.kernels.sh import BAND_0
from nexwarp.model.exposures import Exposures
from nexwarp.ops.ssim import weighted_dssim
from nexwarp.train.exposure import ExposureCalibration, calibrate_exposures
from nexwarp.train.initial import starting_points
from nexwarp.train.losses import SATURATION
from nexwarp.train.recipe import Config
from nexwarp.train.target import TrainingViews, mean_color

FLOATS = {"3dgs": 11, "2dgs": 10}  # a primitive without SH: means 3, quats 4, scales 3 or 2, opacity 1
NEAR = {"3dgs": 0.01, "2dgs": 0.2}  # the examples' near planes, in the normalised frame
SH_DEGREE = 3
SH_EVERY = 1000
REFERENCE_ITERATIONS = 30_000


@dataclass(frozen=True)
class PeerSettings:
    """How gsplat is trained.

    Attributes:
        primitive: "3dgs" or "2dgs".
        strategy: "mcmc", or "default" for gradients that split and duplicate; 2DGS has the default strategy alone.
            The default strategy has no budget: it does not grow while there are as many primitives as the budget.
        background: put the photos' mean colour behind everything instead of black.
        exposures: train at the photos' mean exposure and render with predicted gains, as our default does, where our
            gate uses exposures.
        even_start: start at half the budget from points chosen by farthest point sampling, as we do.
        skybox: with `even_start`, as `Config.skybox`: some of these points lie on a sphere around the scene.
    """

    primitive: str = "3dgs"
    strategy: str = "mcmc"
    background: bool = False
    exposures: bool = False
    even_start: bool = False
    skybox: int = 0

    def __post_init__(self) -> None:
        if self.primitive not in FLOATS:
            raise ValueError(f"primitive: expected one of {', '.join(FLOATS)}, got {self.primitive!r}")
        if self.strategy not in ("mcmc", "default"):
            raise ValueError(f"strategy: expected mcmc or default, got {self.strategy!r}")
        if self.primitive == "2dgs" and self.strategy == "mcmc":
            raise ValueError("strategy: expected default for 2dgs, got mcmc")


@dataclass
class Gaussians:
    """Trained parameters and how to see them.

    Attributes:
        splats: raw parameters by gsplat's names.
        centre: (3,) of the normalised frame, world units.
        unit: world units in one of the normalised frame.
        primitive: "3dgs" or "2dgs".
        background: (3,) colour behind everything.
        exposures: predict the gains of cameras; None is the mean exposure.
    """

    splats: torch.nn.ParameterDict
    centre: torch.Tensor
    unit: float
    primitive: str
    background: torch.Tensor
    exposures: Exposures | None = None

    @property
    def megabytes(self) -> float:
        """On disk as float32, 10^6 bytes."""
        floats = FLOATS[self.primitive] + 3 * (SH_DEGREE + 1) ** 2
        return len(self.splats["means"]) * floats * 4 / 1e6

    def image(self, camera: Camera) -> torch.Tensor:
        """Return an image (H, W, 3), not clamped, at the exposure that is predicted for the camera."""
        image, _ = self.render(camera)
        return image if self.exposures is None else image * self.exposures.factors(camera)

    def render(self, camera: Camera, degree: int = SH_DEGREE) -> tuple[torch.Tensor, dict[str, Any]]:
        """Return an image (H, W, 3), not clamped, and gsplat's intermediate results for its strategy.

        Args:
            camera: the view.
            degree: SH degree to evaluate.
        """
        from gsplat import rendering

        s = self.splats
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] = (viewmat[:3, :3] @ self.centre + viewmat[:3, 3]) / self.unit
        rasterize = rendering.rasterization if self.primitive == "3dgs" else rendering.rasterization_2dgs
        image, *_, info = rasterize(
            means=s["means"],
            quats=s["quats"],
            scales=torch.exp(s["scales"]),
            opacities=torch.sigmoid(s["opacities"]),
            colors=torch.cat([s["sh0"], s["shN"]], 1),
            viewmats=viewmat[None],
            Ks=camera.K[None],
            width=camera.width,
            height=camera.height,
            near_plane=NEAR[self.primitive],
            sh_degree=degree,
            packed=False,
            backgrounds=self.background[None],
        )
        return image[0], info


def train(
    scene: Scene,
    count: int,
    iterations: int,
    seed: int,
    device: torch.device,
    settings: PeerSettings | None = None,
    observe: Callable[[Gaussians], None] | None = None,
) -> Gaussians:
    """Train `count` Gaussians at most; `settings` None are those of gsplat's MCMC example.

    `observe` is called after each step.
    """
    settings = settings or PeerSettings()
    torch.manual_seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    calibration = calibrate_exposures(scene, Config()) if settings.exposures else None
    gaussians, extent = _initial(scene, count, settings, calibration, device)
    stretch = iterations / REFERENCE_ITERATIONS
    rates = {
        "means": 1.6e-4 * extent,
        "scales": 5e-3,
        "quats": 1e-3,
        "opacities": 5e-2,
        "sh0": 2.5e-3,
        "shN": 2.5e-3 / 20,
    }
    optimizers = {
        name: torch.optim.Adam([{"params": gaussians.splats[name], "lr": rate, "name": name}], eps=1e-15, fused=True)
        for name, rate in rates.items()
    }
    control = _Control(settings, count, stretch, extent, gaussians, optimizers)
    decay = 0.01 ** (1 / iterations)
    views = TrainingViews(scene.train, device, calibration)
    order: list[int] = []
    for step in range(iterations):
        order = order or torch.randperm(len(views)).tolist()
        index = order.pop()
        camera, photo = views.get(index)
        degree = min(step // max(round(SH_EVERY * stretch), 1), SH_DEGREE)
        image, info = gaussians.render(camera, degree)
        control.before(step, info)
        exposure = views.exposure(index)
        if exposure is not None:
            image = image * exposure
            image = torch.where((photo >= SATURATION) & (image > photo), photo, image)
        loss = 0.8 * (image - photo).abs().mean() + weighted_dssim(image, photo, 0.2)
        if settings.strategy == "mcmc":
            loss = loss + 0.01 * torch.sigmoid(gaussians.splats["opacities"]).mean()
            loss = loss + 0.01 * torch.exp(gaussians.splats["scales"]).mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        control.after(step, info)
        optimizers["means"].param_groups[0]["lr"] *= decay
        if observe is not None:
            observe(gaussians)
    return gaussians


class _Control:
    """gsplat's density control."""

    def __init__(
        self,
        settings: PeerSettings,
        count: int,
        stretch: float,
        extent: float,
        gaussians: Gaussians,
        optimizers: dict[str, torch.optim.Adam],
    ) -> None:
        from gsplat.strategy import DefaultStrategy, MCMCStrategy

        self.count, self.splats, self.optimizers = count, gaussians.splats, optimizers
        self.mcmc = settings.strategy == "mcmc"
        every = max(round(100 * stretch), 10)
        times = {"refine_start_iter": round(500 * stretch), "refine_every": every}
        if self.mcmc:
            self.strategy = MCMCStrategy(cap_max=count, refine_stop_iter=round(25_000 * stretch), **times)
            self.state = self.strategy.initialize_state()
        else:
            key = "means2d" if settings.primitive == "3dgs" else "gradient_2dgs"
            self.strategy = DefaultStrategy(
                refine_stop_iter=round(15_000 * stretch),
                reset_every=max(round(3000 * stretch), every),
                key_for_gradient=key,
                **times,
            )
            self.threshold = self.strategy.grow_grad2d
            self.state = self.strategy.initialize_state(scene_scale=extent)
        self.strategy.check_sanity(self.splats, optimizers)

    def before(self, step: int, info: dict[str, Any]) -> None:
        """Prepare what the strategy reads after the backward pass."""
        if not self.mcmc:
            self.strategy.step_pre_backward(self.splats, self.optimizers, self.state, step, info)

    def after(self, step: int, info: dict[str, Any]) -> None:
        """Add and remove primitives."""
        if self.mcmc:
            rate = self.optimizers["means"].param_groups[0]["lr"]
            self.strategy.step_post_backward(self.splats, self.optimizers, self.state, step, info, lr=rate)
            return
        self.strategy.grow_grad2d = self.threshold if len(self.splats["means"]) < self.count else math.inf
        self.strategy.step_post_backward(self.splats, self.optimizers, self.state, step, info, packed=False)


def _initial(
    scene: Scene, count: int, settings: PeerSettings, calibration: ExposureCalibration | None, device: torch.device
) -> tuple[Gaussians, float]:
    """Gaussians at the scene's points, and the extent that scales the learning rate of the means."""
    from scipy.spatial import cKDTree

    cameras = torch.stack([view.camera.position for view in (*scene.train, *scene.test)])
    centre = cameras.mean(0)
    unit = float(np.median((cameras - centre).norm(dim=1).numpy()))
    train = (torch.stack([view.camera.position for view in scene.train]) - centre) / unit
    extent = 1.1 * float((train - train.mean(0)).norm(dim=1).max())
    points, colors = scene.points, scene.colors.float() / 255 if calibration is None else calibration.colors
    if settings.even_start:
        start = starting_points(scene, Config(max_surfels=count, skybox=settings.skybox), colors)
        points, colors = start.means, start.colors
    elif len(points) > count:
        chosen = torch.randperm(len(points))[:count]
        points, colors = points[chosen], colors[chosen]
    points = (points - centre) / unit
    distances, _ = cKDTree(points.numpy()).query(points.numpy(), k=4)
    spacing = torch.from_numpy(np.sqrt((distances[:, 1:] ** 2).mean(1))).float().clamp_min(1e-9)
    mcmc = settings.strategy == "mcmc"
    opacity = 0.5 if mcmc else 0.1
    splats = {
        "means": points,
        "scales": (spacing * (0.1 if mcmc else 1.0)).log()[:, None].repeat(1, 3),  # 2DGS reads two of them
        "quats": torch.rand(len(points), 4),
        "opacities": torch.full((len(points),), math.log(opacity / (1 - opacity))),
        "sh0": ((colors - 0.5) / BAND_0)[:, None],
        "shN": torch.zeros(len(points), (SH_DEGREE + 1) ** 2 - 1, 3),
    }
    parameters = torch.nn.ParameterDict({name: torch.nn.Parameter(x.contiguous()) for name, x in splats.items()})
    background = torch.tensor(mean_color(scene.train, calibration) if settings.background else (0.0, 0.0, 0.0))
    exposures = None if calibration is None else calibration.exposures.to(device)
    place = centre.to(device), unit
    return Gaussians(parameters.to(device), *place, settings.primitive, background.to(device), exposures), extent
