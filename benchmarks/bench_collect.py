"""Collection: the walk along the tile lists alone, and the whole stage (project, tiles, collect), K = 2."""

import sys

import torch

from benchmarks import suite
from benchmarks.scenes import SurfelScene, entries, geometry, outputs, random_like, workload
from benchmarks.suite import Options
from benchmarks.timing import Measurement
from nexwarp import ops


def run(options: Options) -> list[Measurement]:
    return [m for scene in workload(options) for m in (*walk(scene, options), *stage(scene, options))]


def walk(scene: SurfelScene, options: Options, max_hits: int = 2) -> list[Measurement]:
    """The pass alone, given projection and tile lists."""
    g = geometry(scene)
    with torch.no_grad():
        projection = g.project()
    records = projection.records.requires_grad_()
    tiles = g.tiles(projection)
    hits = ops.collect(projection, tiles, g.pinhole, max_hits=max_hits)
    signals = random_like(outputs(hits))
    facts = scene.facts
    facts["sizes"] |= {"entries": entries(tiles), "max_hits": max_hits}
    return [
        options.time("collect, forward", lambda: ops.collect(projection, tiles, g.pinhole, max_hits=max_hits), **facts),
        options.time(
            "collect, backward",
            lambda: torch.autograd.grad(outputs(hits), records, signals, retain_graph=True),
            **facts,
        ),
    ]


def stage(scene: SurfelScene, options: Options, max_hits: int = 2) -> list[Measurement]:
    """Activated surfels to hits, and back."""
    g = geometry(scene)
    with torch.no_grad():
        signals = random_like(outputs(g.hits(max_hits)))
        forward = options.time("collection stage, forward", lambda: g.hits(max_hits), **scene.facts)
    both = options.time(
        "collection stage, forward + backward",
        lambda: torch.autograd.grad(outputs(g.hits(max_hits)), g.leaves, signals),
        **scene.facts,
    )
    return [forward, both]


if __name__ == "__main__":
    sys.exit(suite.main({"collect": run}))
