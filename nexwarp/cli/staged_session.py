"""All trainings of a run folder: its own teachers, one after the other, then the student (`nexwarp.train.stages`)."""

import dataclasses
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from nexwarp.cli.training_session import Stage, TrainingSession, shared_model
from nexwarp.data import Scene
from nexwarp.errors import RunError
from nexwarp.model.model import Model
from nexwarp.model.model_file import MODEL_FILE
from nexwarp.run.contents import teacher_folder
from nexwarp.run.folder import SceneSource, create_run, is_run, read_metrics, read_run, rewrite_config
from nexwarp.train.checkpoint import delete_checkpoints, has_checkpoint
from nexwarp.train.exposure import CalibrateOnce
from nexwarp.train.parallel import ParallelTrainer
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.recipe import Config
from nexwarp.train.stages import OwnTeachers, divide, training_teacher
from nexwarp.train.trainer import Trainer

if TYPE_CHECKING:
    from nexwarp.viewer import Viewer


class StagedSession:
    """The trainings of a run, each a `TrainingSession` in a folder of its own.

    A teacher's folder is a run, too: RUN/teachers/1 and so on. The teacher is complete once its metrics.json, which is
    written last, says how long the training took.
    """

    def __init__(
        self,
        scene: Scene,
        config: Config,
        own: OwnTeachers,
        run: Path,
        source: SceneSource,
        console: Console,
        ranks: Ranks,
        *,
        teachers: Sequence[Model] = (),
        resume: bool = False,
        sinks: Collection[str] = (),
        every: int | None = None,
    ) -> None:
        """Make the first trainer; nothing runs yet.

        Args:
            scene: what to learn from.
            config: settings of the run.
            own: teachers that the run trains first.
            run: run folder.
            source: the scene.
            console: where to print.
            ranks: the processes that train together.
            teachers: models that the student learns from where the run trains no teachers.
            resume: go on with the stage that was interrupted.
            sinks: of the student's log; see `TrainingSession`.
            every: of all stages; see `TrainingSession`.

        Raises:
            RunError: the student has begun, and a teacher is missing or has other settings.
        """
        self.scene, self.config, self.stages, self.run, self.source = scene, config, divide(config, own), run, source
        self.console, self.ranks, self.resume, self.sinks, self.every = console, ranks, resume, sinks, every
        self.given, self.models, self.calibrate = teachers, list[Model](), CalibrateOnce()
        self.seconds = 0.0
        while resume and self._take_complete():
            pass
        self.session = self._next_session()

    @property
    def trainer(self) -> Trainer:
        """The trainer of the stage that runs."""
        return self.session.trainer

    def begin(self) -> None:
        """Restore the checkpoint of the stage to resume, or check that the disk has room."""
        self._announce()
        if self.resume:
            self.session.resume()
        else:
            self.session.check_room()

    def train(self, viewer: "Viewer | None" = None) -> None:
        """Train and finish the teachers, and train the student; see `TrainingSession.train`."""
        while self.session.stage.teacher:
            if self.ranks.first and not (self.resume and is_run(self.session.run)):
                create_run(self.session.run, self.source, self.trainer.config, self.ranks.device.type)
            with training_teacher(len(self.models) + 1, len(self.stages.teachers)):
                self.session.train(viewer)
            self.models.append(self.session.finish())
            self.seconds += self.trainer.seconds
            if self.ranks.first:
                delete_checkpoints(self.session.run)  # nothing continues from them
            del self.session  # before the next trainer takes memory
            self.session = self._next_session()
            self._announce()
            if self.resume:
                self.session.resume(begun=False)
        self.session.train(viewer)

    def finish(self) -> Model:
        """Finish, write, evaluate and return the run's model; see `TrainingSession.finish`."""
        return self.session.finish()

    def _next_session(self) -> TrainingSession:
        number, count = len(self.models), len(self.stages.teachers)
        before = sum(config.iterations for config in self.stages.teachers[:number])
        if number < count:
            trainer = self._make_trainer(self.stages.teachers[number], ())
            stage = Stage(f"teacher {number + 1} of {count}", teacher=True, iterations=before)
            folder = teacher_folder(self.run, number + 1)
            return TrainingSession(trainer, folder, self.console, every=self.every, stage=stage)
        trainer = self._make_trainer(self.stages.student, self.models or self.given)
        name = "student" if count else "training"
        stage = Stage(name, iterations=before, seconds=self.seconds, settings=self.config)
        return TrainingSession(trainer, self.run, self.console, sinks=self.sinks, every=self.every, stage=stage)

    def _make_trainer(self, config: Config, teachers: Sequence[Model]) -> Trainer:
        device, calibrate = self.ranks.device, self.calibrate
        if self.ranks.size == 1:
            return Trainer(self.scene, config, device, teachers=teachers, calibrate=calibrate)
        return ParallelTrainer(self.scene, config, device, self.ranks, teachers=teachers, calibrate=calibrate)

    def _announce(self) -> None:
        """Say which of several trainings comes."""
        if self.stages.teachers:
            config = self.trainer.config
            told = f"{config.iterations:,} iterations, at most {config.max_surfels:,} surfels, seed {config.seed}"
            self.console.print(f"{self.session.stage.name}: {told}")

    def _take_complete(self) -> bool:
        """Take the next teacher if it is complete; return whether it is."""
        number = len(self.models)
        if number == len(self.stages.teachers):
            return False
        seconds = self.ranks.share(self._seconds_of(number) if self.ranks.first else None)
        if not isinstance(seconds, (int, float)):
            return False
        file = teacher_folder(self.run, number + 1) / MODEL_FILE
        self.models.append(shared_model(file if self.ranks.first else None, self.ranks))
        self.seconds += seconds
        return True

    def _seconds_of(self, number: int) -> float | None:
        """Return how long the training of a complete teacher took; None where the teacher is not complete."""
        folder, expected = teacher_folder(self.run, number + 1), self.stages.teachers[number]
        begun = is_run(folder)
        if begun and dataclasses.replace(read_run(folder)[1], cuda_graphs=expected.cuda_graphs) != expected:
            raise RunError(f"{folder}: expected a teacher with the settings of {self.run}, got others")
        seconds = read_metrics(folder).get("seconds") if begun else None
        if not isinstance(seconds, (int, float)):
            if has_checkpoint(self.run):
                raise RunError(
                    f"{folder}: expected the complete teacher that the student in {self.run} has learned from"
                )
            return None
        delete_checkpoints(folder)  # a kill can have come before
        return float(seconds)


def extend_run(run: Path, config: Config, console: Console) -> None:
    """Write a larger --iterations into the run to resume, and say what it does."""
    before = read_run(run)[1].iterations
    if config.iterations > before:
        rewrite_config(run, config)
        console.print(
            f"extended from {before:,} to {config.iterations:,} iterations: from here on, learning rates, "
            "density control and all other schedules are those of a run of that length",
            soft_wrap=True,
        )
