"""Where a training's log goes beside its file: TensorBoard and Weights & Biases, by the same names."""

import importlib.util
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from nexwarp.errors import SettingError
from nexwarp.io.files import one_line
from nexwarp.io.json_files import READ_ERRORS, Json, read_object, write_json
from nexwarp.run.contents import TENSORBOARD_FOLDER, WANDB_FILE

if TYPE_CHECKING:
    pass

PROJECT = "nexwarp"  # of Weights & Biases, unless WANDB_PROJECT names one
PACKAGES = ("tensorboard", "wandb")  # options, extras and packages have the same names


class Sink(Protocol):
    """Takes the scalars of a log line."""

    def write(self, scalars: Iterable[tuple[str, float]], iteration: int) -> None:
        """Take values by name."""

    def close(self) -> None:
        """Write what is left."""


def check_package(name: str) -> None:
    """Raise SettingError unless the package of an option is installed."""
    if importlib.util.find_spec(name) is None:
        raise SettingError(f"--{name}: expected the package {name}, found none; pip install 'nexwarp[{name}]'")


class TensorboardSink:
    """Writes events to a run's folder `tensorboard`."""

    def __init__(self, run: Path, iteration: int) -> None:
        """Continue after an iteration; events of later iterations, which are trained again, are hidden."""
        from torch.utils.tensorboard import SummaryWriter

        purge = iteration + 1 if iteration else None
        self.writer: SummaryWriter = SummaryWriter(str(run / TENSORBOARD_FOLDER), purge_step=purge)

    def write(self, scalars: Iterable[tuple[str, float]], iteration: int) -> None:
        """Write values by name."""
        for name, value in scalars:
            self.writer.add_scalar(name, value, iteration)
        self.writer.flush()

    def close(self) -> None:
        """Close the file."""
        self.writer.close()


class WandbSink:
    """Logs to Weights & Biases; a run that is resumed goes on there, by the id in its `wandb.json`.

    The variables of wandb count, such as WANDB_MODE=offline, WANDB_PROJECT and WANDB_DIR.
    """

    def __init__(self, run: Path, config: dict[str, Json]) -> None:
        """Start or continue; SettingError if wandb cannot, for example without a login."""
        import wandb

        project = os.environ.get("WANDB_PROJECT", PROJECT)
        try:
            self.run: wandb.Run = wandb.init(
                project=project, name=run.resolve().name, config=config, id=_id(run), resume="allow"
            )
            # Iterations that are trained again, after a resumption or a divergence, are logged again.
            self.run.define_metric("*", step_metric="iteration")
        except (wandb.errors.Error, OSError, ValueError) as error:
            raise SettingError(f"--wandb: wandb cannot start: {one_line(error)}") from None
        write_json(run / WANDB_FILE, {"id": self.run.id})

    def write(self, scalars: Iterable[tuple[str, float]], iteration: int) -> None:
        """Log values by name."""
        self.run.log({"iteration": iteration, **dict(scalars)})

    def close(self) -> None:
        """End the run."""
        self.run.finish()


def _id(run: Path) -> str | None:
    """Return the id under which wandb knows a run; None if it does not know it."""
    try:
        value = read_object(run / WANDB_FILE).get("id")
    except (FileNotFoundError, *READ_ERRORS):
        return None
    return value if isinstance(value, str) else None
