"""Distillation: a training that also learns from the renderings of other models, from cameras near the photos'.

Usage: `python -m benchmarks.distillation OUT.jsonl --scenes fox,saharov [--variant inner] [--teachers 3]
[--teacher-iterations 9000] [--share 0.5] [--iterations 30000] [--size 40000] [--seed 0] [--downscale 1] [--data DIR]`.
For each scene, teachers of the same size are trained, then the student. With S the student's seed, the teachers' are
100 S + 1, 100 S + 2 and so on. A line of OUT is one of `benchmarks.quality` and names teachers and share; its seconds
and, but for memory, all other figures are the student's.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from benchmarks.quality.jobs import ITERATIONS, SIZE, TrainingJob, config_of
from benchmarks.quality.results import result_line
from benchmarks.quality.rows import DEFAULT
from benchmarks.quality.run import run_job
from benchmarks.quality.scenes import VARIANTS, scene_of
from benchmarks.timing import ROOT
from nexwarp import Camera, Config, Model, Scene, Trainer
from nexwarp.cameras.between import between
from nexwarp.train.target import Target


class Student(Trainer):
    """A training in which a share of the steps compare with renderings of teachers instead of photos.

    Each of these steps renders one teacher, drawn at random, at the photos' mean exposure, from a camera on the line
    through two training cameras (`between`). So the student regresses to the mean of the teachers, whose errors differ.
    Its random numbers are not part of checkpoints.
    """

    def __init__(
        self, scene: Scene, config: Config, device: torch.device, *, teachers: Sequence[Model], share: float
    ) -> None:
        """Make a student.

        Args:
            scene: what to learn from.
            config: settings.
            device: of the training and the teachers.
            teachers: one trained model of the scene or more.
            share: of the steps that learn from teachers, 0 to 1.

        Raises:
            ValueError: no teachers, the share is out of range, or poses are learned.
        """
        check_distillation(len(teachers), share)
        super().__init__(scene, config, device)
        if self.poses is not None:
            raise ValueError("config: expected fixed poses and sharp photos, got refine_poses or blur_poses")
        self.teachers, self.share = teachers, share
        self.chance = torch.Generator().manual_seed(config.seed)
        self.upcoming: list[tuple[int, Camera]] = []

    def _next_target(self) -> Target:
        if float(torch.rand((), generator=self.chance)) >= self.share:
            return super()._next_target()
        self.iteration += 1
        index, between_photos = self._next_camera()
        target = self.targets.make(index, self.iteration, [])
        plain = target.camera
        camera = Camera(between_photos.viewmat.to(self.device), plain.K, plain.width, plain.height, plain.near)
        teacher = self.teachers[int(torch.randint(len(self.teachers), (), generator=self.chance))]
        with torch.no_grad():
            image = teacher.render(camera, background=target.background, exposure="mean").image.clone()
        # Gains of 1 and depths of 0, which stand for no point: without masks, photos' steps have the same CUDA graph.
        exposure = None if target.exposure is None else torch.ones_like(target.exposure)
        depths = None if target.expected is None else torch.zeros_like(target.expected)
        return dataclasses.replace(
            target, camera=camera, photo=image, exposure=exposure, expected=depths, counts=None, empty=None
        )

    def _next_camera(self) -> tuple[int, Camera]:
        """Return a training view's index and a camera near its own; each view's turn comes once in a round."""
        if not self.upcoming:
            cameras = between([view.camera for view in self.scene.train], self.chance)
            order = torch.randperm(len(cameras), generator=self.chance).tolist()
            self.upcoming = [(index, cameras[index]) for index in order]
        return self.upcoming.pop()


def check_distillation(teachers: int, share: float) -> None:
    """Raise ValueError for no teachers, or a share that is not one."""
    if teachers < 1:
        raise ValueError(f"teachers: expected at least one, got {teachers}")
    if not 0 <= share <= 1:
        raise ValueError(f"share: expected a number from 0 to 1, got {share}")


def train_teachers(job: TrainingJob, data: Path, count: int, iterations: int) -> tuple[list[Model], float]:
    """Train models with seeds of their own.

    Args:
        job: the student's; with its seed S, the teachers' are 100 S + 1 to 100 S + count.
        data: folder of the scenes.
        count: how many.
        iterations: of each.

    Returns:
        The models, and the seconds from the loaded scene to the last finished model.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    scene, teachers, begin = scene_of(job, data), [], time.perf_counter()
    for number in range(1, count + 1):
        one = dataclasses.replace(job, seed=100 * job.seed + number, iterations=iterations)
        trainer = Trainer(scene, config_of(one, DEFAULT), device)
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
    add("--teachers", type=int, default=3, help="default: %(default)s")
    add("--teacher-iterations", type=int, default=9000, help="of each teacher (default: %(default)s)")
    add("--share", type=float, default=0.5, help="of the student's steps (default: %(default)s)")
    add("--iterations", type=int, default=ITERATIONS, help="of the student (default: %(default)s)")
    add("--size", type=int, default=SIZE, help="budget of primitives (default: %(default)s)")
    add("--seed", type=int, default=0, help="of the student (default: %(default)s)")
    add("--downscale", type=int, default=1, help="reduce photos by (default: %(default)s)")
    add("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the scenes")
    given = parser.parse_args(arguments)
    check_distillation(given.teachers, given.share)
    for scene in given.scenes.split(","):
        row = f"{given.teachers} teachers of {given.teacher_iterations}, {given.share:g}"
        job = TrainingJob(scene, given.variant, row, given.size, given.seed, given.iterations, given.downscale)
        teachers, seconds = train_teachers(job, given.data, given.teachers, given.teacher_iterations)
        result = run_job(job, given.data, DEFAULT, trainer=partial(Student, teachers=teachers, share=given.share))
        learned = {"count": given.teachers, "iterations": given.teacher_iterations, "seconds": seconds}
        result |= {"teachers": learned, "share": given.share}
        with given.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(result) + "\n")
        print(result_line(job, result), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
