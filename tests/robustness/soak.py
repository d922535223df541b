"""Searches for memory leaks: renders many frames of the demo and trains many small steps on it.

    python -m tests.robustness.soak --device cuda --frames 5000 --steps 20000

prints the memory of the GPU and of the host, and compares its mean over the first thousand frames (and steps) after a
warm-up with that over the last thousand. The exit code is 1 unless each pair agrees within 1 %.
"""

import dataclasses
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import psutil
import torch
import tyro
import warp as wp

import nexwarp as nw
from nexwarp.data import Scene, write_demo
from nexwarp.machine import keep_freed_memory
from nexwarp.model.buffers import render_buffers
from nexwarp.train.config import Config, TextureConfig
from nexwarp.train.densify import DensifyConfig
from nexwarp.train.report import StepReport
from nexwarp.train.trainer import Trainer

MIB = 2**20
WARMUP, WINDOW = 500, 1000
TOLERANCE = 0.01
SLACK = MIB // 4  # bytes that a change may always have: memory grows by pages and segments
SAMPLES = 500  # of memory in a phase: each takes time on a GPU
ROWS = 8  # of the table
EVERYONES = "all processes"  # printed, but not judged: other processes change it
SIZES = ((1.0, 0.75), (0.67, 0.5), (0.34, 0.73), (0.84, 0.26), (0.5, 0.5), (1.0, 0.18), (0.17, 0.17))  # of the width
CYCLE = 84  # different cameras; the warm-up renders all of them
# Many small steps.
SMALL = Config(
    sh_every=1,
    texture=TextureConfig(levels=8, table_size=2**13, width=32),
    # The budget is reached within the warm-up. Pruning lets rounds add surfels until the end.
    densify=DensifyConfig(start=0, stop=60_000, every=30, fraction=1.0, prune_opacity=0.02),
)

MemorySample = tuple[int, dict[str, int]]


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
    def change(self) -> float:
        """Relative change; 0 where both are 0."""
        return (self.last - self.first) / self.first if self.first else float(self.last > 0)

    @property
    def flat(self) -> bool:
        """Whether first and last agree within `TOLERANCE`, or within `SLACK`."""
        return abs(self.last - self.first) <= max(TOLERANCE * self.first, SLACK)


def spans(count: int) -> tuple[range, range]:
    """Return the first and last thousand of `count` frames or steps (from 1) after a warm-up; fewer of a few."""
    warmup = min(WARMUP, count // 4)
    window = max(min(WINDOW, (count - warmup) // 2), 1)
    return range(warmup + 1, warmup + window + 1), range(count - window + 1, count + 1)


def judge(samples: Sequence[MemorySample], count: int) -> list[Verdict]:
    """Compare the memory at the beginning and at the end.

    Args:
        samples: frame or step, from 1, and bytes by kind of memory.
        count: how many frames or steps there were.

    Raises:
        ValueError: there is no sample in the first or in the last span.
    """
    chosen = [[memory for number, memory in samples if number in span] for span in spans(count)]
    if not all(chosen):
        raise ValueError(f"samples: expected some in {spans(count)}, got {[number for number, _ in samples]}")
    names = samples[0][1]
    first, last = ({name: sum(x[name] for x in part) / len(part) for name in names} for part in chosen)
    return [Verdict(name, first[name], last[name]) for name in names if name != EVERYONES]


def memory(device: torch.device) -> dict[str, int]:
    """Return the bytes of host and GPU memory of this process, and the GPU memory of all processes."""
    found = {"host": psutil.Process().memory_info().rss}
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        found["torch allocated"] = torch.cuda.memory_allocated(device)
        found["torch reserved"] = torch.cuda.memory_reserved(device)
        place = f"cuda:{torch.cuda.current_device() if device.index is None else device.index}"
        if wp.is_mempool_supported(place):
            found["Warp's pool"] = wp.get_mempool_used_mem_current(place)
        found[EVERYONES] = total - free
    return found


def phase(name: str, count: int, samples: Sequence[MemorySample]) -> bool:
    """Print the table of a phase and its verdicts; returns whether all are flat."""
    kinds = list(samples[0][1])
    print(f"{name}: MiB after so many")
    print("".join(f"{title:>17}" for title in ("", *kinds)))
    shown = sorted({round(i * (len(samples) - 1) / (ROWS - 1)) for i in range(ROWS)})
    for number, found in (samples[i] for i in shown):
        print(f"{number:17,}" + "".join(f"{found[kind] / MIB:17,.2f}" for kind in kinds))
    verdicts = judge(samples, count)
    first, last = spans(count)
    told = f"{first.start:,} to {first.stop - 1:,} and {last.start:,} to {last.stop - 1:,}"
    for v in verdicts:
        print(
            f"{name}, {v.name}: {v.first / MIB:,.2f} and {v.last / MIB:,.2f} MiB in {told}, "
            f"{100 * v.change:+.2f} %: {'flat' if v.flat else 'NOT FLAT'}"
        )
    print(flush=True)
    return all(v.flat for v in verdicts)


def cycle(scene: Scene, device: torch.device, seed: int) -> list[nw.Camera]:
    """Crops of the scene's cameras, of changing sizes and places, some beyond the frame."""
    generator = torch.Generator().manual_seed(seed)
    cameras = [view.camera.to(device) for view in scene.train]
    made = []
    for i in range(CYCLE):
        camera = cameras[i % len(cameras)]
        width, height = (round(camera.width * share) for share in SIZES[i % len(SIZES)])
        left, top = ((torch.rand(2, generator=generator) * 0.4 - 0.1) * camera.width).int().tolist()
        made.append(camera.crop(left, top, width, height))
    return made


def handles() -> dict[str, int]:
    """Return the number of open files and of threads of this process."""
    process = psutil.Process()
    return {"open files": process.num_fds(), "threads": process.num_threads()}


def library_calls(
    file: Path, cameras: Sequence[nw.Camera], count: int, sample: Callable[[int], None], device: torch.device
) -> None:
    """Load a model and render it, `count` times: in turns with gradients, without them, and with all buffers.

    Args:
        file: model file.
        cameras: of changing sizes, taken in turns.
        count: how often.
        sample: called after each, with its number from 1.
        device: where to render.
    """
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


def render_frames(trainer: Trainer, cameras: Sequence[nw.Camera], count: int, sample: Callable[[int], None]) -> None:
    """Render the trainer's finished model `count` times, as the viewer does."""
    model = trainer.finish()
    for i in range(count):
        with torch.no_grad():
            out = model.render(cameras[i % len(cameras)])
        del out
        sample(i + 1)


@dataclass
class Soak:
    """Render and train for long, and check that memory stays constant."""

    device: Annotated[str, tyro.conf.arg(metavar="{cuda,cpu}")] = "cuda"
    """Where."""
    frames: int = 5000
    """Frames to render, from changing cameras and of changing sizes."""
    steps: int = 20_000
    """Training steps, density control included, on small photos of the demo."""
    max_surfels: int = 1500
    """Budget; soon met."""
    width: int = 96
    """Of the photos, and of the largest frames, in pixels."""
    seed: int = 0
    """Of the training and of the cameras."""

    def __call__(self) -> int:
        """Run, print, and return the exit code."""
        wp.config.log_level = wp.LOG_ERROR
        if self.device == "cuda":
            device = torch.device("cuda", torch.cuda.current_device())
        else:
            device = torch.device(self.device)
            keep_freed_memory()
        with tempfile.TemporaryDirectory() as folder:
            scene = nw.load_scene(
                write_demo(Path(folder) / "demo", self.width, self.width * 3 // 4, 16, self.max_surfels)
            )
        config = dataclasses.replace(SMALL, iterations=max(self.steps, 1), max_surfels=self.max_surfels, seed=self.seed)
        trainer = Trainer(scene, config, device)
        flat = True
        if self.steps:
            samples, least, most = self._train(trainer, device)
            rounds = sum(trainer.densifier.due(i) for i in range(1, self.steps + 1))
            print(f"{rounds:,} rounds of density control; {least:,} to {most:,} surfels when compared")
            flat &= phase("training steps", self.steps, samples)
        if self.frames:
            samples = []
            render_frames(trainer, cycle(scene, device, self.seed), self.frames, _sampler(samples, self.frames, device))
            flat &= phase("frames", self.frames, samples)
        print("flat: first and last are within 1 % throughout" if flat else "NOT FLAT: memory is not what it was")
        return 0 if flat else 1

    def _train(self, trainer: Trainer, device: torch.device) -> tuple[list[MemorySample], int, int]:
        """Train; return the memory samples, and the least and most surfels in the compared steps."""
        samples: list[MemorySample] = []
        extremes: list[int] = []
        sample, (first, _) = _sampler(samples, self.steps, device), spans(self.steps)

        def observe(step: StepReport) -> None:
            if step.iteration >= first.start:
                extremes[:] = [min([step.surfels, *extremes]), max([step.surfels, *extremes])]
            sample(step.iteration)

        trainer.run(observe)
        least, most = extremes
        return samples, least, most


def _sampler(samples: list[MemorySample], count: int, device: torch.device) -> Callable[[int], None]:
    """Return a function that samples the memory at regular intervals."""
    every = max(count // SAMPLES, 1)

    def sample(number: int) -> None:
        if number % every == 0 or number in (1, count):
            samples.append((number, memory(device)))

    return sample


if __name__ == "__main__":
    sys.exit(tyro.cli(Soak)())
