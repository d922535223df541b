"""Repeats one training, each time in a process of its own, and compares the models byte by byte.

    python -m benchmarks.repeat --scene fox --device cuda --iterations 2000 --deterministic --runs 2
    python -m benchmarks.repeat --scene fox --device cuda --iterations 2000 --runs 5

prints Markdown: SHA-256 of each model, PSNR on the test views and speed, then mean and spread over the runs. With
--deterministic, and on a CPU, the exit code is 1 unless all models have the same bytes.
"""

import hashlib
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from benchmarks.suite import Options
from nexwarp.model.model_file import MODEL_FILE
from nexwarp.run.contents import METRICS_FILE


@dataclass(frozen=True)
class Run:
    """One training.

    Attributes:
        digest: SHA-256 of its model file.
        psnr: on the test views, in dB; None where there are none.
        rate: iterations a second.
    """

    digest: str
    psnr: float | None
    rate: float


def read(folder: Path) -> Run:
    """Read the result of a training from its run folder."""
    metrics = json.loads((folder / METRICS_FILE).read_bytes())
    digest = hashlib.sha256((folder / MODEL_FILE).read_bytes()).hexdigest()
    return Run(digest, metrics.get("psnr"), metrics["iterations_per_second"])


def table(runs: Sequence[Run], title: str) -> str:
    """Return Markdown of the runs, with mean and spread."""
    lines = [f"{title}:", "", "| run | SHA-256 of the model | test PSNR | it/s |", "|---|---|---|---|"]
    for number, run in enumerate(runs, 1):
        psnr = "" if run.psnr is None else f"{run.psnr:.4f} dB"
        lines.append(f"| {number} | {run.digest[:16]} | {psnr} | {run.rate:.1f} |")
    different = len({run.digest for run in runs})
    lines += ["", f"* {len(runs)} runs, {different} different model{'s'[: different != 1]}"]
    lines[-1] += ": identical bytes" if different == 1 and len(runs) > 1 else ""
    figures = [run.psnr for run in runs if run.psnr is not None]
    if figures:
        lines.append(f"* test PSNR {_spread(figures, 4)} dB")
    lines.append(f"* {_spread([run.rate for run in runs], 1)} it/s")
    return "\n".join(lines)


def _spread(values: Sequence[float], digits: int) -> str:
    """Mean, standard deviation and range."""
    mean = f"{statistics.fmean(values):.{digits}f}"
    if len(values) < 2:
        return mean
    deviation, low, high = statistics.stdev(values), min(values), max(values)
    return f"{mean} ± {deviation:.{digits}f} (standard deviation; {low:.{digits}f} to {high:.{digits}f})"


@dataclass
class Repeat:
    """Train the same several times and compare."""

    scene: Annotated[str, tyro.conf.arg(metavar="SCENE")] = "demo"
    """Folder of a scene, the name of one in --data, or demo."""
    runs: int = 2
    """Trainings, one after the other."""
    iterations: int | None = None
    """Of each; by default as many as `nexwarp train` does."""
    max_surfels: int | None = None
    """Budget of each; likewise."""
    device: Annotated[str, tyro.conf.arg(metavar="{cuda,cpu}")] = "cuda"
    """Where to train."""
    deterministic: bool = False
    """Train with --deterministic."""
    data: Path = Options.data
    """Folder of scenes."""
    extra: Annotated[str, tyro.conf.arg(metavar="OPTIONS")] = ""
    """More options for `nexwarp train`, such as "--downscale 2"."""

    def command(self) -> list[str]:
        """Return the training, but for its --run."""
        scene = self.scene
        if scene != "demo" and not Path(scene).exists() and (self.data / scene).exists():
            scene = str(self.data / scene)
        flags = [f"--device={self.device}", *["--deterministic"] * self.deterministic, *self.extra.split()]
        for name, value in (("iterations", self.iterations), ("max-surfels", self.max_surfels)):
            flags += [] if value is None else [f"--{name}={value}"]
        return [sys.executable, "-m", "nexwarp", "train", scene, *flags]

    def __call__(self) -> int:
        """Train, print, and return the exit code."""
        if self.runs < 1:
            print(f"--runs: expected at least 1, got {self.runs}", file=sys.stderr)
            return 2
        command, runs = self.command(), []
        with tempfile.TemporaryDirectory() as folder:
            for number in range(1, self.runs + 1):
                run = Path(folder) / f"run{number}"
                done = subprocess.run([*command, "--run", str(run)], stdout=subprocess.DEVNULL)
                if done.returncode != 0:
                    print(f"training {number} ended with exit code {done.returncode}", file=sys.stderr)
                    return 2
                runs.append(read(run))
                # Printed at once, so that an interruption does not lose the finished trainings.
                print(f"{number}: {runs[-1].digest}, {runs[-1].psnr} dB, {runs[-1].rate:.1f} it/s", file=sys.stderr)
        print(table(runs, f"`nexwarp {' '.join(command[3:])}`"))
        repeats = self.deterministic or self.device == "cpu"
        return 1 if repeats and len({run.digest for run in runs}) > 1 else 0


if __name__ == "__main__":
    sys.exit(tyro.cli(Repeat)())
