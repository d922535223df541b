"""Small values to write into files that are then damaged, and the check that a loaded one renders finite pictures."""

import dataclasses

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.data import Scene
from nexwarp.model.detail_limits import DetailLimits
from nexwarp.model.exposures import Exposures
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import NeuralTexture
from nexwarp.train.recipe import Config, TextureConfig
from nexwarp.train.trainer import Trainer

WIDTH, HEIGHT, VIEWS = 12, 9, 3
TEXTURE = TextureConfig(levels=2, table_size=16, width=8, hidden_layers=1)


def some_viewmats() -> list[np.ndarray]:
    """(4, 4) world to camera, on an arc around the origin, looking at it."""
    viewmats = []
    for index in range(VIEWS):
        angle = 0.4 * index
        forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.stack([[forward[1], -forward[0], 0.0], [0.0, 0.0, -1.0], forward])
        viewmat[2, 3] = 2.0
        viewmats.append(viewmat)
    return viewmats


def some_cameras() -> list[Camera]:
    K = torch.tensor([[10.0, 0.0, 6.0], [0.0, 11.0, 4.5], [0.0, 0.0, 1.0]])
    return [Camera(torch.from_numpy(viewmat).float(), K, WIDTH, HEIGHT) for viewmat in some_viewmats()]


def some_surfels() -> Surfels:
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator)

    return Surfels.from_activated(
        random(5, 3), random(5, 4) + 0.1, random(5, 2) + 0.1, random(5), 1 + random(5, 2), random(5, 4, 3)
    )


def some_model() -> Model:
    """Return a model with every part that a file can hold."""
    torch.manual_seed(0)
    texture = NeuralTexture(levels=2, table_size=16, width=8, hidden_layers=1, sh_degree=1)
    exposures = Exposures.of(0.1 * torch.randn(VIEWS, 3), some_cameras(), (-0.3, -0.2, 0.4))
    limits = DetailLimits(torch.full((5,), 0.02), torch.full((5,), 0.2))
    options = RenderOptions(background=(0.1, 0.2, 0.3), sh_degree=1)
    return Model(
        some_surfels(), texture, exposures, limits, options, {"near": 0.01, "scene_scale": 1.5, "preset": "default"}
    )


def some_trainer() -> Trainer:
    """Return a trainer of three random photos after two steps."""
    generator = torch.Generator().manual_seed(0)
    images = [torch.rand(HEIGHT, WIDTH, 3, generator=generator) for _ in range(VIEWS)]
    scene = Scene.from_tensors(images, some_cameras(), test_every=0)
    trainer = Trainer(scene, Config(iterations=4, max_surfels=20, sh_degree=1, texture=TEXTURE), "cpu")
    trainer.run(until=2)
    return trainer


@torch.no_grad()
def check_rendering(model: Model, camera: Camera | None = None) -> None:
    """Raise AssertionError unless a picture of a few pixels is finite, from the camera or one that sees the surfels."""
    camera = some_cameras()[0] if camera is None else dataclasses.replace(camera, width=4, height=3)
    out = model.render(camera)
    for name in ("image", "alpha", "depths", "expected_depth", "normals"):
        assert bool(torch.isfinite(getattr(out, name)).all()), f"{name} is not finite"
