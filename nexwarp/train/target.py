"""What a training step compares its rendering with: the training photos, or renderings of other models.

Learning from other models, the teachers, is not in the paper. Models that were trained with other seeds differ where
photos say little. A student of several settles between them, also in views that no photo has.
"""

import copy
import dataclasses
import hashlib
import weakref
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import torch

from nexwarp.cameras.camera import Camera, visible_points
from nexwarp.cameras.paths import between
from nexwarp.data import Scene, View
from nexwarp.errors import check_type
from nexwarp.machine import derived_seed, in_threads
from nexwarp.model.exposures import DECIMALS
from nexwarp.model.graphs import MOST_GRAPHS, share_graphs, without_graphs
from nexwarp.model.model import Model
from nexwarp.model.options import Color
from nexwarp.model.poses import PoseCorrections
from nexwarp.model.render import jitter_factors
from nexwarp.train.exposure import ExposureCalibration
from nexwarp.train.initial import check_scale
from nexwarp.train.recipe import Config
from nexwarp.train.state import TrainingState

# Photos stay on the GPU when they take less than this share of its free memory.
PHOTO_SHARE = 0.25
VALUES_A_THREAD = 500_000
EVERY = 2  # the second of so many steps learns from a teacher: the log's lines are of odd steps, which have photos
STREAM = 2  # series of random numbers, as `derived_seed` counts them; those of a view's target are 0 and 1


@dataclass(frozen=True)
class Target:
    """What a training step compares its rendering with; all tensors are on the device of the training.

    Attributes:
        camera: the camera that the step renders.
        photo: (H, W, 3) float in [0, 1], the photo.
        background: (3,) float32, the colour behind everything in this step.
        exposure: (3,) or (H, W, 3), the photo's gains times the lens's falloff; None is the mean exposure.
        counts: (H, W) bool, where the photo counts; None is everywhere.
        empty: (H, W) bool, where there is nothing but the background; None is nowhere.
        places: (M,) int64, row * W + column of the points whose depths are compared, ascending; None is no such loss.
        expected: (M,) z-depths of these points, world units; 0 stands for no point. None where `places` is None.
        depth: (H, W) z-depths of the photo's depth map, world units, 0 where there is none; None is no such loss.
        depth_jitter: (H, W, K), the `jitter` of `nexwarp.model.render.Frame`; None is none.
        view: (1,) int64, index of the training view; None where poses are not learned.
        normals: factor of the normal loss in this step.
    """

    camera: Camera
    photo: torch.Tensor
    background: Color
    exposure: torch.Tensor | None = None
    counts: torch.Tensor | None = None
    empty: torch.Tensor | None = None
    places: torch.Tensor | None = None
    expected: torch.Tensor | None = None
    depth: torch.Tensor | None = None
    depth_jitter: torch.Tensor | None = None
    view: torch.Tensor | None = None
    normals: float = 0.0


def refined(target: Target, poses: PoseCorrections | None) -> Target:
    """Return a target with the corrected camera; differentiable with respect to the corrections."""
    if poses is None or target.view is None:
        return target
    return dataclasses.replace(target, camera=poses.camera(target.camera, target.view))


class TargetSource:
    """Makes the targets of a training: each of its photos once an epoch, in random order.

    Attributes:
        views: the training views on the device.
        background: the colour behind everything, where it is not random.
        generator: of random backgrounds, on the CPU.
        noise: of the depth jitter, on the device.
        teachers: models that it compares with, too.
    """

    def __init__(self, state: TrainingState, calibration: ExposureCalibration | None) -> None:
        """Move the photos, of one exposure where `calibration` is None, to the device."""
        # The state holds this source: a cycle would keep the memory of both until the garbage collector comes.
        self.state: TrainingState = weakref.proxy(state)
        self.scene, self.config, self.poses = state.scene, state.config, state.poses
        self.views = TrainingViews(self.scene.train, state.device, calibration)
        self.background = self.config.background or self.scene.background or mean_color(self.scene.train, calibration)
        self.background_tensor = torch.tensor(self.background, dtype=torch.float32, device=state.device)
        self.generator, self.noise = state.generator, state.noise
        self.teachers: list[Model] = []
        self.points: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}

    def next_view(self, number: int) -> int:
        """Return the index of the training view with that number in the training, from 1."""
        state = self.state
        if not state.order:
            state.order = torch.randperm(len(self.views), generator=state.generator).tolist()
        return state.order.pop()

    def make(self, index: int, number: int) -> Target:
        """Make the target of a step with view `index`, number `number` of the training."""
        config, iteration = self.config, self.state.iteration
        target, jitter = self.from_view(index), None
        places, expected = self._points_in(index)
        if config.depth_jitter > 0 and config.max_hits:
            hits = config.hits_at(iteration)
            jitter = jitter_factors(target.camera, hits, config.depth_jitter, generator=self.noise)
        return dataclasses.replace(
            target,
            places=places,
            expected=expected,
            depth=self._depth_in(index),
            depth_jitter=jitter,
            view=None if self.poses is None else torch.tensor([index], device=self.views.device),
            normals=config.normals_at(iteration),
        )

    def from_view(self, index: int) -> Target:
        """Make the target of a view: photo, background and mask."""
        camera, photo = self.views.get(index)
        background = self.background_tensor
        if self.scene.random_background:
            drawn = torch.rand(3, generator=self.generator)
            background = drawn.to(self.views.device, non_blocking=True)
            alpha = self.views.alpha(index)
            if alpha is not None:
                photo = photo + (1 - alpha)[..., None] * (background - self.background_tensor)
        mask = self.views.mask(index)
        exposure = self.views.exposure(index)
        if mask is None or self.config.mask_mode == "ignore":
            return Target(camera, photo, background, exposure, counts=mask)
        return Target(camera, torch.where(mask[..., None], photo, background), background, exposure, empty=~mask)

    def _points_in(self, index: int) -> tuple[torch.Tensor, torch.Tensor] | tuple[None, None]:
        """Return places and z-depths of the points that view `index` shows; None without any, or without their loss."""
        points = self.scene.train[index].points
        if self.config.losses.depth == 0 or self.config.max_hits == 0 or points is None:
            return None, None
        camera, device = self.views.cameras[index], self.views.device
        if index not in self.points or self.poses is not None:  # a pose that moves sees them elsewhere
            with torch.no_grad():
                moved = camera if self.poses is None else self.poses.camera(camera, index)
                seen = moved.project(points.to(device))
            places, expected = visible_points(*seen, camera.width, camera.height, self.views.mask(index))
            places, order = places.sort(stable=True)
            # On CUDA, as many for every view, so that one graph serves all of them. Steps that are not captured pad
            # too: sums of other lengths are rounded differently.
            fill = (0, self._most_points - len(places) if device.type == "cuda" else 0)
            beyond, pad = camera.width * camera.height, torch.nn.functional.pad
            self.points[index] = pad(places, fill, value=beyond), pad(expected[order], fill)
        return self.points[index]

    def _depth_in(self, index: int) -> torch.Tensor | None:
        """Return the depth map of view `index`, 0 where it is masked; None without any, or without its loss."""
        if self.config.losses.depth_maps == 0 or self.config.max_hits == 0:
            return None
        depth = self.views.depth(index)
        mask = None if depth is None else self.views.mask(index)
        return depth if depth is None or mask is None else depth * mask

    @cached_property
    def _most_points(self) -> int:
        return max(len(view.points) for view in self.scene.train if view.points is not None)


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

    def make(self, index: int, number: int) -> Target:
        """Make the target of a step, with the photo or with a teacher's rendering."""
        target = super().make(index, number)
        return self.repeatable(partial(self.taught, target, number)) if self.teaches(number) else target

    def taught(self, of_photo: Target, number: int) -> Target:
        """Return the target of a step with a teacher: its rendering, of the photo's size, at the mean exposure."""
        _, near, teacher = self.choice(number)
        c = of_photo.camera
        camera = dataclasses.replace(
            c, viewmat=near.viewmat.to(c.K.device), origin=near.origin, checked=(c.fx, c.fy, c.cx, c.cy)
        )
        with self.launches():
            picture = teacher.render_image(camera, background=of_photo.background, exposure="mean")
        # Gains of 1, and depths of 0, which stand for no point: without masks, steps with photos have the same graph.
        exposure = None if of_photo.exposure is None else torch.ones_like(of_photo.exposure)
        expected, depth = (None if x is None else torch.zeros_like(x) for x in (of_photo.expected, of_photo.depth))
        target = dataclasses.replace(
            of_photo, exposure=exposure, expected=expected, depth=depth, counts=None, empty=None
        )
        return dataclasses.replace(target, camera=camera, photo=picture)


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
        check_type(f"teachers[{number}]", model, Model)
        check_scale(f"teachers[{number}]", model, scene)
    return models


class TrainingViews:
    """Training views on the device they are used on; photos stay 8-bit.

    Where photos take a quarter of the GPU's free memory or more, they stay in host memory, and each step copies its own
    through pinned memory, without waiting for it.
    """

    def __init__(self, views: list[View], device: torch.device, calibration: ExposureCalibration | None = None) -> None:
        """Move the views, whose photos have the exposures of a calibration or else one exposure, to a device."""
        self.device = device
        self.gains = None if calibration is None else calibration.gains.to(device)
        self.lens = None if calibration is None else copy.deepcopy(calibration.exposures).to(device)
        self.views = views
        self.cameras = [view.camera.to(device) for view in views]
        self.photos = [view.image for view in views]
        self.depths = [view.depth for view in views]
        self.has_depths = any(depth is not None for depth in self.depths)
        if device.type == "cuda":
            free, _ = torch.cuda.mem_get_info(device)
            if sum(x.nbytes for x in (*self.photos, *self.depths) if x is not None) < PHOTO_SHARE * free:
                self.photos = [p.to(device) for p in self.photos]
                self.depths = [None if depth is None else depth.to(device) for depth in self.depths]

    def __len__(self) -> int:
        return len(self.photos)

    def refined_cameras(self, poses: PoseCorrections | None) -> list[Camera]:
        """Return the cameras as they are given, on the CPU, or with corrected poses, on the device."""
        return [view.camera for view in self.views] if poses is None else poses.cameras(self.cameras)

    def refined(self, poses: PoseCorrections | None) -> list[View]:
        """Return the views with these cameras, as finishing and evaluation take them."""
        return with_cameras(self.views, self.refined_cameras(poses))

    def torch_threads(self, max_hits: int) -> int:
        """Return how many threads to give torch's own loops: on small images, to wake a second one takes longer."""
        all_threads, camera = torch.get_num_threads(), self.cameras[0]
        if self.device.type != "cpu":
            return all_threads
        return min(all_threads, 1 + 3 * camera.width * camera.height * max(max_hits, 1) // VALUES_A_THREAD)

    def fingerprint(self) -> str:
        """Return a digest of the views' names and cameras."""
        digest = hashlib.sha256()
        for view in self.views:
            camera = view.camera
            values = [*camera.viewmat.flatten().tolist(), *camera.K.flatten().tolist(), camera.width, camera.height]
            digest.update(f"{view.name} {values}\n".encode())
        return digest.hexdigest()

    def get(self, index: int) -> tuple[Camera, torch.Tensor]:
        """Return camera and photo (H, W, 3) float in [0, 1] of a view."""
        photo = self.photos[index]
        if photo.device.type != self.device.type:
            photo = photo.pin_memory().to(self.device, non_blocking=True)
        return self.cameras[index], photo / 255.0

    def exposure(self, index: int) -> torch.Tensor | None:
        """Return gains times falloff of a photo, (3,) or (H, W, 3); None where photos have one exposure."""
        if self.gains is None:
            return None
        falloff = None if self.lens is None else self.lens.falloff_of(self.cameras[index])
        return self.gains[index] if falloff is None else self.gains[index] * falloff

    def mask(self, index: int) -> torch.Tensor | None:
        """Return the mask (H, W) bool of a photo, or None."""
        mask = self.views[index].mask
        return None if mask is None else mask.to(self.device, non_blocking=True)

    def alpha(self, index: int) -> torch.Tensor | None:
        """Return alpha (H, W) float in [0, 1] of a photo; None if it is opaque."""
        alpha = self.views[index].alpha
        return None if alpha is None else alpha.to(self.device, non_blocking=True).float() / 255.0

    def depth(self, index: int) -> torch.Tensor | None:
        """Return the depths (H, W) float of a photo, 0 where unknown; None if no photo has any."""
        if not self.has_depths:
            return None
        depth, camera = self.depths[index], self.cameras[index]
        if depth is None:  # zeros: one CUDA graph serves all photos
            return torch.zeros(camera.height, camera.width, device=self.device)
        return depth.to(self.device, non_blocking=True).float()


def with_cameras(views: Sequence[View], cameras: Sequence[Camera]) -> list[View]:
    """Return views with other cameras, which may be on any device."""
    return [dataclasses.replace(view, camera=camera.to("cpu")) for view, camera in zip(views, cameras, strict=True)]


def mean_color(views: list[View], calibration: ExposureCalibration | None = None) -> tuple[float, float, float]:
    """Mean sRGB colour in [0, 1] of all pixels of the photos, each divided by its exposure."""

    def light(numbered: tuple[int, View]) -> torch.Tensor:
        index, view = numbered
        falloff = None if calibration is None else calibration.exposures.falloff_of(view.camera)
        shares = np.ones((1, 1)) if falloff is None else 1 / falloff[..., 0].double().numpy()
        # Integers have the same sum in any order; rounding hides that of the others. No photo is copied as floats.
        sums = np.einsum("hwc,hw->c", view.image.numpy(), np.broadcast_to(shares, view.image.shape[:2]))
        return torch.from_numpy(sums if calibration is None else sums / calibration.gains[index].double().numpy())

    total = sum(in_threads(light, enumerate(views)), torch.zeros(3, dtype=torch.float64))
    pixels = sum(view.image.shape[0] * view.image.shape[1] for view in views)
    mean = total / pixels / 255
    red, green, blue = (mean if calibration is None else mean.clamp(0, 1).round(decimals=DECIMALS)).tolist()
    return red, green, blue
