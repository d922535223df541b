"""What a training leaves behind of its course: a line of JSON every so often, and TensorBoard events if asked for."""

import importlib.util
import json
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, TextIO, TypedDict

import torch

from nexwarp.io.files import written_aside
from nexwarp.train.trainer import Progress, Trainer

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

LOG_FILE = "metrics.jsonl"
TENSORBOARD_FOLDER = "tensorboard"

# A line every so many iterations; in short runs so many that there are about MIN_LINES of them.
EVERY = 100
MIN_LINES = 100

# Groups of the optimizer by what they hold, as `nexwarp.train.config.LearningRates` names them.
RATES = {
    "means": "means",
    "raw_quats": "quats",
    "log_scales": "scales",
    "logit_opacities": "opacities",
    "raw_gammas": "gammas",
    "sh0": "sh0",
    "shN": "shN",
    "grid": "grid",
}


def check_tensorboard() -> None:
    """Raise ValueError unless the package that writes TensorBoard's files is there."""
    if importlib.util.find_spec("tensorboard") is None:
        raise ValueError(
            "--tensorboard: expected the package tensorboard, found none; pip install 'nexwarp[tensorboard]'"
        )


def peak_memory(device: torch.device) -> int | None:
    """Largest memory so far in bytes: torch's on the GPU in use, else this process's; None where nobody counts it."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    try:
        import resource
        import sys
    except ImportError:  # not on Windows
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


class LogLine(TypedDict):
    """One line of the log, as `TrainingLog` describes it."""

    iteration: int
    loss: float
    losses: dict[str, float]
    psnr: float
    surfels: int
    iterations_per_second: float
    seconds: float
    memory_bytes: int | None
    rates: dict[str, float]


class TrainingLog:
    """Observes a training and writes `metrics.jsonl`, a JSON object a line, flushed at once.

    Lines come at iteration 1, every `every` after that, and at the last one; between them nothing is fetched from the
    device. A line holds

        iteration, surfels;
        loss, losses: the sum and its terms by name, factors included, of that step's view;
        psnr: dB, of that view;
        iterations_per_second: since the line before by the clock on the wall, checkpoints and pauses included;
        seconds: of training so far, over all sessions of the run;
        memory_bytes: `peak_memory`;
        rates: learning rates by name (that of the means times the scene's scale, as the optimizer has it).

    Values that are not finite are null.
    """

    def __init__(self, run: Path, trainer: Trainer, *, tensorboard: bool = False) -> None:
        """Continue the log of a run folder at the trainer's iteration: lines beyond it, and damaged ones, are dropped.

        Args:
            run: an existing folder.
            trainer: that will be observed.
            tensorboard: write the same values as scalars into `run/tensorboard`, too.
        """
        self.run, self.trainer, self.tensorboard = run, trainer, tensorboard
        total = trainer.config.iterations
        self.every = max(min(EVERY, total // MIN_LINES), 1)
        self.last = trainer.iteration
        self.file: TextIO | None = None
        self.writer: SummaryWriter | None = None

    def __enter__(self) -> "TrainingLog":
        keep_lines(self.run / LOG_FILE, self.trainer.iteration)
        if self.tensorboard:
            from torch.utils.tensorboard import SummaryWriter

            # Events of a session that got further than the checkpoint are not shown any more.
            purge = self.trainer.iteration + 1 if self.trainer.iteration else None
            self.writer = SummaryWriter(str(self.run / TENSORBOARD_FOLDER), purge_step=purge)
        self.file = (self.run / LOG_FILE).open("a", encoding="utf-8")
        self.written = time.perf_counter()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for file in (self.file, self.writer):
            try:
                if file is not None:
                    file.close()
            except OSError:  # what a full disk did not take, it does not take now: that was told before
                if kind is None:
                    raise

    def rewind(self) -> None:
        """Drop the lines beyond the trainer's iteration, after it has gone back."""
        assert self.file is not None
        self.file.close()
        keep_lines(self.run / LOG_FILE, self.trainer.iteration)
        self.file = (self.run / LOG_FILE).open("a", encoding="utf-8")
        self.last, self.written = self.trainer.iteration, time.perf_counter()

    def __call__(self, step: Progress) -> None:
        """Observe a step."""
        # From 1 on: steps that are multiples of something often do more than others, such as to look beyond the frame.
        if (step.iteration - 1) % self.every and step.iteration != self.trainer.config.iterations:
            return
        assert self.file is not None
        line = self._line(step)
        self.file.write(json.dumps(_finite(line), allow_nan=False) + "\n")
        self.file.flush()
        if self.writer is not None:
            for tag, value in _scalars(line):
                self.writer.add_scalar(tag, value, step.iteration)
            self.writer.flush()

    def _line(self, step: Progress) -> LogLine:
        # One transfer for all terms; it waits for the step, so the time is taken after it.
        terms = torch.stack([x.detach().float() for x in step.losses.values()]).tolist()
        psnr, now = step.psnr(), time.perf_counter()
        rate = (step.iteration - self.last) / max(now - self.written, 1e-9)
        self.last, self.written = step.iteration, now
        return {
            "iteration": step.iteration,
            "loss": sum(terms),
            "losses": dict(zip(step.losses, terms, strict=True)),
            "psnr": psnr,
            "surfels": step.surfels,
            "iterations_per_second": rate,
            "seconds": self.trainer.seconds,
            "memory_bytes": peak_memory(self.trainer.device),
            "rates": learning_rates(self.trainer),
        }


def learning_rates(trainer: Trainer) -> dict[str, float]:
    """Learning rates at the trainer's last step, by the names of `nexwarp.train.config.LearningRates`."""
    modules = (trainer.surfels, trainer.texture)
    names = {id(parameter): name for module in modules for name, parameter in module.named_parameters()}
    rates = {}
    for group in trainer.optimizer.param_groups:
        name = names[id(group["params"][0])]
        rates[RATES.get(name, name.split(".")[0])] = float(group["lr"])
    return rates


def keep_lines(path: Path, iteration: int) -> None:
    """Drop from a log the lines of later iterations, and any that is cut off; no file is no lines."""
    if not path.exists():
        return
    lines = path.read_bytes().splitlines(keepends=True)
    kept = [line for line in lines if line.endswith(b"\n") and _iteration(line) <= iteration]
    if kept != lines:
        with written_aside(path) as temporary:
            temporary.write_bytes(b"".join(kept))


def _iteration(line: bytes) -> float:
    """Iteration of a line; infinite when it is none."""
    try:
        iteration = json.loads(line)["iteration"]
    except (ValueError, TypeError, KeyError):  # bad UTF-8 is a ValueError
        return math.inf
    return iteration if type(iteration) is int else math.inf


def _finite(value: object) -> object:
    """The same with null for what JSON cannot express."""
    if isinstance(value, dict):
        return {name: _finite(x) for name, x in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _scalars(line: LogLine) -> list[tuple[str, float]]:
    """Tags and values for TensorBoard."""
    tags = {"loss/total": line["loss"], "train/psnr": line["psnr"], "train/surfels": line["surfels"]}
    tags |= {f"loss/{name}": value for name, value in line["losses"].items()}
    tags["speed/iterations_per_second"] = line["iterations_per_second"]
    if line["memory_bytes"] is not None:
        tags["memory/GiB"] = line["memory_bytes"] / 2**30
    tags |= {f"rate/{name}": value for name, value in line["rates"].items()}
    return list(tags.items())
