"""Display of progress and results: live lines in a terminal, occasional lines in a log file."""

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


def time_left(seconds: float) -> str:
    """Return an estimate of the time that a whole run takes on, as a person says it."""
    if seconds < 100:
        return f"{seconds:.0f} s left in all"
    minutes = round(seconds / 60)
    return f"{minutes} min left in all" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min left in all"


def device_name(device: torch.device) -> str:
    """Return the name of the GPU, or "the CPU"."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"


def warn(console: Console, text: str) -> None:
    """Print a warning."""
    console.print(f"warning: {text}")


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
    console: Console, total: int, done: int, device: torch.device, name: str, after: float = 0.0
) -> Iterator[Callable[[StepReport], None]]:
    """Show iteration, it/s, loss, training PSNR, surfels and memory of `total` iterations, and the whole run's time.

    `done` of them were done before; the run's work `after` them costs as much as so many iterations. Yield a function
    to call after each step: its numbers are fetched from the device only when they are shown.
    """
    start = shown = time.perf_counter()
    text = TextColumn("{task.fields[text]}")
    columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), text, TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(name, total=total, completed=done, text="")

        def show(step: StepReport) -> None:
            nonlocal shown
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
            text += f"  {time_left((total - step.iteration + after) / rate)}"
            progress.update(task, completed=step.iteration, text=text)
            if not console.is_terminal:
                console.print(f"iteration {step.iteration:,}/{total:,}  {text}")

        yield show


@contextmanager
def stages(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar that vanishes at the end, or lines in a log file, for each stage of some work.

    Yield a function to call with a stage's name, how many items of it are done, and their total.
    """
    tasks: dict[str, TaskID] = {}
    shown = time.perf_counter()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:

        def observe(stage: str, done: int, total: int) -> None:
            nonlocal shown
            first, due = stage not in tasks, time.perf_counter() - shown >= LOG_SECONDS
            if first:
                tasks[stage] = progress.add_task(stage, total=total)
            if not console.is_terminal and (first or due):
                console.print(f"{stage}: {total:,}" if first else f"{stage}: {done:,}/{total:,}")
                shown = time.perf_counter()
            progress.update(tasks[stage], completed=done)

        yield observe


def results_table(rows: dict[str, str], title: str) -> Table:
    """Return a table of two columns: names and values."""
    table = Table(title=printable(title), show_header=False)
    for name, value in rows.items():
        table.add_row(printable(name), printable(value))
    return table
