"""Training logs: lines of JSON at regular iterations and, on request, TensorBoard."""

import json
import math
import os
import re
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

import torch

from nexwarp.io.files import written_aside
from nexwarp.io.json_files import Json, finite
from nexwarp.run.folder import LOG_FILE, TENSORBOARD_FOLDER
from nexwarp.train.report import StepReport
from nexwarp.train.trainer import Trainer

# Iterations between two lines, fewer in short runs, which get about MIN_LINES lines.
EVERY = 100
MIN_LINES = 100


class TrainingLog:
    """Observer of a training that writes `metrics.jsonl`, whose fields docs/format.md describes, line by line.

    A line is written at iteration 1, every `every` iterations after it, and at the last iteration. At other iterations
    nothing is fetched from the device. Values that are not finite are written as null.
    """

    def __init__(self, run: Path, trainer: Trainer, *, tensorboard: bool = False) -> None:
        """Continue the log of a run folder: lines after the trainer's iteration, and damaged lines, are dropped."""
        self.path = run / LOG_FILE
        self.trainer = trainer
        self.tensorboard = tensorboard
        self.every = max(min(EVERY, trainer.config.iterations // MIN_LINES), 1)
        self.events: Any = None

    def __enter__(self) -> "TrainingLog":
        if self.tensorboard:
            from torch.utils.tensorboard import SummaryWriter

            # Events after this iteration, which is trained again, are hidden.
            hidden = self.trainer.iteration + 1 if self.trainer.iteration else None
            self.events = SummaryWriter(str(self.path.parent / TENSORBOARD_FOLDER), purge_step=hidden)
        keep_lines(self.path, self.trainer.iteration)
        self.last = self.trainer.iteration
        self.written = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        if self.events is not None:
            with suppress(OSError):  # a full disk: the log of each line has told it, or the last event is lost
                self.events.close()

    def __call__(self, step: StepReport) -> None:
        """Write a line if one is due after this step."""
        # Lines at 1, 1 + every, ...: steps at round numbers are often special, such as those of density control.
        if (step.iteration - 1) % self.every >= step.views and step.iteration != self.trainer.config.iterations:
            return
        line = {name: finite(value) for name, value in self._line(step).items()}
        with _open_log(self.path) as file:
            file.write(json.dumps(line, allow_nan=False) + "\n")
        if self.events is not None:
            for name, value in _scalars(line).items():
                self.events.add_scalar(name, value, step.iteration)
            self.events.flush()

    def _line(self, step: StepReport) -> dict[str, Json]:
        # One transfer for all terms. It waits for the step, so the clock is read after it.
        terms = torch.stack([x.detach().float() for x in step.losses.values()]).tolist()
        psnr = step.psnr()
        now = time.perf_counter()
        rate = (step.iteration - self.last) / max(now - self.written, 1e-9)
        self.last = step.iteration
        self.written = now
        groups = self.trainer.optimizer.param_groups
        return {
            "iteration": step.iteration,
            "loss": sum(terms),
            "losses": dict(zip(step.losses, terms, strict=True)),
            "psnr": psnr,
            "surfels": step.surfels,
            "iterations_per_second": rate,
            "seconds": self.trainer.seconds,
            "memory_bytes": peak_memory(self.trainer.device),
            "rates": {re.sub("^(raw|log|logit)_", "", group["name"]): float(group["lr"]) for group in groups},
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


def _scalars(line: Mapping[str, Json]) -> dict[str, float]:
    """Return a line as TensorBoard's values, by name."""
    tags = {"loss/total": line["loss"], "train/psnr": line["psnr"], "train/surfels": line["surfels"]}
    tags["speed/iterations_per_second"] = line["iterations_per_second"]
    for group, values in (("loss", line["losses"]), ("rate", line["rates"])):
        assert isinstance(values, dict)
        tags |= {f"{group}/{name}": value for name, value in values.items()}
    if isinstance(line["memory_bytes"], int):
        tags["memory/GiB"] = line["memory_bytes"] / 2**30
    return {name: value for name, value in tags.items() if isinstance(value, (int, float))}
