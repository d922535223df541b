"""All trainings of a run folder: its own teachers, one after the other, then the student (`nexwarp.train.stages`)."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from nexwarp.cli.training_session import Stage, TrainingSession, shared_model
from nexwarp.data import Scene
from nexwarp.distributed.ranks import Ranks
from nexwarp.model.model import Model
from nexwarp.model.model_file import MODEL_FILE
from nexwarp.run.contents import teacher_folder
from nexwarp.run.folder import SceneSource, create_run, is_run, read_metrics, read_run, rewrite_config
from nexwarp.train.checkpoint import delete_checkpoints
from nexwarp.train.config import Config
from nexwarp.train.parallel import ParallelTrainer
from nexwarp.train.stages import Stages
from nexwarp.train.trainer import Trainer

if TYPE_CHECKING:
    from nexwarp.viewer import Viewer


class StagedSession:
    """The trainings of a run, each a `TrainingSession` in a folder of its own.

    A teacher's folder is a run, too: RUN/teachers/1 and so on. It has a metrics.json once it is complete.
    """

    def __init__(
        self,
        scene: Scene,
        stages: Stages,
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
            stages: of the run.
            run: run folder.
            source: the scene.
            console: where to print.
            ranks: the processes that train together.
            teachers: of a student without teachers of the run's own.
            resume: pass over the teachers that are complete.
            sinks: see `TrainingSession`; those of the student.
            every: see `TrainingSession`; of all stages.
        """
        self.scene, self.stages, self.run, self.source = scene, stages, run, source
        self.console, self.ranks, self.resume, self.sinks, self.every = console, ranks, resume, sinks, every
        self.given, self.models = teachers, list[Model]()
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
        if self.resume:
            self.session.resume()
        else:
            self.session.check_room()

    def train(self, viewer: "Viewer | None" = None) -> None:
        """Train all stages but for the end of the student; see `TrainingSession.train`."""
        while True:
            if self.session.stage.teacher:
                self._tell_teacher()
            self.session.train(viewer)
            if not self.session.stage.teacher:
                return
            self.models.append(self.session.finish())
            self.seconds += self.trainer.seconds
            if self.ranks.first:
                delete_checkpoints(self.session.run)  # nothing continues from them
            self.session = self._next_session()
            if self.resume:
                self.session.resume()

    def finish(self) -> Model:
        """Finish, write, evaluate and return the run's model; see `TrainingSession.finish`."""
        return self.session.finish()

    def _next_session(self) -> TrainingSession:
        number, count = len(self.models), len(self.stages.teachers)
        before = sum(config.iterations for config in self.stages.teachers[:number])
        if number < count:
            trainer = self._make_trainer(self.stages.teachers[number], ())
            stage = Stage(f"teacher {number + 1} of {count}", teacher=True, iterations=before, seconds=self.seconds)
            return TrainingSession(
                trainer, teacher_folder(self.run, number + 1), self.console, every=self.every, stage=stage
            )
        trainer = self._make_trainer(self.stages.student, self.models or self.given)
        stage = Stage(iterations=before, seconds=self.seconds)
        return TrainingSession(trainer, self.run, self.console, sinks=self.sinks, every=self.every, stage=stage)

    def _make_trainer(self, config: Config, teachers: Sequence[Model]) -> Trainer:
        if self.ranks.size == 1:
            return Trainer(self.scene, config, self.ranks.device, teachers=teachers)
        return ParallelTrainer(self.scene, config, self.ranks.device, self.ranks, teachers=teachers)

    def _tell_teacher(self) -> None:
        """Say which teacher is trained, and make its folder a run."""
        session, config = self.session, self.trainer.config
        self.console.print(f"{session.stage.name}: {config.iterations:,} iterations, seed {config.seed}")
        if self.ranks.first and not is_run(session.run):
            create_run(session.run, self.source, config, self.ranks.device.type)

    def _take_complete(self) -> bool:
        """Take the next teacher if it is complete; return whether it is."""
        number = len(self.models)
        if number == len(self.stages.teachers):
            return False
        folder = teacher_folder(self.run, number + 1)
        metrics = read_metrics(folder) if self.ranks.first else {}
        seconds = self.ranks.share(metrics.get("seconds"))
        if not isinstance(seconds, (int, float)):
            return False
        self.models.append(shared_model(folder / MODEL_FILE if self.ranks.first else None, self.ranks))
        self.seconds += seconds
        return True


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
