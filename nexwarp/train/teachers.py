"""Learning from other models of the scene: every other step compares with a teacher's rendering. Not in the paper.

Models that were trained with other seeds differ where photos say little. A student of several settles between them,
also in views that no photo has.
"""

import dataclasses
import hashlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from functools import partial

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import between
from nexwarp.data import Scene
from nexwarp.machine import derived_seed
from nexwarp.model.graphs import MOST_GRAPHS, share_graphs, without_graphs
from nexwarp.model.model import Model
from nexwarp.train.exposure import ExposureCalibration
from nexwarp.train.initial import check_scale
from nexwarp.train.recipe import Config
from nexwarp.train.state import TrainingState
from nexwarp.train.target import Target, TargetSource

EVERY = 2  # the second of so many steps learns from a teacher: the log's lines are of odd steps, which have photos
STREAM = 2  # series of random numbers, as `derived_seed` counts them; those of a view's target are 0 and 1


class TaughtTargets(TargetSource):
    """Targets of a training that learns from other models, too: every other step compares with a rendering of one.

    Such a step has one of the training views, each once in a round, a camera on the line through this view's and a
    neighbour's (`between`), and a teacher drawn at random. All of it follows from the seed and the step's number, so
    that a checkpoint needs nothing of it.
    """

    def __init__(
        self,
        state: TrainingState,
        calibration: ExposureCalibration | None,
        models: Sequence[Model],
        repeatable: Callable[[Callable[[], Target]], Target],
    ) -> None:
        """Move the models to the device; on a GPU their frames share memory from then on.

        `repeatable` renders, again with more memory where it does not suffice.
        """
        super().__init__(state, calibration)
        self.teachers, self.repeatable = [model.to(state.device) for model in models], repeatable
        if state.device.type == "cuda":
            share_graphs([model.surfels for model in self.teachers])
        self.cameras = [view.camera for view in self.scene.train]
        sizes = {(camera.width, camera.height) for camera in self.cameras}
        self.launches = without_graphs if len(sizes) > MOST_GRAPHS else nullcontext
        self.round = -1
        self.choices: list[tuple[int, Camera, Model]] = []

    def teaches(self, number: int) -> bool:
        """Whether a step, counted from 1, learns from a teacher instead of a photo; the last one does not."""
        return number % EVERY == 0 and number != self.config.iterations

    def choice(self, number: int) -> tuple[int, Camera, Model]:
        """Return what a step with a teacher has: index of a training view, a camera near it, and the teacher."""
        round_, place = divmod(number // EVERY - 1, len(self.cameras))
        if round_ != self.round:
            generator = torch.Generator().manual_seed(derived_seed(self.config.seed, round_, STREAM))
            cameras = between(self.cameras, generator)
            order = torch.randperm(len(cameras), generator=generator).tolist()
            drawn = torch.randint(len(self.teachers), (len(cameras),), generator=generator).tolist()
            self.choices = [(index, cameras[index], self.teachers[k]) for index, k in zip(order, drawn, strict=True)]
            self.round = round_
        return self.choices[place]

    def next_view(self, number: int) -> int:
        """Return the index of the training view with that number in the training, from 1."""
        return self.choice(number)[0] if self.teaches(number) else super().next_view(number)

    def make(self, index: int, number: int, upcoming: list[int]) -> Target:
        """Make the target of a step, with the photo or with a teacher's rendering."""
        target = super().make(index, number, upcoming)
        return self.repeatable(partial(self.taught, target, number)) if self.teaches(number) else target

    def taught(self, of_photo: Target, number: int) -> Target:
        """Return the target of a step with a teacher: its rendering, of the photo's size, at the mean exposure."""
        _, near, teacher = self.choice(number)
        c = of_photo.camera
        camera = Camera(near.viewmat.to(c.K.device), c.K, c.width, c.height, c.near, origin=near.origin)
        with self.launches():
            picture = teacher.render_image(camera, background=of_photo.background, exposure="mean")
        # Gains of 1, and depths of 0, which stand for no point: without masks, steps with photos have the same graph.
        exposure = None if of_photo.exposure is None else torch.ones_like(of_photo.exposure)
        depths = None if of_photo.expected is None else torch.zeros_like(of_photo.expected)
        return dataclasses.replace(
            of_photo, camera=camera, photo=picture, exposure=exposure, expected=depths, counts=None, empty=None
        )


def teachers_digest(teachers: Iterable[Model]) -> str:
    """Return a digest of teachers, in their order."""
    digest = hashlib.sha256()
    for model in teachers:
        digest.update(str(model.options).encode())
        for name, value in model.state_dict().items():
            digest.update(name.encode() + value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def check_teachers(teachers: Iterable[Model], scene: Scene, config: Config) -> list[Model]:
    """Return the models that a training learns from as a list; TypeError or ValueError where they do not fit it."""
    if config.teachers:
        raise ValueError(
            f"config.teachers: expected 0 or None, as a Trainer trains one model, got {config.teachers}; "
            "nexwarp.train trains teachers first"
        )
    if isinstance(teachers, Model):
        raise TypeError("teachers: expected a list of models, got one nexwarp.Model")
    models = list(teachers)
    if models and config.refine_poses:
        raise ValueError("teachers: expected refine_poses=False, for poses that stay as given")
    for number, model in enumerate(models):
        if not isinstance(model, Model):
            raise TypeError(f"teachers[{number}]: expected a nexwarp.Model, got {type(model).__name__}")
        check_scale(f"teachers[{number}]", model, scene)
    return models
