"""Depths, normals and distortion: the walk on request, beside the collection pass whose lists it takes; K = 2."""

import sys

import torch

from benchmarks import suite
from benchmarks.scenes import SurfelScene, entries, geometry, random_like, workload
from benchmarks.suite import Options
from benchmarks.timing import Measurement
from nexwarp import ops


def run(options: Options) -> list[Measurement]:
    return [m for scene in workload(options) for m in surface(scene, options)]


def surface(scene: SurfelScene, options: Options) -> list[Measurement]:
    g = geometry(scene)
    with torch.no_grad():
        projection = g.project()
    tiles = g.tiles(projection)
    hits = ops.collect(projection, tiles, g.pinhole)
    facts = scene.facts
    facts["sizes"] |= {"entries": entries(tiles)}

    def walk() -> tuple[torch.Tensor, ...]:
        found = ops.surface(projection, tiles, hits, g.pinhole, scene.camera.viewmat)
        return found.expected_depth, found.median_depth, found.blended_normals, found.distortion

    with torch.no_grad():
        forward = options.time("surface, forward", walk, **facts)
    records = projection.records.requires_grad_()
    buffers = walk()
    signals = random_like(buffers)
    backward = options.time(
        "surface, backward", lambda: torch.autograd.grad(buffers, records, signals, retain_graph=True), **facts
    )
    return [forward, backward]


if __name__ == "__main__":
    sys.exit(suite.main({"surface": run}))
