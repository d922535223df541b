"""A training session: the training loop with display, log and checkpoints, and the files of a finished run."""

from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import torch
from rich.console import Console

from nexwarp.cameras.cameras_file import CAMERAS_FILE, save_cameras
from nexwarp.cli import display
from nexwarp.cli.eval import evaluate_run, figures
from nexwarp.cli.signals import Stopped, deferred_stop
from nexwarp.errors import DivergedError, OutOfMemoryError, StorageError
from nexwarp.io.json_files import Json, write_json
from nexwarp.machine import needed_memory
from nexwarp.model.model import Model
from nexwarp.model.model_file import MODEL_FILE, load, save_model
from nexwarp.run.contents import (
    COMPARE,
    DIVERGED_FILE,
    METRICS_FILE,
    RENDERS_FOLDER,
    TRAIN,
    picture_name,
    remove_leftovers,
)
from nexwarp.run.evaluate import evaluate
from nexwarp.run.folder import check_room
from nexwarp.run.log import TrainingLog
from nexwarp.run.log_sinks import PACKAGES
from nexwarp.train.checkpoint import CHECKPOINTS, has_checkpoint
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.recipe import Config
from nexwarp.train.report import StepReport
from nexwarp.train.trainer import Trainer

if TYPE_CHECKING:
    from nexwarp.viewer import Viewer

CHECKPOINTS_A_RUN = 10
# Large files on the disk at once: two checkpoints, a third while it is written, and the model.
FILES_AT_A_TIME = 4


@dataclass(frozen=True)
class Stage:
    """Place of a training among those of a run.

    Attributes:
        name: what the progress display and messages call the training.
        teacher: whether it trains a teacher of the run, whose model is not evaluated.
        iterations: number of iterations that earlier stages had.
        seconds: time that earlier stages took.
        settings: of the run; None where they are the training's.
    """

    name: str = "training"
    teacher: bool = False
    iterations: int = 0
    seconds: float = 0.0
    settings: Config | None = None


ALONE = Stage()


class TrainingSession:
    """One training in a run folder, from its first or resumed iteration to the evaluated model."""

    def __init__(
        self,
        trainer: Trainer,
        run: Path,
        console: Console,
        *,
        sinks: Collection[str] = (),
        every: int | None = None,
        stage: Stage = ALONE,
    ) -> None:
        """Prepare the session; nothing runs yet.

        Args:
            trainer: the trainer, before its first iteration.
            run: run folder.
            console: where to print.
            sinks: where to log beside the run's file: names of `nexwarp.run.log_sinks.PACKAGES`.
            every: iterations between checkpoints; None is a tenth of the run.
            stage: place of the training among those of the run.
        """
        self.trainer, self.run, self.console, self.sinks, self.stage = trainer, run, console, sinks, stage
        self.ranks = trainer.ranks
        self.total = trainer.config.iterations
        self.every = every or max(self.total // CHECKPOINTS_A_RUN, 1)

    def check_room(self, kept: int = 0) -> None:
        """Raise StorageError unless the disk has room for the run's files.

        Args:
            kept: number of checkpoints that the run has already.
        """
        if self.ranks.first:
            check_room(self.run, max(FILES_AT_A_TIME - kept, 1) * self.trainer.checkpoint_size())

    def resume(self, *, begun: bool = True) -> None:
        """Restore the run's newest complete checkpoint, if it has one.

        Args:
            begun: whether one is expected, so that the console says where there is none.
        """
        found = False
        if self.ranks.first:
            self.check_room(sum((self.run / name).is_dir() for name in CHECKPOINTS))
            if self.run.is_dir():  # a teacher that has not begun has no folder yet
                remove_leftovers(self.run)
            found = has_checkpoint(self.run)
        if self.ranks.share(found):
            # The run's config is the one to trust: a run that is extended writes it before its next checkpoint.
            self.trainer.restore(self.run, partial(display.warn, self.console), extend=True)
            self.console.print(f"resumed at iteration {self.trainer.iteration:,}")
        elif begun:
            self.console.print(f"{self.run}: no checkpoint yet, training starts from the beginning", soft_wrap=True)

    def train(self, viewer: "Viewer | None" = None) -> None:
        """Run the training loop; write checkpoints at regular iterations and after a signal to stop.

        Of several ranks, all stop after the step in which the signal of one has reached them. Rank 0 writes.

        Args:
            viewer: shows the training between steps; None shows nothing.

        Raises:
            DivergedError: the training diverged twice; the last good model and a report are in the run.
            StorageError: the disk is full; the current model is in the run if there was room for it.
            Stopped: a signal ended the training; a checkpoint of its last step is in the run.
        """
        trainer, ranks = self.trainer, self.ranks
        progress_display = display.TrainingDisplay(
            self.console, self.total, trainer.iteration, trainer.device, self.stage.name
        )
        sinks = {name: name in self.sinks for name in PACKAGES}
        log = TrainingLog(self.run, trainer, **sinks, settings=self.stage.settings)
        with ExitStack() as stack:
            if ranks.first:
                stack.enter_context(progress_display)
                stack.enter_context(log)
            stop_signal = stack.enter_context(deferred_stop())

            def observe(step: StepReport) -> None:
                if ranks.first:
                    progress_display(step)
                    with self._model_kept():
                        log(step)
                if viewer is not None:
                    done = self.stage.iterations + step.iteration
                    viewer.between_steps(done, partial(_describe, step), lambda: stop_signal() is not None)
                number = ranks.agree(stop_signal(), now=step.iteration == self.total)
                if step.passed(self.every) or step.iteration == self.total or number is not None:
                    with self._model_kept():
                        trainer.save_checkpoint(self.run)
                if ranks.size == 1:
                    number = stop_signal()  # also one that came during the save
                if number is not None:
                    ranks.leave_together()
                    raise Stopped(number)

            def warn(text: str) -> None:
                if ranks.first:
                    display.warn(self.console, text)
                    log.rewind()

            try:
                trainer.run(observe, warn)
            except DivergedError as error:
                raise self._diverged(error) from None

    def _diverged(self, error: DivergedError) -> DivergedError:
        """Write a report and the last good model, which the trainer has restored; return the error to raise."""
        trainer, run = self.trainer, self.run
        report = {"message": str(error), **error.report}
        outcome = f"the model of iteration {trainer.iteration:,} and a report, {DIVERGED_FILE}, are in {run}"
        try:
            if self.ranks.first:
                write_json(run / DIVERGED_FILE, report)
                save_model(run, trainer.model())
        except OSError as problem:
            outcome = f"the model of iteration {trainer.iteration:,} could not be saved ({problem})"
        outcome = str(self.ranks.share(outcome))
        self.ranks.leave_together()
        return DivergedError(f"{error}; {outcome}", report)

    @contextmanager
    def _model_kept(self) -> Iterator[None]:
        """If the block fails on a full disk, save the model at least, which is smaller than a checkpoint."""
        try:
            yield
        except OSError as error:
            try:
                save_model(self.run, self.trainer.model())
                model = "the current model is saved"
            except OSError:
                model = "the model cannot be saved either"
            checkpoint = "there is no checkpoint"
            if has_checkpoint(self.run):
                checkpoint = "--resume continues from the last checkpoint"
            iteration = self.trainer.iteration
            raise StorageError(f"{error}; training stops at iteration {iteration:,}: {model}, {checkpoint}") from error

    def finish(self) -> Model:
        """Finish, write, evaluate and return the model.

        Raises:
            StorageError, OutOfMemoryError: the last checkpoint holds the trained state; --resume finishes the run.
        """
        complete = f"{self.stage.name} is complete and saved: --resume finishes the run"
        try:
            return self._finish()
        except OSError as error:
            raise StorageError(f"{error}; {complete}") from error
        except (MemoryError, RuntimeError) as error:
            if (needed := needed_memory(error)) is None:
                raise
            raise OutOfMemoryError(f"out of memory: needed {needed}; {complete}") from error

    def _finish(self) -> Model:
        trainer, scene, run = self.trainer, self.trainer.scene, self.run
        if not self.ranks.first:
            return self._finish_with_others()
        with display.stages(self.console) as observe:
            finished = trainer.finish(observe)
        file = save_model(run, finished)
        model = shared_model(file, self.ranks)
        given = scene.cameras
        cameras = trainer.views.refined_cameras(trainer.poses)
        refined = {TRAIN: dict(zip(given[TRAIN], cameras, strict=True))}
        save_cameras(run / CAMERAS_FILE, given if trainer.poses is None else given | refined, given)
        facts = self._facts(model, file)
        if self.stage.teacher:
            write_json(run / METRICS_FILE, facts)
            return model
        rows = {}
        if scene.test:
            mask_mode = trainer.config.mask_mode
            results = evaluate_run(model, scene, run, self.console, mask_mode=mask_mode, facts=facts, ranks=self.ranks)
            rows = figures(results)
        rows |= {
            "surfels": f"{len(model.surfels):,}",
            "model file": f"{facts['megabytes']:.1f} MB",
            "training": f"{facts['seconds']:.0f} s, {facts['iterations_per_second']:.1f} it/s",
            "run": str(run),
        }
        self.console.print(display.results_table(rows, f"{len(scene.test)} test views"))
        if scene.test:
            strip = run / RENDERS_FOLDER / COMPARE / picture_name(scene.test[0].name)
            self.console.print(f"photo, render, error: {strip}")
        return model

    def _facts(self, model: Model, file: Path) -> dict[str, Json]:
        """Return the entries of metrics.json beside the metrics.

        The iterations and seconds of a student include those of the run's teachers.
        """
        trainer, device = self.trainer, self.trainer.device
        iterations, seconds = trainer.iteration, trainer.seconds
        if not self.stage.teacher:
            iterations, seconds = iterations + self.stage.iterations, seconds + self.stage.seconds
        facts: dict[str, Json] = {
            "preset": trainer.config.preset,
            "iterations": iterations,
            "surfels": len(model.surfels),
            "megabytes": file.stat().st_size / 1e6,
            "seconds": seconds,
            "iterations_per_second": iterations / max(seconds, 1e-9),
            "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        }
        if trainer.teachers is not None:
            facts["teachers"] = len(trainer.teachers.models)
        return facts

    def _finish_with_others(self) -> Model:
        """Return the model that rank 0 has finished; render a share of the test views for it."""
        trainer = self.trainer
        if trainer.graphs is not None:
            trainer.graphs.clear()  # NCCL waits, when it ends, for graphs that hold its all-reduce
        model = shared_model(None, self.ranks)
        if trainer.scene.test and not self.stage.teacher:
            evaluate(model, trainer.scene.test, mask_mode=trainer.config.mask_mode, ranks=self.ranks)
        return model


def shared_model(file: Path | None, ranks: Ranks) -> Model:
    """Return rank 0's model on the device of each rank.

    Args:
        file: of the model, on rank 0.
        ranks: the processes that train together.
    """
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
