"""What a person sees while a run goes on: a live line in a terminal, a line now and then in a log."""

import time
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

from nexwarp.model.model import Model
from nexwarp.run.log import peak_memory
from nexwarp.train import trainer

REFRESH_SECONDS = 0.5
LOG_LINES = 20


def describe_exposures(model: Model) -> str:
    """How far the photos that a model was learned from differ."""
    exposures = model.exposures
    if exposures is None:
        return "one for all photos"
    gains, edge = exposures.log_gains.exp(), exposures.falloff[:2].sum().exp()
    told = f"{gains.min():.2f} to {gains.max():.2f} times the photos' mean"
    return f"{told}; light at the edge: {edge:.0%}"


def device_name(device: torch.device) -> str:
    """Name of the GPU, or "the CPU"."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"


def warn(console: Console, text: str) -> None:
    """Print a warning."""
    console.print(f"warning: {text}", soft_wrap=True, markup=False, highlight=False)


class TrainingDisplay:
    """Iteration, it/s, time left, loss, training PSNR, surfels and memory of a run."""

    def __init__(self, console: Console, total: int, done: int, device: torch.device) -> None:
        """Show a run of `total` iterations of which `done` are done."""
        self.console, self.total, self.done, self.device = console, total, done, device
        self.start = self.shown = time.perf_counter()
        self.progress = Progress(
            TextColumn("training"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self.task = self.progress.add_task("training", total=total, completed=done, text="")

    def __enter__(self) -> "TrainingDisplay":
        self.progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.progress.stop()

    def __call__(self, step: trainer.Progress) -> None:
        """Observe a step; the numbers are fetched only when they are shown."""
        now = time.perf_counter()
        if self.console.is_terminal:
            due = now - self.shown >= REFRESH_SECONDS
        else:
            due = step.iteration % max(self.total // LOG_LINES, 1) == 0
        if not due and step.iteration < self.total:
            return
        self.shown = now
        rate = (step.iteration - self.done) / max(now - self.start, 1e-9)
        text = f"{rate:.1f} it/s  loss {step.loss():.4f}  train {step.psnr():.2f} dB  {step.surfels:,} surfels"
        text += f"  {memory(self.device)}"
        self.progress.update(self.task, completed=step.iteration, text=text)
        if not self.console.is_terminal:
            left = (self.total - step.iteration) / max(rate, 1e-9)
            self.console.print(
                f"iteration {step.iteration:,}/{self.total:,}  {text}  {left:.0f} s left", soft_wrap=True
            )


def memory(device: torch.device) -> str:
    """Peak memory so far: of the GPU in use, else of this process."""
    used = peak_memory(device)
    return "" if used is None else f"{used / 2**30:.1f} GiB{' GPU' if device.type == 'cuda' else ''}"


@contextmanager
def counting(console: Console, title: str, total: int) -> Iterator[Callable[..., None]]:
    """Yield a function to call once an item is done."""
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(title, total=total)
        yield lambda _name=None: progress.advance(task)


@contextmanager
def stages(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """Yield a function to call with a stage's name, what is done and of how many; in a log, a line a stage."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    tasks: dict[str, TaskID] = {}
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:

        def observe(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
                if not console.is_terminal:
                    console.print(f"{stage}: {total:,}", soft_wrap=True)
            progress.update(tasks[stage], completed=done)

        yield observe


@contextmanager
def loading(console: Console) -> Iterator[Callable[[int, int], None]]:
    """Yield a function to call with the number of photos read and their total."""
    columns = (TextColumn("reading photos"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("reading photos", total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


def results_table(rows: dict[str, str], title: str) -> Table:
    """Make a two-column table."""
    table = Table(title=title, show_header=False)
    for name, value in rows.items():
        table.add_row(name, value)
    return table
