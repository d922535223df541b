"""The trainings that make up a run: for captures of few photos, teachers of its own come before the student.

Not in the paper. What a student learns from teachers is in `nexwarp.train.teachers`.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Protocol

import torch

from nexwarp.data import Scene
from nexwarp.errors import OutOfMemoryError, SettingError
from nexwarp.machine import derived_seed
from nexwarp.model.model import Model
from nexwarp.train.exposure import ExposureCalibration, calibrate_exposures
from nexwarp.train.parallel import ParallelTrainer
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.recipe import REFERENCE_ITERATIONS, Config
from nexwarp.train.report import StepReport
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

Observer = Callable[[StepReport], None]


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
class Stage:
    """One of the trainings of a run.

    Attributes:
        config: its settings; none of them asks for teachers.
        teachers: how many teachers the run trains.
        number: of the teacher, from 1; 0 for the student, whose model is the run's.
        before: iterations that earlier stages have.
    """

    config: Config
    teachers: int = 0
    number: int = 0
    before: int = 0

    @property
    def teacher(self) -> bool:
        """Whether it trains a teacher."""
        return self.number > 0

    @property
    def name(self) -> str:
        """Name for the progress display and messages."""
        if self.teacher:
            return f"teacher {self.number} of {self.teachers}"
        return "student" if self.teachers else "training"


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


def divide(config: Config, own: OwnTeachers) -> list[Stage]:
    """Return the stages of a run: its teachers, and the student, which has the rest of the iterations.

    Raises:
        SettingError: nothing is left for the student.
    """
    taken, count, surfels = own.count * own.iterations, own.count, own.max_surfels or config.max_surfels
    if config.iterations <= taken:
        raise SettingError(f"iterations: expected more than the teachers' {taken}, got {config.iterations}")
    stages = []
    for number in range(count):
        seed = derived_seed(config.seed, number, STREAM) % 2**32  # seeds of settings have 32 bits
        settings = dataclasses.replace(config, seed=seed, iterations=own.iterations, max_surfels=surfels, teachers=0)
        stages.append(Stage(settings, count, number + 1, number * own.iterations))
    student = dataclasses.replace(config, iterations=config.iterations - taken, teachers=0)
    return [*stages, Stage(student, count, before=taken)]


class StageStore(Protocol):
    """How the stages of a run are trained, and what is kept of them."""

    def complete(self, stage: Stage) -> Model | None:
        """Return the model of a teacher that an earlier session has finished; None where none has."""

    def begin(self, stage: Stage, trainer: Trainer) -> None:
        """Prepare a stage, before the first step of its trainer: restore what an earlier session has kept of it."""

    def train(self, stage: Stage, trainer: Trainer) -> None:
        """Do all steps of a stage."""

    def finish(self, stage: Stage, trainer: Trainer) -> Model:
        """Return the finished model of a trained stage."""


class StageRunner:
    """Runs the trainings of a run in their order.

    Attributes:
        stages: all of them.
        stage: the one that runs, or comes next.
        trainer: of this stage.
    """

    def __init__(
        self,
        stages: Sequence[Stage],
        make: Callable[[Config, Sequence[Model]], Trainer],
        store: StageStore,
        teachers: Sequence[Model] = (),
    ) -> None:
        """Make the trainer of the first stage that is not complete; no step is done yet.

        Args:
            stages: see `divide`.
            make: makes a trainer of settings and of models to learn from.
            store: what is kept.
            teachers: models that the student learns from where the run trains none of its own.
        """
        self.stages, self.make, self.store, self.given = stages, make, store, teachers
        self.models: list[Model] = []
        for stage in stages[:-1]:
            model = store.complete(stage)
            if model is None:
                break
            self.models.append(model)
        self._begin()

    def _begin(self) -> None:
        self.stage = self.stages[len(self.models)]
        self.trainer = self.make(self.stage.config, () if self.stage.teacher else self.models or self.given)
        self.store.begin(self.stage, self.trainer)

    def train_teachers(self) -> None:
        """Train and finish the teachers; the student's trainer is then before its first step.

        Raises:
            OutOfMemoryError: it names the teacher, and says how to train without.
        """
        while self.stage.teacher:
            with _naming(self.stage):
                self.store.train(self.stage, self.trainer)
            self.models.append(self.store.finish(self.stage, self.trainer))
            del self.trainer  # before the next one takes memory
            self._begin()

    def train(self) -> None:
        """Do all steps that are left of the run, those of teachers first."""
        self.train_teachers()
        self.store.train(self.stage, self.trainer)

    def finish(self) -> Model:
        """Return the finished model of the student."""
        return self.store.finish(self.stage, self.trainer)


@contextmanager
def _naming(stage: Stage) -> Iterator[None]:
    """Name the teacher in an OutOfMemoryError of its training, and say how to do without."""
    try:
        yield
    except OutOfMemoryError as error:
        message = f"{stage.name}: {error}, or do without teachers (--set teachers=0)"
        raise OutOfMemoryError(message, error.needed) from error


class InMemory:
    """Trains stages in one go and keeps nothing on the disk; iterations are reported counted over all stages."""

    def __init__(self, observe: Observer | None = None, warn: Callable[[str], None] = lambda _: None) -> None:
        self.observe, self.warn = observe, warn

    def complete(self, _: Stage) -> Model | None:
        """Return None: nothing was trained before."""
        return None

    def begin(self, stage: Stage, trainer: Trainer) -> None:
        """Do nothing."""

    def train(self, stage: Stage, trainer: Trainer) -> None:
        """Do all steps of a stage."""
        trainer.run(self.observe and partial(self._report, stage.before), self.warn)

    def _report(self, before: int, report: StepReport) -> None:
        assert self.observe is not None
        self.observe(dataclasses.replace(report, iteration=report.iteration + before) if before else report)

    def finish(self, stage: Stage, trainer: Trainer) -> Model:
        """Return the finished model; a teacher's is rounded as files are: `nexwarp train` reads it from one."""
        model = trainer.finish()
        if stage.teacher and model.texture is not None:
            with torch.no_grad():
                for parameter in model.texture.parameters():
                    parameter.copy_(parameter.half())
        return model


def stage_runner(
    scene: Scene,
    config: Config,
    device: torch.device | str,
    store: StageStore,
    *,
    own: OwnTeachers | None = None,
    ranks: Ranks | None = None,
    teachers: Iterable[Model] = (),
    **extensions: Any,
) -> StageRunner:
    """Return the runner of a training.

    Args:
        scene: what to learn from.
        config: settings of the run.
        device: where to train.
        store: what is kept of the stages.
        own: teachers that the run trains; None plans them, or none where `teachers` are given.
        ranks: the processes that train together; None is this one alone.
        teachers: models that the student learns from instead of the run's own.
        extensions: `losses` and `optimizer`, see `nexwarp.train`.
    """
    models: Any = teachers if isinstance(teachers, Model) else list(teachers)  # `Trainer` says what is wrong with it
    if own is None:
        own = NO_TEACHERS if models else plan_teachers(config, len(scene.train))

    @cache
    def calibration() -> ExposureCalibration | None:
        return calibrate_exposures(scene, config)

    def make(settings: Config, learned_from: Sequence[Model]) -> Trainer:
        options = extensions | {"teachers": learned_from, "calibrate": lambda *_: calibration()}
        if ranks is None or ranks.size == 1:
            return Trainer(scene, settings, device, **options)
        return ParallelTrainer(scene, settings, device, ranks, **options)

    return StageRunner(divide(config, own), make, store, models)


def student_trainer(scene: Scene, config: Config, device: torch.device | str, **options: Any) -> Trainer:
    """Train the teachers of a run, and return the trainer of its student, before its first step."""
    runner = stage_runner(scene, config, device, InMemory(), **options)
    runner.train_teachers()
    return runner.trainer
