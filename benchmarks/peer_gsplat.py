"""gsplat's 3DGS with its MCMC strategy, trained as its own example trainer does, on our scenes and views.

gsplat is optional: `pip install gsplat==1.5.3`, with a CUDA compiler to build it. Its library does the rendering and
the density control; this module is the loop around them, with the settings of its example (`simple_trainer.py mcmc`):
scene centred on the cameras and scaled to their median distance, points as initial means, opacity 0.5, scale a
tenth of the distance to 3 neighbours, L1 + 0.2 D-SSIM, opacity and scale regularised by 0.01. D-SSIM is ours, with
"same" padding in place of "valid".
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from nexwarp.camera import Camera
from nexwarp.data import Scene
from nexwarp.kernels.sh import BAND_0
from nexwarp.train.losses import image_loss

FLOATS = 59  # a Gaussian: means 3, quats 4, scales 3, opacity 1, SH 48
SH_DEGREE = 3
SH_EVERY = 1000
REFERENCE_ITERATIONS = 30_000


@dataclass
class Gaussians:
    """Trained parameters and how to see them.

    Attributes:
        splats: raw parameters by gsplat's names.
        centre: (3,) of the normalised frame, world units.
        unit: world units in one of the normalised frame.
    """

    splats: torch.nn.ParameterDict
    centre: torch.Tensor
    unit: float

    @property
    def megabytes(self) -> float:
        """On disk as float32, 10^6 bytes."""
        return len(self.splats["means"]) * FLOATS * 4 / 1e6

    def render(self, camera: Camera, degree: int = SH_DEGREE) -> tuple[torch.Tensor, dict[str, Any]]:
        """Return an image (H, W, 3), not clamped, over black, and gsplat's intermediate results for its strategy."""
        from gsplat.rendering import rasterization

        s = self.splats
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] = (viewmat[:3, :3] @ self.centre + viewmat[:3, 3]) / self.unit
        image, _, info = rasterization(
            means=s["means"],
            quats=s["quats"],
            scales=torch.exp(s["scales"]),
            opacities=torch.sigmoid(s["opacities"]),
            colors=torch.cat([s["sh0"], s["shN"]], 1),
            viewmats=viewmat[None],
            Ks=camera.K[None],
            width=camera.width,
            height=camera.height,
            near_plane=0.01,
            sh_degree=degree,
            packed=False,
        )
        return image[0], info


def train(scene: Scene, count: int, iterations: int, seed: int, device: torch.device) -> Gaussians:
    """Train `count` Gaussians at most."""
    from gsplat.strategy import MCMCStrategy

    torch.manual_seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    gaussians, extent = _initial(scene, count, device)
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
    strategy = MCMCStrategy(
        cap_max=count,
        refine_start_iter=round(500 * stretch),
        refine_stop_iter=round(25_000 * stretch),
        refine_every=max(round(100 * stretch), 10),
    )
    strategy.check_sanity(gaussians.splats, optimizers)
    state = strategy.initialize_state()
    decay = 0.01 ** (1 / iterations)
    views = [(view.camera.to(device), view.image.to(device)) for view in scene.train]
    order: list[int] = []
    for step in range(iterations):
        order = order or torch.randperm(len(views)).tolist()
        camera, photo = views[order.pop()]
        degree = min(step // max(round(SH_EVERY * stretch), 1), SH_DEGREE)
        image, info = gaussians.render(camera, degree)
        loss = image_loss(image, photo.float() / 255, 0.2)
        loss = loss + 0.01 * torch.sigmoid(gaussians.splats["opacities"]).mean()
        loss = loss + 0.01 * torch.exp(gaussians.splats["scales"]).mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        rate = optimizers["means"].param_groups[0]["lr"]
        strategy.step_post_backward(gaussians.splats, optimizers, state, step, info, lr=rate)
        optimizers["means"].param_groups[0]["lr"] = rate * decay
    return gaussians


def _initial(scene: Scene, count: int, device: torch.device) -> tuple[Gaussians, float]:
    """Gaussians at the scene's points, and the extent that scales the learning rate of the means."""
    from scipy.spatial import cKDTree

    cameras = torch.stack([view.camera.position for view in (*scene.train, *scene.test)])
    centre = cameras.mean(0)
    unit = float(np.median((cameras - centre).norm(dim=1).numpy()))
    train = (torch.stack([view.camera.position for view in scene.train]) - centre) / unit
    extent = 1.1 * float((train - train.mean(0)).norm(dim=1).max())
    points, colors = scene.points, scene.colors.float() / 255
    if len(points) > count:
        chosen = torch.randperm(len(points))[:count]
        points, colors = points[chosen], colors[chosen]
    points = (points - centre) / unit
    distances, _ = cKDTree(points.numpy()).query(points.numpy(), k=4)
    spacing = torch.from_numpy(np.sqrt((distances[:, 1:] ** 2).mean(1))).float().clamp_min(1e-9)
    bands = (SH_DEGREE + 1) ** 2
    splats = {
        "means": points,
        "scales": (spacing * 0.1).log()[:, None].repeat(1, 3),
        "quats": torch.rand(len(points), 4),
        "opacities": torch.full((len(points),), math.log(0.5 / 0.5)),
        "sh0": ((colors - 0.5) / BAND_0)[:, None],
        "shN": torch.zeros(len(points), bands - 1, 3),
    }
    parameters = torch.nn.ParameterDict({name: torch.nn.Parameter(x.contiguous()) for name, x in splats.items()})
    return Gaussians(parameters.to(device), centre.to(device), unit), extent
