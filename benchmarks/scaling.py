"""Training on several GPUs: time of a step, of its communication, and how much of that the backward pass hides.

    python -m benchmarks.scaling --ranks 1 2 4 --scene SCENE --surfels 400000
    python -m benchmarks.scaling --ranks 1 2 --scene SCENE --train 30000          # PSNR at equal views seen

Each rank renders one view a step, so that weak scaling (as many views a step as ranks) and strong scaling (a run of
equally many views) are the same measurement: the speed-up is the number of ranks times the efficiency, the time of a
step of one rank divided by that of a step of all.
"""

import dataclasses
import json
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
import warp as wp
from torch import nn

from benchmarks.timing import git_commit, mean_ms, synchronize
from nexwarp.data import Scene, demo_folder, load_scene
from nexwarp.run.evaluate import evaluate
from nexwarp.train.densify import DensityControl, split_surfels
from nexwarp.train.parallel import ParallelTrainer
from nexwarp.train.ranks.ranks import GradientReducer, Ranks, launch
from nexwarp.train.recipe import DEMO_SETTINGS, Config, parse_settings, preset, with_settings
from nexwarp.train.trainer import Trainer

DEMO = "demo"
LATE = 26_000  # an iteration of 30,000 after density control, with SH of degree 3
CHUNKS = 5
VISITS = 4  # untimed steps for each training view


@dataclass(frozen=True)
class Scaling:
    """Measure training on several GPUs."""

    ranks: tuple[int, ...] = (1, 2)
    """Numbers of ranks; each is measured in turn."""
    scene: str = DEMO
    """Folder of a scene, or `demo`."""
    surfels: int = 40_000
    """Number of surfels of the timed steps; largest number of a training."""
    steps: int = 100
    """Timed steps."""
    train: int = 0
    """Train for so many views and evaluate, instead of timing steps."""
    modes: tuple[str, ...] = ("captured", "beside", "eager")
    """How steps run on CUDA: all-reduce inside the CUDA graph, after it, or no graph. A CPU has only `eager`."""
    device: str = "cuda"
    """Device: cuda or cpu."""
    backend: str | None = None
    """Backend of the gradients; default nccl on CUDA, gloo on a CPU or with --share-gpu."""
    share_gpu: bool = False
    """Let all ranks use the first GPU: a check of the program, not of its speed."""
    settings: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="set")] = ()
    """Further settings, KEY=VALUE."""
    worker: bool = False
    """Internal: this process is a rank."""


def main(arguments: list[str] | None = None) -> int:
    command = sys.argv[1:] if arguments is None else arguments
    options = tyro.cli(Scaling, args=command, description=__doc__)
    wp.config.log_level = wp.LOG_ERROR
    if options.worker:
        work(options)
        return 0
    codes = []
    for count in options.ranks:
        print(f"{count} ranks ...", file=sys.stderr, flush=True)
        codes.append(launch(count, ["-m", "benchmarks.scaling", *command, "--worker"]))
    return max(codes)


def work(options: Scaling) -> None:
    """Measure as one of several ranks; rank 0 prints a line of JSON for each mode."""
    import os

    local = 0 if options.share_gpu else int(os.environ["LOCAL_RANK"])
    device = torch.device("cuda", local) if options.device == "cuda" else torch.device("cpu")
    if device.type == "cuda":
        torch.cuda.set_device(device)
        wp.set_device(f"cuda:{local}")
    backend = options.backend or ("gloo" if options.share_gpu else None)
    with Ranks.join(device, backend=backend) as ranks:
        folder = demo_folder() if options.scene == DEMO else options.scene
        scene = load_scene(folder)
        for mode in options.modes if device.type == "cuda" else ("eager",):
            if mode == "captured" and ranks.backend != "nccl":
                continue
            figures = trained(options, scene, mode, ranks) if options.train else timed(options, scene, mode, ranks)
            facts = {
                "ranks": ranks.size,
                "mode": mode,
                "backend": ranks.backend,
                "scene": Path(options.scene).name,
                "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
                "commit": git_commit(),
            }
            if ranks.first:
                print(json.dumps(facts | figures), flush=True)


def make_trainer(options: Scaling, scene: Scene, mode: str, ranks: Ranks) -> Trainer:
    """Return a trainer; a single rank has that of `nexwarp train`."""
    config = with_settings(preset("default"), DEMO_SETTINGS) if options.scene == DEMO else preset("default")
    config = dataclasses.replace(config, max_surfels=options.surfels, cuda_graphs=mode != "eager")
    if options.train:
        config = dataclasses.replace(config, iterations=options.train)
    config = with_settings(config, parse_settings(options.settings))
    if ranks.size == 1:
        return Trainer(scene, config, ranks.device)
    return ParallelTrainer(scene, config, ranks.device, ranks, beside=mode == "beside")


def trained(options: Scaling, scene: Scene, mode: str, ranks: Ranks) -> dict[str, object]:
    """Train and evaluate."""
    trainer = make_trainer(options, scene, mode, ranks)
    trainer.run()
    # All ranks finish, alike on a CPU; each uses its own result for its share of the test views.
    results = evaluate(trainer.finish(), scene.test, ranks=ranks)
    return {
        "views": trainer.iteration,
        "surfels": len(trainer.surfels),
        "psnr": round(results["psnr"], 3),
        "ssim": round(results["ssim"], 5),
        "seconds": round(trainer.seconds, 2),
        "views_per_second": round(trainer.iteration / trainer.seconds, 1),
    }


def timed(options: Scaling, scene: Scene, mode: str, ranks: Ranks) -> dict[str, object]:
    """Time steps, the same steps without communication, and the communication alone."""
    trainer = make_trainer(options, scene, mode, ranks)
    config: Config = trainer.config
    while (count := len(trainer.surfels)) < options.surfels:
        chosen = torch.arange(min(count, options.surfels - count), device=ranks.device)
        rows = torch.cat([torch.arange(count, device=ranks.device), chosen])
        sides = torch.zeros_like(rows)
        sides[chosen], sides[count:] = -1, 1
        split_surfels(trainer.surfels, trainer.optimizer, rows, sides)
    trainer.densifier = DensityControl(trainer.surfels, config)
    trainer.iteration = round(LATE / 30_000 * config.iterations)
    # First steps are slower: graphs are captured, and a rank prepares each view when it first renders it.
    for _ in range(VISITS * len(scene.train)):
        trainer.step()
    figures: dict[str, object] = {"surfels": len(trainer.surfels), "step_ms": step_ms(trainer, options.steps)}
    if isinstance(trainer, ParallelTrainer):
        figures["bytes"] = trainer.reducer.bytes_sent
        figures["communication_ms"] = communication_ms(trainer, options.steps)
        with silent(trainer):
            figures["step_without_communication_ms"] = step_ms(trainer, options.steps)
        exposed = float(str(figures["step_ms"])) - float(str(figures["step_without_communication_ms"]))
        figures["hidden_share"] = round(1 - exposed / float(str(figures["communication_ms"])), 3)
    figures["views_per_second"] = round(1000 * ranks.size / float(str(figures["step_ms"])), 1)
    return figures


def step_ms(trainer: Trainer, steps: int) -> float:
    """Return the median over chunks of the mean time of a step."""
    times = []
    for chunk in range(CHUNKS + 1):  # the first one captures graphs
        synchronize(trainer.device)
        if isinstance(trainer, ParallelTrainer):
            trainer.ranks.barrier()
        elapsed = mean_ms(trainer.step, max(steps // CHUNKS, 1), trainer.device)
        if chunk:
            times.append(elapsed)
    return round(statistics.median(times), 4)


def communication_ms(trainer: ParallelTrainer, repeats: int) -> float:
    """Return the median time of the all-reduce of a step's gradients, with nothing else running."""
    parameters = [x for group in trainer.optimizer.param_groups for x in group["params"]]
    times = []
    for _ in range(3 + min(repeats, 30)):
        for parameter in parameters:
            parameter.grad = torch.zeros_like(parameter)
        synchronize(trainer.device)
        trainer.ranks.barrier()
        start = time.perf_counter()
        trainer.reducer.finish(parameters, trainer.densifier.errors)
        synchronize(trainer.device)
        times.append(time.perf_counter() - start)
    trainer.optimizer.zero_grad(set_to_none=True)
    return round(1000 * statistics.median(times[3:]), 4)


class SilentReducer(GradientReducer):
    """Keeps each rank's gradients as they are."""

    def __init__(self) -> None:
        super().__init__(None)

    def finish(self, parameters: Sequence[nn.Parameter], sums: torch.Tensor | None) -> torch.Tensor | None:
        """Return the sums."""
        return sums


@contextmanager
def silent(trainer: ParallelTrainer) -> Iterator[None]:
    """Let a trainer's steps send nothing; its replicas are no longer the same."""
    before, trainer.reducer = trainer.reducer, SilentReducer()
    overlapped, before.overlapped = before.overlapped, False
    if trainer.graphs is not None:
        trainer.graphs.clear()
    yield
    trainer.reducer, before.overlapped = before, overlapped
    if trainer.graphs is not None:
        trainer.graphs.clear()


if __name__ == "__main__":
    sys.exit(main())
