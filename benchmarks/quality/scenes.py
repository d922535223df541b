"""The quality benchmark's scenes: loaded, with other test views, scaled or moved."""

import dataclasses
from functools import lru_cache
from pathlib import Path

import torch

from benchmarks.quality.jobs import DEMO, TrainingJob
from nexwarp.camera import Camera
from nexwarp.data import Scene, View, load_scene
from nexwarp.data.demo import demo_folder

ARC_VIEWS = 8


def held_out_arc(scene: Scene) -> Scene:
    """Hold out `ARC_VIEWS` neighbouring views from the middle of the capture, in place of every 8th view."""
    views = sorted((*scene.train, *scene.test), key=lambda view: view.name)
    first = (len(views) - ARC_VIEWS) // 2
    test = views[first : first + ARC_VIEWS]
    return dataclasses.replace(scene, train=views[:first] + views[first + ARC_VIEWS :], test=test)


def moved(scene: Scene, factor: float = 1.0, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scene:
    """Map world points x to factor x + shift."""
    offset = torch.tensor(shift, dtype=torch.float64)

    def view(v: View) -> View:
        viewmat = v.camera.viewmat.double().clone()
        viewmat[:3, 3] = factor * viewmat[:3, 3] - viewmat[:3, :3] @ offset
        c = v.camera
        camera = Camera(viewmat.float(), c.K, c.width, c.height, c.near * factor)
        points = None if v.points is None else (factor * v.points.double() + offset).float()
        return dataclasses.replace(v, camera=camera, points=points)

    return dataclasses.replace(
        scene,
        train=[view(v) for v in scene.train],
        test=[view(v) for v in scene.test],
        points=(factor * scene.points.double() + offset).float(),
        scale=factor * scene.scale,
    )


VARIANTS = {
    "arc": held_out_arc,
    "x100": lambda scene: moved(scene, factor=100.0),
    "moved": lambda scene: moved(scene, shift=(1000.0, 0.0, 0.0)),
}


def scene_of(job: TrainingJob, data: Path) -> Scene:
    """Return the scene of a job; the last one is kept.

    Args:
        job: its scene, variant and downscale count.
        data: folder of the scenes.
    """
    return _load(demo_folder() if job.scene == DEMO else data / job.scene, job.variant, job.downscale)


@lru_cache(maxsize=1)
def _load(path: Path, variant: str, downscale: int) -> Scene:
    scene = load_scene(path, downscale=downscale)
    return VARIANTS[variant](scene) if variant else scene
