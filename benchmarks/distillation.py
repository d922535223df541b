"""Distillation: a training that also learns from the renderings of models with other seeds, which are trained first.

Usage: `python -m benchmarks.distillation OUT.jsonl --scenes fox,saharov [--variant inner] [--teachers 2]
[--teacher-iterations 9000] [--teacher-size 40000] [--iterations 21000] [--size 40000] [--seed 0] [--downscale 1]
[--data DIR]`.
For each scene, teachers are trained, then the student (`nexwarp.train(..., teachers=...)`). With S the student's seed,
the teachers' are 100 S + 1, 100 S + 2 and so on. A line of OUT is one of `benchmarks.quality` and names the teachers;
its seconds and, but for memory, all other figures are the student's.
"""

import argparse
import dataclasses
import json
import time
from functools import partial
from pathlib import Path

import torch

from benchmarks.quality.jobs import SIZE, TrainingJob, config_of
from benchmarks.quality.results import result_line
from benchmarks.quality.rows import DEFAULT
from benchmarks.quality.run import run_job
from benchmarks.quality.scenes import VARIANTS, scene_of
from benchmarks.timing import ROOT
from nexwarp import Model, Trainer
from nexwarp.train.stages import student_trainer


def train_teachers(job: TrainingJob, data: Path, count: int, iterations: int, size: int) -> tuple[list[Model], float]:
    """Train models with seeds of their own.

    Args:
        job: the student's; with its seed S, the teachers' are 100 S + 1 to 100 S + count.
        data: folder of the scenes.
        count: how many.
        iterations: of each.
        size: budget of primitives of each.

    Returns:
        The models, and the seconds from the loaded scene to the last finished model.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    scene, teachers, begin = scene_of(job, data), [], time.perf_counter()
    for number in range(1, count + 1):
        one = dataclasses.replace(job, seed=100 * job.seed + number, iterations=iterations, size=size)
        trainer = Trainer(scene, dataclasses.replace(config_of(one, DEFAULT), teachers=0), device)
        trainer.run()
        teachers.append(trainer.finish())
    if device.type == "cuda":
        torch.cuda.synchronize()
    return teachers, time.perf_counter() - begin


def main(arguments: list[str] | None = None) -> int:
    """Train teachers and a student for each scene, and write a line of results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("out", type=Path)
    add("--scenes", required=True, help="comma-separated folders below the data")
    add("--variant", default="inner", choices=("", *VARIANTS), help="of the scenes (default: %(default)s)")
    add("--teachers", type=int, default=2, help="default: %(default)s")
    add("--teacher-iterations", type=int, default=9000, help="of each teacher (default: %(default)s)")
    add("--teacher-size", type=int, help="budget of primitives of each teacher (default: the student's)")
    add("--iterations", type=int, default=21_000, help="of the student (default: %(default)s)")
    add("--size", type=int, default=SIZE, help="budget of primitives (default: %(default)s)")
    add("--seed", type=int, default=0, help="of the student (default: %(default)s)")
    add("--downscale", type=int, default=1, help="reduce photos by (default: %(default)s)")
    add("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the scenes")
    given = parser.parse_args(arguments)
    if given.teachers < 1:
        parser.error(f"--teachers: expected at least one, got {given.teachers}")
    for scene in given.scenes.split(","):
        size = given.teacher_size or given.size
        row = f"{given.teachers} teachers of {given.teacher_iterations}"
        row += f", {size} surfels" if size != given.size else ""
        job = TrainingJob(scene, given.variant, row, given.size, given.seed, given.iterations, given.downscale)
        teachers, seconds = train_teachers(job, given.data, given.teachers, given.teacher_iterations, size)
        result = run_job(job, given.data, DEFAULT, trainer=partial(student_trainer, teachers=teachers))
        facts = {"count": given.teachers, "iterations": given.teacher_iterations, "max_surfels": size}
        result |= {"teachers": facts | {"seconds": seconds}}
        with given.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(result) + "\n")
        print(result_line(job, result), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
