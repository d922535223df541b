"""The trainings that make up a run: for captures of few photos, teachers of its own come before the student.

Not in the paper. What a student learns from teachers is in `nexwarp.train.teachers`.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import torch

from nexwarp.data import Scene
from nexwarp.errors import OutOfMemoryError, SettingError
from nexwarp.machine import derived_seed
from nexwarp.model.model import Model
from nexwarp.train.config import REFERENCE_ITERATIONS, Config
from nexwarp.train.exposure_calibration import CalibrateOnce
from nexwarp.train.report import StepReport
from nexwarp.train.schedules import OptimizerMaker
from nexwarp.train.step_losses import OwnLoss
from nexwarp.train.trainer import Trainer

# Where a run decides, it has teachers if photos are few and surfels many for them. With 18 to 37 photos and 417 surfels
# a photo or more no scene lost PSNR of validation views on the mean of its pairs; with 46, 77, 115 and 230 photos one
# scene lost 0.04 to 0.5 dB, and 0.011 of SSIM or more. Fewer than 30,000 steps were not tried at full size.
TEACHERS = 2
MOST_PHOTOS = 44
SURFELS_A_PHOTO = 300
SHARE = 0.4  # of the iterations that the teachers have together
# Teachers of a small student have more surfels than it: one of 10,000 gained more PSNR and SSIM from teachers of 40,000
# than from those of 10,000, on all four folds that were tried.
TEACHER_SURFELS = 40_000
TEACHER_TIMES = 4  # at most so many times the student's
STREAM = 3  # series of seeds, as `derived_seed` counts them


@dataclass(frozen=True)
class OwnTeachers:
    """The teachers that a run trains before its student.

    Attributes:
        count: how many.
        iterations: of each.
        max_surfels: of each; None is the student's.
    """

    count: int
    iterations: int
    max_surfels: int | None = None


NO_TEACHERS = OwnTeachers(0, 0)


@dataclass(frozen=True)
class Stages:
    """Settings of the trainings of a run, in their order; none of them has teachers of its own.

    Attributes:
        teachers: settings of the teachers.
        student: settings of the training whose model is the run's.
    """

    teachers: tuple[Config, ...]
    student: Config


def teacher_count(config: Config, photos: int) -> int:
    """Return how many teachers a run trains first: `config.teachers`, or what its None stands for.

    Args:
        config: of the run.
        photos: number of training photos.
    """
    if config.teachers is not None:
        return config.teachers
    few = photos <= MOST_PHOTOS and config.max_surfels >= SURFELS_A_PHOTO * photos
    return TEACHERS if few and config.iterations >= REFERENCE_ITERATIONS and not config.refine_poses else 0


def plan_teachers(config: Config, photos: int) -> OwnTeachers:
    """Return the teachers that a run trains first, which have two fifths of its iterations together.

    Args:
        config: of the run.
        photos: number of training photos.
    """
    count, most = teacher_count(config, photos), config.max_surfels
    surfels = max(most, min(TEACHER_TIMES * most, TEACHER_SURFELS))
    return OwnTeachers(count, max(int(SHARE * config.iterations / count), 1), surfels) if count else NO_TEACHERS


def divide(config: Config, own: OwnTeachers) -> Stages:
    """Return the stages of a run: teachers, and the student, which has the rest of the iterations.

    Raises:
        SettingError: nothing is left for the student.
    """
    taken = own.count * own.iterations
    if config.iterations <= taken:
        raise SettingError(f"iterations: expected more than the teachers' {taken}, got {config.iterations}")
    # Seeds of settings have 32 bits.
    seeds = [derived_seed(config.seed, number, STREAM) % 2**32 for number in range(own.count)]
    surfels = own.max_surfels or config.max_surfels
    teachers = (
        dataclasses.replace(config, seed=seed, iterations=own.iterations, max_surfels=surfels, teachers=0)
        for seed in seeds
    )
    return Stages(tuple(teachers), dataclasses.replace(config, iterations=config.iterations - taken, teachers=0))


@contextmanager
def training_teacher(number: int, count: int) -> Iterator[None]:
    """Name the teacher in an OutOfMemoryError of its training, and say how to train without teachers.

    Args:
        number: of the teacher, counted from 1.
        count: of teachers.
    """
    try:
        yield
    except OutOfMemoryError as error:
        told = f"teacher {number} of {count}: {error}, or do without teachers (--set teachers=0)"
        raise OutOfMemoryError(told, error.needed) from error


def student_trainer(
    scene: Scene,
    config: Config,
    device: torch.device | str,
    *,
    losses: Mapping[str, OwnLoss] | None = None,
    optimizer: OptimizerMaker | None = None,
    teachers: Iterable[Model] = (),
    observe: Callable[[StepReport], None] | None = None,
    warn: Callable[[str], None] = lambda _: None,
) -> Trainer:
    """Train the teachers of a run, and return the trainer of its student, before its first step.

    Args:
        scene: what to learn from.
        config: of the run.
        device: where to train.
        losses: see `nexwarp.train`.
        optimizer: see `nexwarp.train`.
        teachers: models that take the place of teachers of its own.
        observe: called after each step of a teacher; iterations are counted over all of them.
        warn: see `Trainer.run`.

    Raises:
        SceneError, TypeError, ValueError, DivergedError, OutOfMemoryError: as of `nexwarp.train`.
    """
    found = teachers if isinstance(teachers, Model) else list(teachers)  # `Trainer` tells what is wrong with a model
    stages = divide(config, NO_TEACHERS if found else plan_teachers(config, len(scene.train)))
    make = partial(Trainer, scene, device=device, losses=losses, optimizer=optimizer, calibrate=CalibrateOnce())
    own: list[Model] = []
    for number, settings in enumerate(stages.teachers):
        trainer = make(config=settings)
        with training_teacher(number + 1, len(stages.teachers)):
            trainer.run(counted_from(number * settings.iterations, observe), warn)
        own.append(_as_saved(trainer.finish()))
        del trainer  # before the next one takes memory
    return make(config=stages.student, teachers=own or found)


@torch.no_grad()
def _as_saved(model: Model) -> Model:
    """Round what a file keeps in half precision: `nexwarp train` reads a resumed run's teachers from files."""
    for parameter in () if model.texture is None else model.texture.parameters():
        parameter.copy_(parameter.half())
    return model


def counted_from(done: int, observe: Callable[[StepReport], None] | None) -> Callable[[StepReport], None] | None:
    """Return an observer that adds the iterations of earlier stages to those of each step."""
    if observe is None or done == 0:
        return observe

    def observe_later(report: StepReport) -> None:
        observe(dataclasses.replace(report, iteration=report.iteration + done))

    return observe_later
