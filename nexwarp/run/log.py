"""Training logs: lines of JSON at regular iterations and, on request, TensorBoard and Weights & Biases."""

import json
import math
import os
import time
from pathlib import Path
from typing import TextIO, TypedDict

import torch

from nexwarp.io.files import written_aside
from nexwarp.run.contents import LOG_FILE
from nexwarp.run.log_sinks import Sink, TensorboardSink, WandbSink
from nexwarp.train.recipe import Config
from nexwarp.train.report import StepReport
from nexwarp.train.trainer import Trainer

# Iterations between two lines, fewer in short runs, which get about MIN_LINES lines.
EVERY = 100
MIN_LINES = 100

# Names in `nexwarp.train.recipe.LearningRates` of the optimizer's parameters.
RATES = {
    "corrections": "poses",
    "means": "means",
    "raw_quats": "quats",
    "log_scales": "scales",
    "logit_opacities": "opacities",
    "raw_gammas": "gammas",
    "sh0": "sh0",
    "shN": "shN",
    "grid": "grid",
}


def peak_memory(device: torch.device) -> int | None:
    """Return the peak memory in bytes: torch's on a GPU, else this process's; None if the system does not report it."""
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
    """One line of the log; `TrainingLog` describes the fields."""

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
    """Observer of a training that writes `metrics.jsonl`: one JSON object per line, flushed after each line.

    A line is written at iteration 1, every `every` iterations after it, and at the last iteration. At other iterations
    nothing is fetched from the device. The fields of a line:

        iteration, surfels: the number of each;
        loss, losses: loss of this step's view, and its weighted terms by name;
        psnr: PSNR of this step's view [dB];
        iterations_per_second: mean since the previous line, in wall-clock time with checkpoints and pauses;
        seconds: training time so far, over all sessions of the run;
        memory_bytes: see `peak_memory`;
        rates: learning rates by name, as the optimizer has them: that of the means includes the scene's scale.

    Values that are not finite are written as null.
    """

    def __init__(
        self,
        run: Path,
        trainer: Trainer,
        *,
        tensorboard: bool = False,
        wandb: bool = False,
        settings: Config | None = None,
    ) -> None:
        """Continue the log of a run folder: lines after the trainer's iteration, and damaged lines, are dropped.

        Args:
            run: an existing folder.
            trainer: the trainer to observe.
            tensorboard: also write the values as scalars to `run/tensorboard`.
            wandb: also log the values, by the same names, to Weights & Biases.
            settings: of the run, for Weights & Biases; None takes the trainer's.
        """
        self.settings = trainer.config if settings is None else settings
        self.run, self.trainer, self.tensorboard, self.wandb = run, trainer, tensorboard, wandb
        total = trainer.config.iterations
        self.every = max(min(EVERY, total // MIN_LINES), 1)
        self.last = trainer.iteration
        self.file: TextIO | None = None
        self.sinks: list[Sink] = []

    def __enter__(self) -> "TrainingLog":
        keep_lines(self.run / LOG_FILE, self.trainer.iteration)
        if self.tensorboard:
            self.sinks.append(TensorboardSink(self.run, self.trainer.iteration))
        if self.wandb:
            self.sinks.append(WandbSink(self.run, self.settings.as_dict()))
        self.file = _open_log(self.run / LOG_FILE)
        self.written = time.perf_counter()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for file in (self.file, *self.sinks):
            try:
                if file is not None:
                    file.close()
            except OSError:  # a full disk: an exception that is already being raised must not be replaced
                if kind is None:
                    raise

    def rewind(self) -> None:
        """Drop the lines after the trainer's iteration; for a trainer that was restored to an earlier one."""
        assert self.file is not None
        self.file.close()
        keep_lines(self.run / LOG_FILE, self.trainer.iteration)
        self.file = _open_log(self.run / LOG_FILE)
        self.last, self.written = self.trainer.iteration, time.perf_counter()

    def __call__(self, step: StepReport) -> None:
        """Write a line if one is due after this step."""
        # Lines at 1, 1 + every, ...: steps at round numbers are often special, such as those of density control.
        if (step.iteration - 1) % self.every >= step.views and step.iteration != self.trainer.config.iterations:
            return
        assert self.file is not None
        line = self._line(step)
        self.file.write(json.dumps(_finite(line), allow_nan=False) + "\n")
        self.file.flush()
        for sink in self.sinks:
            sink.write(_scalars(line), step.iteration)

    def _line(self, step: StepReport) -> LogLine:
        # One transfer for all terms. It waits for the step, so the clock is read after it.
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
    """Return the learning rates of the trainer's last step by the names of `nexwarp.train.recipe.LearningRates`."""
    poses = () if trainer.poses is None else (trainer.poses,)
    modules = (trainer.surfels, trainer.texture, *poses)
    names = {id(parameter): name for module in modules for name, parameter in module.named_parameters()}
    rates = {}
    for group in trainer.optimizer.param_groups:
        name = names[id(group["params"][0])]
        rates[RATES.get(name, name.split(".")[0])] = float(group["lr"])
    return rates


def _open_log(path: Path) -> TextIO:
    """Open a log to append to it. A link at its place is refused: it may lead to a file that is not ours."""

    def no_link(name: str, flags: int) -> int:
        return os.open(name, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)

    return open(path, "a", encoding="utf-8", opener=no_link)


def keep_lines(path: Path, iteration: int) -> None:
    """Drop lines of later iterations, and incomplete lines, from a log; the file need not exist."""
    if not path.exists():
        return
    lines = path.read_bytes().splitlines(keepends=True)
    kept = [line for line in lines if line.endswith(b"\n") and _iteration(line) <= iteration]
    if kept != lines:
        with written_aside(path) as temporary:
            temporary.write_bytes(b"".join(kept))


def _iteration(line: bytes) -> float:
    """Return the iteration of a line; infinity if the line is damaged."""
    try:
        iteration = json.loads(line)["iteration"]
    except (ValueError, TypeError, KeyError, RecursionError):  # bad UTF-8 is a ValueError
        return math.inf
    return iteration if type(iteration) is int else math.inf


def _finite(value: object) -> object:
    """Return a JSON value in which None replaces numbers that are not finite."""
    if isinstance(value, dict):
        return {name: _finite(x) for name, x in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _scalars(line: LogLine) -> list[tuple[str, float]]:
    """Return a line as names and values for the sinks."""
    tags = {"loss/total": line["loss"], "train/psnr": line["psnr"], "train/surfels": line["surfels"]}
    tags |= {f"loss/{name}": value for name, value in line["losses"].items()}
    tags["speed/iterations_per_second"] = line["iterations_per_second"]
    if line["memory_bytes"] is not None:
        tags["memory/GiB"] = line["memory_bytes"] / 2**30
    tags |= {f"rate/{name}": value for name, value in line["rates"].items()}
    return list(tags.items())
