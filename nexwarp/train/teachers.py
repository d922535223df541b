"""Learning from other models of the scene: every other step compares with a rendering of a teacher. Not in the paper.

Models that were trained with other seeds differ where photos say little. A student of several regresses to their mean,
from cameras where there is no photo.
"""

import dataclasses
import hashlib
import math
from collections.abc import Sequence

import torch

from nexwarp.camera import Camera
from nexwarp.cameras.between import between
from nexwarp.data import Scene
from nexwarp.determinism import derived_seed
from nexwarp.model.model import Model
from nexwarp.representation.surfels import PARAMETERS
from nexwarp.train.config import Config
from nexwarp.train.target import Target

EVERY = 2  # of so many steps the first one learns from a teacher; the log has lines of even steps, with photos
SAME_SCALE = 1e-3  # share by which the scale of a teacher's scene may differ from that of the training's
STREAM = 2  # number of the random numbers; those of a view's target are 0 and 1


class Teachers:
    """Trained models of a scene, and the cameras from which a training looks at them.

    Each training view has its turn once in a round, as have photos; a turn has one teacher, drawn at random, and a
    camera on the line through the view's and a neighbour's (`between`). All of it follows from the seed and the step,
    so that a checkpoint needs nothing of it.
    """

    def __init__(self, models: Sequence[Model], scene: Scene, config: Config, device: torch.device) -> None:
        """Check that the models fit.

        Args:
            models: of the scene, trained, at least one; they are moved to the device.
            scene: of the training.
            config: settings of the training.
            device: of the training.

        Raises:
            TypeError: one is not a model.
            ValueError: one is of another scene, or the training learns poses or motions, which teachers do not follow.
        """
        if config.refine_poses or config.blur_poses > 1:
            raise ValueError("teachers: expected refine_poses=False and blur_poses=1, for poses that stay as given")
        for number, model in enumerate(models):
            if not isinstance(model, Model):
                raise TypeError(f"teachers[{number}]: expected a nexwarp.Model, got {type(model).__name__}")
            scale = model.meta.get("scene_scale")
            if isinstance(scale, (int, float)) and not math.isclose(scale, scene.scale, rel_tol=SAME_SCALE):
                raise ValueError(
                    f"teachers[{number}]: expected a model of {scene.path}, whose scale is {scene.scale:.6g}, "
                    f"got one of a scene of scale {scale:.6g}"
                )
        self.models = [model.to(device) for model in models]
        self.cameras, self.seed = [view.camera for view in scene.train], config.seed
        self.round = -1
        self.turns: list[tuple[int, Camera, Model]] = []

    def has_turn(self, number: int) -> bool:
        """Whether a step, counted from 1, learns from a teacher instead of a photo."""
        return number % EVERY == 1

    def turn(self, number: int) -> tuple[int, Camera, Model]:
        """Return what the step of that number looks at: index of a training view, a camera near it, and a teacher."""
        round_, place = divmod(number // EVERY, len(self.cameras))
        if round_ != self.round:
            generator = torch.Generator().manual_seed(derived_seed(self.seed, round_, STREAM))
            cameras = between(self.cameras, generator)
            order = torch.randperm(len(cameras), generator=generator).tolist()
            drawn = torch.randint(len(self.models), (len(cameras),), generator=generator).tolist()
            self.turns = [(index, cameras[index], self.models[k]) for index, k in zip(order, drawn, strict=True)]
            self.round = round_
        return self.turns[place]

    def show(self, target: Target, number: int) -> Target:
        """Return the target of a step: a teacher's rendering at the photos' mean exposure.

        Args:
            target: of the photo of the step's training view; it has the picture's size.
            number: of the step.
        """
        _, near, teacher = self.turn(number)
        c = target.camera
        camera = Camera(near.viewmat.to(c.K.device), c.K, c.width, c.height, c.near)
        with torch.no_grad():
            picture = teacher.render(camera, background=target.background, exposure="mean").image.clone()
        # Gains of 1, and depths of 0, which stand for no point: without masks, steps with photos have the same graph.
        exposure = None if target.exposure is None else torch.ones_like(target.exposure)
        depths = None if target.expected is None else torch.zeros_like(target.expected)
        return dataclasses.replace(
            target, camera=camera, photo=picture, exposure=exposure, expected=depths, counts=None, empty=None
        )

    def digest(self) -> str:
        """Return a digest of the teachers' surfels."""
        digest = hashlib.sha256()
        for model in self.models:
            for name in PARAMETERS:
                digest.update(getattr(model.surfels, name).detach().cpu().contiguous().numpy().data)
        return digest.hexdigest()
