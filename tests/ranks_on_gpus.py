"""A rank of `test_ranks_on_gpus.py`: trains in every way that a step has, and prints a line of JSON for each.

    python -m torch.distributed.run --nproc-per-node=2 -m tests.ranks_on_gpus SCENE BACKEND ITERATIONS SURFELS

Gradients are summed inside the CUDA graph of a step (captured), after it (beside), or without a graph (eager).
"""

import json
import os
import sys

import torch
import warp as wp

import nexwarp as nw
from nexwarp.data import Scene
from nexwarp.train.parallel import ParallelTrainer
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from tests.ranks_support import digest


def main(folder: str, backend: str, iterations: int, surfels: int) -> None:
    # gloo also lets several ranks have one GPU, NCCL does not.
    local = int(os.environ["LOCAL_RANK"]) if backend == "nccl" else 0
    device = torch.device("cuda", local)
    torch.cuda.set_device(device)
    wp.set_device(f"cuda:{local}")
    scene = nw.load_scene(folder)
    with Ranks.join(device, backend=backend) as ranks:
        for mode in ("eager", "captured", "beside") if backend == "nccl" else ("eager", "beside"):
            trainer = trained(scene, ranks, mode, iterations, surfels)
            told: dict[str, object] = {"mode": mode, "ranks": ranks.size, "digests": ranks.gather(digest(trainer))}
            told |= {
                "surfels": len(trainer.surfels),
                "graphs": _graphs_of(trainer),
                "bytes": trainer.reducer.bytes_sent,
            }
            told |= {"views_per_second": round(trainer.iteration / trainer.seconds, 1)}
            if ranks.first:
                print(json.dumps(told), flush=True)


def trained(scene: Scene, ranks: Ranks, mode: str, iterations: int, surfels: int) -> ParallelTrainer:
    """A training whose steps sum gradients in one of the ways; the trainer itself compares the ranks' parameters."""
    config = Config(
        iterations=iterations,
        max_surfels=surfels,
        texture=TextureConfig(levels=4, table_size=2**12, width=16),
        densify=DensifyConfig(every=3000),  # ten rounds
        deterministic=True,
        cuda_graphs=mode != "eager",
    )
    trainer = ParallelTrainer(scene, config, ranks.device, ranks, beside=mode == "beside")
    trainer.run()
    return trainer


def _graphs_of(trainer: ParallelTrainer) -> int:
    """How many of the trainer's kinds of steps have a graph; less than 0 after a capture that failed."""
    if trainer.graphs is None:
        return 0
    if trainer.graphs.chances < 3:
        return -1
    return sum(stage.captured is not None for stage in trainer.graphs.stages.values())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
