"""The quality benchmark's scenes: loaded, with other test views, scaled or moved."""

import dataclasses
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path

import torch

from benchmarks.quality.jobs import ARC_VIEWS, DEMO, THINNED, TrainingJob
from nexwarp.cameras.camera import Camera
from nexwarp.data import Scene, View, load_scene
from nexwarp.data.demo import demo_folder
from nexwarp.data.scene import TEST_EVERY


def inner_validation(scene: Scene, first: int = 0) -> Scene:
    """Hold out every 8th training view from the `first` on, to choose settings by; the test views are left out."""
    test = scene.train[first::TEST_EVERY]
    train = [view for index, view in enumerate(scene.train) if index % TEST_EVERY != first]
    return dataclasses.replace(scene, train=train, test=test)


def of_training_views(scene: Scene) -> Scene:
    """Drop points that no training view was used for, and take the others' colours from training photos alone.

    Structure from motion saw all photos: its points and their colours tell of places that only test photos show.
    Scenes whose views do not say which points they show stay as they are.
    """
    rows = {place.tobytes(): row for row, place in enumerate(scene.points.numpy())}
    sums, counts = torch.zeros(len(scene.points), 3), torch.zeros(len(scene.points))
    for view in scene.train:
        if view.points is None:
            return scene
        pixels, depths = view.camera.project(view.points)
        size = torch.tensor([view.camera.width, view.camera.height])
        inside = (depths > 0) & ((pixels >= 0) & (pixels < size)).all(1)
        found = torch.tensor([rows.get(place.tobytes(), -1) for place in view.points[inside].numpy()])
        column, line = pixels[inside].long()[found >= 0].unbind(1)
        found = found[found >= 0]
        sums.index_add_(0, found, view.image[line, column].float())
        counts.index_add_(0, found, torch.ones(len(found)))
    seen = counts > 0
    colors = (sums[seen] / counts[seen, None]).round().to(torch.uint8)
    points = {name: getattr(scene, name)[seen] for name in ("points", "track_lengths", "reprojection_errors")}
    return dataclasses.replace(scene, colors=colors if scene.colors.dtype == torch.uint8 else colors / 255, **points)


def held_out_arc(scene: Scene) -> Scene:
    """Hold out `ARC_VIEWS` neighbouring views from the middle of the capture, in place of every 8th view."""
    views = sorted((*scene.train, *scene.test), key=lambda view: view.name)
    first = (len(views) - ARC_VIEWS) // 2
    test = views[first : first + ARC_VIEWS]
    train = views[:first] + views[first + ARC_VIEWS :]
    return of_training_views(dataclasses.replace(scene, train=train, test=test))


def thinned(scene: Scene, every: int) -> Scene:
    """Hold out the validation views of `inner_validation`, and train on one photo of `every` others.

    The same views thus tell what a setting does with fewer photos.
    """
    part = inner_validation(scene)
    return of_training_views(dataclasses.replace(part, train=part.train[::every]))


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


def with_near(scene: Scene, near: float = 0.2) -> Scene:
    """Move the near planes of all cameras to a z-depth, world units; the default is that of the authors' code."""

    def view(v: View) -> View:
        c = v.camera
        return dataclasses.replace(v, camera=Camera(c.viewmat, c.K, c.width, c.height, near))

    return dataclasses.replace(scene, train=[view(v) for v in scene.train], test=[view(v) for v in scene.test])


VARIANTS: dict[str, Callable[[Scene], Scene]] = {
    "inner": inner_validation,
    # The other folds: with all eight, every training view is held out once.
    **{f"inner{first}": partial(inner_validation, first=first) for first in range(1, TEST_EVERY)},
    **{name: partial(thinned, every=every) for name, every in THINNED.items()},
    "arc": held_out_arc,
    "near": with_near,
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
