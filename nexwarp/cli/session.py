"""How `nexwarp train` runs the stages of a training: display, log, checkpoints, and the files of finished models."""

import dataclasses
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import TYPE_CHECKING, Any

import torch
from rich.console import Console

from nexwarp.cameras.cameras_file import CAMERAS_FILE, save_cameras
from nexwarp.cli import display
from nexwarp.cli.commands import figures
from nexwarp.cli.signals import Stopped, stopped_by_signals
from nexwarp.data import Scene
from nexwarp.errors import DivergedError, OutOfMemoryError, RunError, StorageError
from nexwarp.io.json_files import Json, finite, write_json
from nexwarp.machine import needed_memory
from nexwarp.model.model import Model
from nexwarp.model.model_file import MODEL_FILE, load, save_model
from nexwarp.run.evaluate import evaluate
from nexwarp.run.folder import (
    COMPARE,
    METRICS_FILE,
    PHOTOS_FILE,
    RENDERS_FOLDER,
    TEST,
    TRAIN,
    RunRecord,
    create_run,
    is_run,
    picture_name,
    read_metrics,
    read_run,
    remove_leftovers,
    teacher_folder,
)
from nexwarp.run.log import TrainingLog
from nexwarp.run.photo_table import save_photo_table
from nexwarp.train.checkpoint import delete_checkpoints, has_checkpoint
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.report import StepReport
from nexwarp.train.stages import VIEW_COST, Stage, StageStore, divide
from nexwarp.train.trainer import Trainer

if TYPE_CHECKING:
    from nexwarp.viewer import Viewer

CHECKPOINTS_A_RUN = 10
SECONDS_APART = 30.0  # at least, if nobody asks for more: a checkpoint takes about 1 s on a GPU machine


@dataclass
class Session(StageStore):
    """Trains stages in a run folder: each stage is trained in a folder of its own.

    A teacher's folder is a run, too: RUN/teachers/1 and so on. The teacher is complete once its metrics.json, which is
    written last, says how long the training took.
    """

    run: Path
    record: RunRecord
    console: Console
    ranks: Ranks
    resume: bool = False
    tensorboard: bool = False  # of the student
    every: int | None = None  # iterations between checkpoints; None saves at tenths of a stage that are apart enough
    viewer: "Viewer | None" = None
    seconds: float = 0.0  # that complete teachers took
    begun: bool = False

    def complete(self, stage: Stage) -> Model | None:
        """Return the model of a teacher that is complete; None where it is not."""
        if not self.resume:
            return None
        seconds = self.ranks.share(self._seconds_of(stage) if self.ranks.first else None)
        if not isinstance(seconds, (int, float)):
            return None
        self.seconds += seconds
        return shared_model(self._folder(stage) / MODEL_FILE if self.ranks.first else None, self.ranks)

    def begin(self, stage: Stage, trainer: Trainer) -> None:
        """Say what comes, and restore the newest checkpoint of a stage to resume."""
        if stage.teachers:
            config = stage.config
            limits = f"{config.iterations:,} iterations, at most {config.max_surfels:,} surfels"
            self.console.print(f"{stage.name}: {limits}, seed {config.seed}")
        folder, saved = self._folder(stage), False
        if self.ranks.first and self.resume:
            if folder.is_dir():  # a teacher that has not begun has no folder yet
                remove_leftovers(folder)
            saved = has_checkpoint(folder)
        if self.ranks.share(saved):
            # The run's config is the one to trust: a run that is extended writes it before its next checkpoint.
            trainer.restore(folder, partial(display.warn, self.console), extend=True)
            self.console.print(f"resumed at iteration {trainer.iteration:,}")
        elif self.resume and not self.begun:
            self.console.print(f"{self.run}: no checkpoint yet, training starts from the beginning")
        self.begun = True

    def train(self, stage: Stage, trainer: Trainer) -> None:
        """Run the training loop; write checkpoints at regular iterations, at the end and after a signal to stop.

        Of several ranks, all stop after the step in which the signal of one has reached them. Rank 0 writes.
        """
        folder = self._folder(stage)
        if stage.teacher and self.ranks.first and not (self.resume and is_run(folder)):
            create_run(folder, RunRecord(self.record.source, stage.config, self.ranks.device.type))
        total = stage.config.iterations
        every, saved = self.every or max(total // CHECKPOINTS_A_RUN, 1), monotonic()
        after = self.work_after(stage, trainer.scene)
        bar = display.training(self.console, total, trainer.iteration, trainer.device, stage.name, after)
        log = TrainingLog(folder, trainer, tensorboard=self.tensorboard and not stage.teacher)
        with ExitStack() as stack:
            if self.ranks.first:
                show = stack.enter_context(bar)
                stack.enter_context(log)
            stop_signal = stack.enter_context(stopped_by_signals(deferred=True))

            def rested() -> bool:  # by the clock of rank 0
                return self.every is not None or bool(self.ranks.share(monotonic() - saved >= SECONDS_APART))

            def observe(step: StepReport) -> None:
                nonlocal saved
                if self.ranks.first:
                    show(step)
                    with _model_kept(folder, trainer):
                        log(step)
                if self.viewer is not None:
                    done = stage.before + step.iteration
                    self.viewer.between_steps(done, partial(_describe, step), lambda: stop_signal() is not None)
                number = self.ranks.agree(stop_signal(), now=step.iteration == total)
                if step.iteration == total or number is not None or (step.passed(every) and rested()):
                    with _model_kept(folder, trainer):
                        trainer.save_checkpoint(folder)
                    saved = monotonic()
                if self.ranks.size == 1:
                    number = stop_signal()  # also one that came during the save
                if number is not None:
                    self.ranks.barrier()
                    raise Stopped(number)

            try:
                trainer.run(observe)
            except DivergedError as error:
                kept = "the last checkpoint stays" if has_checkpoint(folder) else "there is no checkpoint"
                raise DivergedError(f"{error}; {kept}") from None

    def work_after(self, stage: Stage, scene: Scene) -> float:
        """Return what follows the steps of a stage, in training steps: its finish, later stages, and the evaluation."""
        photos, tests = len(scene.train), len(scene.test)
        coming = [later for later in divide(self.record.config, self.record.own) if later.before >= stage.before]
        evaluation = VIEW_COST * (photos + tests)
        return sum(each.work(photos) for each in coming) - stage.config.iterations + evaluation

    def finish(self, stage: Stage, trainer: Trainer) -> Model:
        """Finish, write and return the model of a trained stage; that of the run is also evaluated, by all ranks."""
        complete = f"{stage.name} is complete and saved: --resume finishes the run"
        file: Path | None = None
        facts: dict[str, Json] = {}
        try:
            if self.ranks.first:
                file, facts = self._save(stage, trainer)
            elif trainer.graphs is not None:
                trainer.graphs.clear()  # NCCL waits, when it ends, for graphs that hold its all-reduce
            model = shared_model(file, self.ranks)
            if not stage.teacher:
                self._evaluate(trainer, model, facts)
            elif self.ranks.first:
                write_json(self._folder(stage) / METRICS_FILE, facts)
        except OSError as error:
            raise StorageError(f"{error}; {complete}") from error
        except (MemoryError, RuntimeError) as error:
            if (needed := needed_memory(error)) is None:
                raise
            raise OutOfMemoryError(f"out of memory: needed {needed}; {complete}") from error
        if stage.teacher:
            self.seconds += trainer.seconds
            if self.ranks.first:
                delete_checkpoints(self._folder(stage))  # nothing continues from them
        return model

    def _folder(self, stage: Stage) -> Path:
        return teacher_folder(self.run, stage.number) if stage.teacher else self.run

    def _seconds_of(self, stage: Stage) -> float | None:
        """Return how long the training of a complete teacher took; None where the teacher is not complete."""
        folder = self._folder(stage)
        begun = is_run(folder)
        settings = stage.config
        if begun and dataclasses.replace(read_run(folder).config, cuda_graphs=settings.cuda_graphs) != settings:
            raise RunError(f"{folder}: expected a teacher with the settings of {self.run}, got others")
        seconds = read_metrics(folder).get("seconds") if begun else None
        if isinstance(seconds, (int, float)):
            delete_checkpoints(folder)  # a kill can have come before
            return float(seconds)
        if has_checkpoint(self.run):
            raise RunError(f"{folder}: expected the complete teacher that the student in {self.run} has learned from")
        return None

    def _save(self, stage: Stage, trainer: Trainer) -> tuple[Path, dict[str, Json]]:
        """Finish and write the model of a stage, and its cameras; return its file, and entries for metrics.json.

        The time of a student has that of its teachers.
        """
        folder = self._folder(stage)
        with display.stages(self.console) as observe:
            model = trainer.finish(observe)
        file = save_model(folder, model)
        given = trainer.scene.cameras
        refined = {view.name: view.camera for view in trainer.views.refined(trainer.poses)}
        save_cameras(folder / CAMERAS_FILE, given | {TRAIN: refined}, given)
        iterations = trainer.iteration + (0 if stage.teacher else stage.before)
        seconds = trainer.seconds + (0 if stage.teacher else self.seconds)
        facts: dict[str, Json] = {
            "preset": stage.config.preset,
            "iterations": iterations,
            "seconds": seconds,
            "iterations_per_second": iterations / max(seconds, 1e-9),
            "device": torch.cuda.get_device_name(trainer.device) if trainer.device.type == "cuda" else "cpu",
        }
        if trainer.targets.teachers:
            facts["teachers"] = len(trainer.targets.teachers)
        return file, facts | {"surfels": len(model.surfels), "megabytes": file.stat().st_size / 1e6}

    def _evaluate(self, trainer: Trainer, model: Model, facts: dict[str, Json]) -> None:
        """Evaluate the run's model on the photos, and on the test views if there are any; rank 0 writes the figures."""
        views, photos, rows = trainer.scene.test, trainer.views.refined(trainer.poses), dict[str, str]()
        options: dict[str, Any] = {"mask_mode": trainer.config.mask_mode, "ranks": self.ranks}
        with display.stages(self.console) as observe:
            judging, evaluating = partial(observe, "judging photos"), partial(observe, "evaluating")
            judged = evaluate(model, photos, metrics=("psnr",), progress=judging, **options)["views"]
            if views:
                renders = self.run / RENDERS_FOLDER
                results = evaluate(model, views, renders=renders, progress=evaluating, **options)
                rows, judged = figures(results), judged | results["views"]
                if self.ranks.first:
                    write_json(self.run / METRICS_FILE, finite(facts | results))
        if not self.ranks.first:
            return
        save_photo_table(self.run / PHOTOS_FILE, {TRAIN: trainer.scene.train, TEST: views}, judged)
        rows |= {
            "surfels": f"{len(model.surfels):,}",
            "model file": f"{facts['megabytes']:.1f} MB",
            "training": f"{facts['seconds']:.0f} s, {facts['iterations_per_second']:.1f} it/s",
            "run": str(self.run),
        }
        self.console.print(display.results_table(rows, f"{len(views)} test views"))
        if views:
            strip = self.run / RENDERS_FOLDER / COMPARE / picture_name(views[0].name)
            self.console.print(f"photo, render, error: {strip}")


@contextmanager
def _model_kept(folder: Path, trainer: Trainer) -> Iterator[None]:
    """If the block fails on a full disk, save the model at least, which is smaller than a checkpoint."""
    try:
        yield
    except OSError as error:
        model, checkpoint = "the current model is saved", "there is no checkpoint"
        try:
            save_model(folder, trainer.model())
        except OSError:
            model = "the model cannot be saved either"
        if has_checkpoint(folder):
            checkpoint = "--resume continues from the last checkpoint"
        stop = f"training stops at iteration {trainer.iteration:,}: {model}, {checkpoint}"
        raise StorageError(f"{error}; {stop}") from error


def shared_model(file: Path | None, ranks: Ranks) -> Model:
    """Return rank 0's model, read from its file, on the device of each rank; other ranks give None."""
    if file is not None:
        model = load(file)
        if ranks.size > 1:
            ranks.share_bytes(file.read_bytes())
        return model.to(ranks.device)
    with TemporaryDirectory() as folder:
        (Path(folder) / MODEL_FILE).write_bytes(ranks.share_bytes(None))
        return load(folder).to(ranks.device)


def _describe(step: StepReport) -> str:
    return f"loss {step.loss():.4f}, {step.psnr():.2f} dB on this view, {step.surfels:,} surfels"
