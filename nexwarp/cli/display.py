"""Display of progress and results: live lines in a terminal, occasional lines in a log file."""

import math
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from nexwarp.io.files import printable
from nexwarp.run.log import peak_memory
from nexwarp.train.report import StepReport

REFRESH_SECONDS = 0.5
LOG_LINES = 20
LOG_SECONDS = 20.0  # between the lines of a stage
RECENT = 30.0  # seconds after which a speed counts a third in the estimate of the time left


class TimeLeft:
    """How long a run takes on: the work that is left, counted in training steps, over its recent speed; and an end.

    Attributes:
        work: that is left, of all trainings of the run.
        end: seconds that follow all of it.
    """

    def __init__(self, work: float = 0.0, end: float = 0.0, clock: Callable[[], float] = time.perf_counter) -> None:
        self.work, self.end, self.clock = work, end, clock
        self.last = clock()
        self.recent_work = self.recent_seconds = 0.0

    def spend(self, work: float) -> None:
        """Note what was done since the last call; negative where a training went back."""
        now = self.clock()
        passed = now - self.last
        kept = math.exp(-passed / RECENT)
        self.recent_work = max(kept * self.recent_work + work, 0.0)
        self.recent_seconds = kept * self.recent_seconds + passed
        self.last, self.work = now, max(self.work - work, 0.0)

    def seconds(self) -> float:
        """Return the estimate, which needs some work done, or none left."""
        if not self.work:
            return self.end
        return self.end + self.work * self.recent_seconds / max(self.recent_work, 1e-9)

    def __str__(self) -> str:
        seconds = self.seconds()
        if seconds < 100:
            return f"{seconds:.0f} s left in all"
        minutes = round(seconds / 60)
        return f"{minutes} min left in all" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min left in all"


def device_name(device: torch.device) -> str:
    """Return the name of the GPU, or "the CPU"."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"


def warn(console: Console, text: str) -> None:
    """Print a warning."""
    console.print(f"warning: {text}", soft_wrap=True, markup=False, highlight=False)


@contextmanager
def plain_warnings(console: Console) -> Iterator[None]:
    """Print Python's warnings as `warn` does, without the place in the source."""

    def show(message: Warning | str, *_: object, **__: object) -> None:
        warn(console, str(message))

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextmanager
def training(
    console: Console, total: int, done: int, device: torch.device, name: str, left: TimeLeft
) -> Iterator[Callable[[StepReport], None]]:
    """Show iteration, it/s, loss, training PSNR, surfels and memory of `total` iterations, and the whole run's time.

    `done` of them were done before. Yield a function to call after each step: its numbers are fetched from the device
    only when they are shown.
    """
    start = shown = time.perf_counter()
    text = TextColumn("{task.fields[text]}")
    columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), text, TimeElapsedColumn())
    noted = done
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(name, total=total, completed=done, text="")

        def show(step: StepReport) -> None:
            nonlocal shown, noted
            now = time.perf_counter()
            if console.is_terminal:
                due = now - shown >= REFRESH_SECONDS
            else:
                due = step.passed(max(total // LOG_LINES, 1))
            if not due and step.iteration < total:
                return
            shown = now
            rate = (step.iteration - done) / max(now - start, 1e-9)
            text = f"{rate:.1f} it/s  loss {step.loss():.4f}  train {step.psnr():.2f} dB  {step.surfels:,} surfels"
            if (used := peak_memory(device)) is not None:
                text += f"  {used / 2**30:.1f} GiB{' GPU' if device.type == 'cuda' else ''}"
            left.spend(step.iteration - noted)
            noted = step.iteration
            progress.update(task, completed=step.iteration, text=f"{text}  {left}")
            if not console.is_terminal:
                console.print(f"iteration {step.iteration:,}/{total:,}  {text}  {left}", soft_wrap=True)

        yield show


def _bars(console: Console, *last: ProgressColumn) -> Progress:
    """Return bars that vanish at their end, shown in a terminal only."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *last)
    return Progress(*columns, console=console, disable=not console.is_terminal, transient=True)


@contextmanager
def counting(console: Console, title: str, total: int) -> Iterator[Callable[..., None]]:
    """Show a progress bar; yield a function to call after each item."""
    with _bars(console, TimeRemainingColumn()) as progress:
        task = progress.add_task(title, total=total)
        yield lambda _name=None: progress.advance(task)


@contextmanager
def loading(console: Console) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar; yield a function to call with the number of photos read and their total."""
    with _bars(console, TimeRemainingColumn()) as progress:
        task = progress.add_task("reading photos", total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


@contextmanager
def stages(console: Console, left: TimeLeft | None = None) -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar, or lines in a log file, for each stage; yield a function of its name, items done and total."""
    tasks: dict[str, TaskID] = {}
    shown = time.perf_counter()
    with _bars(console, TimeElapsedColumn()) as progress:

        def observe(stage: str, done: int, total: int) -> None:
            nonlocal shown
            first, due = stage not in tasks, time.perf_counter() - shown >= LOG_SECONDS
            if first:
                tasks[stage] = progress.add_task(stage, total=total)
            if not console.is_terminal and (first or due):
                console.print(f"{stage}: {total:,}" if first else f"{stage}: {done:,}/{total:,}", soft_wrap=True)
                shown = time.perf_counter()
            note = "" if left is None else f"  {left}"
            progress.update(tasks[stage], completed=done, description=f"{stage}{note}")

        yield observe


def results_table(rows: dict[str, str], title: str) -> Table:
    """Return a table of two columns: names and values."""
    table = Table(title=printable(title), show_header=False)
    for name, value in rows.items():
        table.add_row(printable(name), printable(value))
    return table
