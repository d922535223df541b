"""Trains the default and then gsplat for as many seconds, each alone on its GPU.

    python -m benchmarks.quality.equal_seconds OUT.jsonl --scenes train,fox --data DIR

For each scene: our default with 30,000 iterations; two short trainings of gsplat, which tell the seconds of its
iterations; then gsplat with the number of iterations that take as long as ours. Run nothing beside it on the GPU. Its
row is that of BEST: the best one of the scene with 30,000 iterations, of those known when the seconds were measured.
Results are appended to OUT, those of the short trainings too; what OUT holds is not trained again.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path

from benchmarks.quality.jobs import ITERATIONS, SCENES, SIZE, TrainingJob
from benchmarks.quality.results import drop_unfinished, read_results
from benchmarks.quality.rows import DEFAULT, ROWS
from benchmarks.quality.schedule import Schedule
from benchmarks.timing import ROOT

SHORT = (1_000, 3_000)
BEST = {
    "train": "gsplat MCMC, even start",
    "fox": "gsplat MCMC, skybox",
    "saharov": "gsplat MCMC, skybox",
    "kitchen25": "gsplat MCMC, skybox",
}


def iterations_for(seconds: float, short: Mapping[int, float]) -> int:
    """Return how many iterations take some seconds, in hundreds, 30,000 at most.

    A training is taken to have seconds of its own and the same seconds for each iteration. gsplat's schedule stretches
    with the iterations, so that short trainings have as many primitives on the mean as long ones.

    Args:
        seconds: of the training.
        short: seconds of two trainings by their iterations.
    """
    (few, first), (many, second) = sorted(short.items())
    each = (second - first) / (many - few)
    if each <= 0:
        raise ValueError(f"short: expected more seconds for more iterations, got {dict(short)}")
    fitting = (seconds - first) / each + few
    return max(100, min(ITERATIONS, 100 * int(fitting / 100)))


def train_scene(scene: str, data: Path, out: Path) -> None:
    """Do a scene's trainings that `out` lacks.

    Raises:
        RuntimeError: one has failed or was interrupted.
    """
    ours = TrainingJob(scene, "", DEFAULT.name, SIZE, 0, ITERATIONS)
    short = {n: TrainingJob(scene, "", BEST[scene], SIZE, 0, n) for n in SHORT}
    seconds = {job: _seconds(job, data, out) for job in (ours, *short.values())}
    count = iterations_for(seconds[ours], {n: seconds[job] for n, job in short.items()})
    _seconds(TrainingJob(scene, "", BEST[scene], SIZE, 0, count), data, out)


def _seconds(job: TrainingJob, data: Path, out: Path) -> float:
    """Do a training that `out` lacks, in a process of its own, and return its seconds."""
    if job not in (read_results([out]) if out.exists() else {}) and Schedule(ROWS, data, out).run([job]):
        raise RuntimeError(f"{job}: expected a result, got none")
    return float(read_results([out])[job]["seconds"])


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.quality.equal_seconds", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", default=",".join(SCENES), help="default: %(default)s")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the scenes")
    given = parser.parse_args(arguments)
    scenes = given.scenes.split(",")
    if unknown := [scene for scene in scenes if scene not in BEST]:
        parser.error(f"--scenes: expected some of {', '.join(BEST)}, got {', '.join(unknown)}")
    if given.out.exists():
        drop_unfinished(given.out)
    for scene in scenes:
        train_scene(scene, given.data, given.out)


if __name__ == "__main__":
    main()
