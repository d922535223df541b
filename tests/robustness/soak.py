"""Searches for memory leaks: renders many frames of a small scene and trains many small steps on it.

    python -m tests.robustness.soak --device cuda --frames 5000 --steps 20000

compares the memory of GPU and host over the first thousand frames (and steps) after a warm-up with that over the last
thousand. The exit code is 1 unless each pair agrees within 1 %.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil
import torch
import warp as wp

import nexwarp as nw
from nexwarp.data import Scene
from nexwarp.machine import keep_freed_memory
from nexwarp.model.buffers import render_buffers
from nexwarp.run.warmup import tiny_scene
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from nexwarp.train.trainer import Trainer

MIB = 2**20
WARMUP, WINDOW = 500, 1000
TOLERANCE = 0.01
SLACK = MIB // 4  # bytes that a change may always have: memory grows by pages and segments
SAMPLES = 500  # of memory in a phase: each takes time on a GPU
SIZES = ((1.0, 0.75), (0.67, 0.5), (0.34, 0.73), (0.84, 0.26), (0.5, 0.5), (1.0, 0.18), (0.17, 0.17))  # of the width
CYCLE = 84  # different cameras; the warm-up renders all of them

Sample = tuple[int, dict[str, int]]  # frame or step from 1, and bytes by kind of memory


def small_config(steps: int) -> Config:
    """Settings of many small steps: the budget is reached within the warm-up, and rounds add surfels until the end."""
    return Config(
        iterations=max(steps, 1),
        max_surfels=400,
        sh_every=1,
        texture=TextureConfig(levels=8, table_size=2**13, width=32),
        densify=DensifyConfig(start=0, stop=60_000, every=30, fraction=1.0, prune_opacity=0.02),
    )


@dataclass(frozen=True)
class Verdict:
    """One kind of memory in one phase.

    Attributes:
        name: of the memory.
        first: mean over the first frames or steps after the warm-up, in bytes.
        last: mean over the last ones, in bytes.
    """

    name: str
    first: float
    last: float

    @property
    def flat(self) -> bool:
        """Whether first and last agree within `TOLERANCE`, or within `SLACK`."""
        return abs(self.last - self.first) <= max(TOLERANCE * self.first, SLACK)

    def __str__(self) -> str:
        return (
            f"{self.name}: {self.first / MIB:,.2f}, {self.last / MIB:,.2f} MiB: {'flat' if self.flat else 'NOT FLAT'}"
        )


def spans(count: int) -> tuple[range, range]:
    """Return the first and last thousand of `count` frames or steps (from 1) after a warm-up; fewer of a few."""
    warmup = min(WARMUP, count // 4)
    window = max(min(WINDOW, (count - warmup) // 2), 1)
    return range(warmup + 1, warmup + window + 1), range(count - window + 1, count + 1)


def judge(samples: Sequence[Sample], count: int) -> list[Verdict]:
    """Compare the memory at the beginning of so many frames or steps with that at their end."""
    first, last = ([kinds for number, kinds in samples if number in span] for span in spans(count))
    if not first or not last:
        raise ValueError(f"samples: expected some in {spans(count)}, got {[number for number, _ in samples]}")
    means = [{name: sum(kinds[name] for kinds in part) / len(part) for name in part[0]} for part in (first, last)]
    return [Verdict(name, means[0][name], means[1][name]) for name in means[0]]


def memory(device: torch.device) -> dict[str, int]:
    """Return the bytes of host and GPU memory of this process."""
    kinds = {"host": psutil.Process().memory_info().rss}
    if device.type == "cuda":
        kinds["torch allocated"] = torch.cuda.memory_allocated(device)
        kinds["torch reserved"] = torch.cuda.memory_reserved(device)
        kinds["Warp's pool"] = wp.get_mempool_used_mem_current(f"cuda:{torch.cuda.current_device()}")
    return kinds


def handles() -> dict[str, int]:
    """Return the number of open files and of threads of this process."""
    process = psutil.Process()
    return {"open files": process.num_fds(), "threads": process.num_threads()}


def cycle(scene: Scene, device: torch.device) -> list[nw.Camera]:
    """Crops of the scene's cameras, of changing sizes and places, some beyond the frame."""
    generator = torch.Generator().manual_seed(0)
    cameras = [view.camera.to(device) for view in scene.train]
    made = []
    for i in range(CYCLE):
        camera = cameras[i % len(cameras)]
        width, height = (max(round(camera.width * share), 1) for share in SIZES[i % len(SIZES)])
        left, top = ((torch.rand(2, generator=generator) * 0.4 - 0.1) * camera.width).int().tolist()
        made.append(camera.crop(left, top, width, height))
    return made


def library_calls(
    file: Path, cameras: Sequence[nw.Camera], count: int, sample: Callable[[int], None], device: torch.device
) -> None:
    """Load a model and render it, `count` times: in turns with gradients, without them, and with all buffers."""
    for i in range(count):
        model, camera = nw.load(file).to(device), cameras[i % len(cameras)]
        if i % 3 == 0:
            model.render(camera).image.square().sum().backward()
        elif i % 3 == 1:
            with torch.inference_mode():
                model.render(camera)
        else:
            render_buffers(model, camera)
        sample(i + 1)


def soak(device: torch.device, frames: int, steps: int) -> bool:
    """Train and render for long; print the verdicts, and return whether memory stays constant."""
    scene = tiny_scene()
    trainer = Trainer(scene, small_config(steps), device)
    samples = Sampler(steps, device)
    trainer.run(lambda step: samples(step.iteration))
    verdicts = [("steps", verdict) for verdict in judge(samples.taken, steps)]
    model, cameras, samples = trainer.finish(), cycle(scene, device), Sampler(frames, device)
    for i in range(frames):
        with torch.no_grad():
            model.render(cameras[i % len(cameras)])
        samples(i + 1)
    verdicts += [("frames", verdict) for verdict in judge(samples.taken, frames)]
    for phase, verdict in verdicts:
        print(f"{phase}, {verdict}", flush=True)
    return all(verdict.flat for _, verdict in verdicts)


class Sampler:
    """Samples the memory at regular intervals of `count` frames or steps."""

    def __init__(self, count: int, device: torch.device) -> None:
        self.every, self.count, self.device = max(count // SAMPLES, 1), count, device
        self.taken: list[Sample] = []

    def __call__(self, number: int) -> None:
        if number % self.every == 0 or number in (1, self.count):
            self.taken.append((number, memory(self.device)))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.robustness.soak", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--frames", type=int, default=5000, help="from changing cameras and of changing sizes")
    parser.add_argument("--steps", type=int, default=20_000, help="of training, density control included")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    if options.device == "cpu":
        keep_freed_memory()
    return 0 if soak(torch.device(options.device), options.frames, options.steps) else 1


if __name__ == "__main__":
    sys.exit(main())
