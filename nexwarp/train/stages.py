"""The trainings that make up a run: for captures of few photos, teachers of its own come before the student.

Not in the paper. What a student learns from teachers is in `nexwarp.train.target`.
"""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import torch

from nexwarp.data import Scene
from nexwarp.errors import OutOfMemoryError, SettingError
from nexwarp.machine import derived_seed
from nexwarp.model.model import Model
from nexwarp.ops import fused_texture
from nexwarp.ops.ahead import load_training_kernels
from nexwarp.train.exposure import calibrate_exposures
from nexwarp.train.initial import Start
from nexwarp.train.parallel import ParallelTrainer
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.recipe import FEW_PHOTOS, REFERENCE_ITERATIONS, Config
from nexwarp.train.report import StepReport
from nexwarp.train.trainer import Trainer

# Where a run decides, it has teachers if photos are few and surfels many for them. With 18 to 37 photos and 417 surfels
# a photo or more no scene lost PSNR of validation views on the mean of its pairs; with 46, 77, 115 and 230 photos one
# scene lost 0.04 to 0.5 dB, and 0.011 of SSIM or more. Fewer than 30,000 steps were not tried at full size.
TEACHERS = 2
SURFELS_A_PHOTO = 300
SHORTEST = 7000  # iterations of a run that is shortened to its photos
SHARE = 0.4  # of the iterations that the teachers have together
# Teachers of a small student have more surfels than it: one of 10,000 gained more PSNR and SSIM from teachers of 40,000
# than from those of 10,000, on all four folds that were tried.
TEACHER_SURFELS = 40_000
TEACHER_TIMES = 4  # at most so many times the student's
# A view that is rendered to finish a model costs this much of a training step: on two CPU cores a quarter.
VIEW_COST = 0.25
STREAM = 3  # series of seeds, as `derived_seed` counts them

Observer = Callable[[StepReport], None]


@dataclass(frozen=True)
class OwnTeachers:
    """The teachers that a run trains before its student: how many, and the settings of each."""

    count: int
    iterations: int
    max_surfels: int | None = None  # None is the student's


NO_TEACHERS = OwnTeachers(0, 0)


@dataclass(frozen=True)
class Stage:
    """One of the trainings of a run."""

    config: Config  # its settings; none of them asks for teachers
    teachers: int = 0  # how many the run trains
    number: int = 0  # of the teacher, from 1; 0 for the student, whose model is the run's
    before: int = 0  # iterations that earlier stages have

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

    def work(self, photos: int) -> float:
        """Return what the training and the finishing of its model cost, in training steps."""
        passes = (self.config.smooth_sh > 0) + self.config.footprints
        return self.config.iterations + VIEW_COST * passes * photos


def load_kernels(config: Config, device: torch.device | str) -> None:
    """Begin to load the kernels of a training, which takes seconds where they are not in Warp's cache."""
    texture = config.texture
    load_training_kernels(
        torch.device(device),
        max_hits=config.hits_at(1),
        features=texture.features,
        fused=fused_texture.fits_sizes(texture.levels, texture.features, texture.width, texture.hidden_layers),
        deterministic=config.deterministic,
    )


def shortened(config: Config, photos: int) -> Config:
    """Return settings with the iterations that so many training photos need; see `Recipe.steps_a_photo`."""
    if config.steps_a_photo is None:
        return config
    most = max(config.steps_a_photo * photos, SHORTEST)
    return dataclasses.replace(config, iterations=min(config.iterations, most))


def plan_teachers(config: Config, photos: int) -> OwnTeachers:
    """Return the teachers that a run trains first, which have two fifths of its iterations together."""
    most = config.max_surfels
    count = config.teachers
    if count is None:
        few = photos <= FEW_PHOTOS and most >= SURFELS_A_PHOTO * photos
        count = TEACHERS if few and config.iterations >= REFERENCE_ITERATIONS and not config.refine_poses else 0
    if not count:
        return NO_TEACHERS
    surfels = max(most, min(TEACHER_TIMES * most, TEACHER_SURFELS))
    return OwnTeachers(count, max(int(SHARE * config.iterations / count), 1), surfels)


def divide(config: Config, own: OwnTeachers) -> list[Stage]:
    """Return the stages of a run; SettingError where the teachers leave no iterations for the student."""
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


class StageStore:
    """How the stages of a run are trained and what is kept of them: here in one go, and nothing on the disk.

    Iterations are reported counted over all stages.
    """

    def __init__(self, observe: Observer = lambda _: None) -> None:
        self.observe = observe

    def complete(self, stage: Stage) -> Model | None:
        """Return the model of a teacher that an earlier session has finished; None where there is none."""
        return None

    def begin(self, stage: Stage, trainer: Trainer) -> None:
        """Restore what an earlier session has kept of a stage, before its first step."""

    def train(self, stage: Stage, trainer: Trainer) -> None:
        """Do all steps of a stage."""
        trainer.run(partial(self._report, stage.before))

    def _report(self, before: int, report: StepReport) -> None:
        self.observe(dataclasses.replace(report, iteration=report.iteration + before) if before else report)

    def finish(self, stage: Stage, trainer: Trainer) -> Model:
        """Return the finished model; a teacher's is rounded as files are: `nexwarp train` reads it from one."""
        model = trainer.finish()
        if stage.teacher and model.texture is not None:
            with torch.no_grad():
                for parameter in model.texture.parameters():
                    parameter.copy_(parameter.half())
        return model


class StageRunner:
    """Runs the trainings of a run in their order: `stage`, with `trainer`, is the one that runs, or comes next."""

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device | str,
        store: StageStore,
        *,
        own: OwnTeachers | None = None,
        ranks: Ranks | None = None,
        teachers: Iterable[Model] = (),
        **extensions: Any,
    ) -> None:
        """Make the trainer of the first stage that is not complete; no step is done yet.

        `own` are the teachers that the run trains: None shortens the run where its settings say so and plans them, or
        none where `teachers`, models, are given instead. `extensions` are the `losses` of `nexwarp.train`, and what
        the student starts from.
        """
        self.scene, self.device, self.store, self.ranks, self.extensions = scene, device, store, ranks, extensions
        # `Trainer` says what is wrong with it.
        self.teachers: Any = teachers if isinstance(teachers, Model) else list(teachers)
        if own is None:
            config = shortened(config, len(scene.train))
            own = NO_TEACHERS if self.teachers else plan_teachers(config, len(scene.train))
        self.calibration = cache(lambda: calibrate_exposures(scene, config))
        self.stages = divide(config, own)
        self.models: list[Model] = []
        for stage in self.stages[:-1]:
            model = store.complete(stage)
            if model is None:
                break
            self.models.append(model)
        self._begin()

    def _begin(self) -> None:
        self.stage = self.stages[len(self.models)]
        options = self.extensions | {"teachers": self.models or self.teachers}
        if self.stage.teacher:
            options = {name: x for name, x in options.items() if name not in (*Start.__annotations__, "teachers")}
        options["calibrate"] = lambda *_: self.calibration()
        if self.ranks is None or self.ranks.size == 1:
            self.trainer = Trainer(self.scene, self.stage.config, self.device, **options)
        else:
            self.trainer = ParallelTrainer(self.scene, self.stage.config, self.device, self.ranks, **options)
        self.store.begin(self.stage, self.trainer)

    def train(self) -> None:
        """Do all steps that are left of the run; teachers, which come first, are finished."""
        while self.stage.teacher:
            try:
                self.store.train(self.stage, self.trainer)
            except OutOfMemoryError as error:
                message = f"{self.stage.name}: {error}, or do without teachers (--set teachers=0)"
                raise OutOfMemoryError(message, error.needed) from error
            self.models.append(self.store.finish(self.stage, self.trainer))
            del self.trainer  # before the next one takes memory
            self._begin()
        self.store.train(self.stage, self.trainer)

    def finish(self) -> Model:
        """Return the finished model of the student."""
        return self.store.finish(self.stage, self.trainer)
