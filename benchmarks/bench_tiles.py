"""Tile lists: depth sort, count, scan, emit, tile sort. Nothing here is differentiable."""

import sys

from benchmarks import suite
from benchmarks.scenes import SurfelScene, entries, geometry, workload
from benchmarks.suite import Options
from benchmarks.timing import Measurement


def run(options: Options) -> list[Measurement]:
    return [m for scene in workload(options) for m in tiles(scene, options)]


def tiles(scene: SurfelScene, options: Options) -> list[Measurement]:
    g = geometry(scene)
    projection = g.project()
    facts = scene.facts
    facts["sizes"]["entries"] = entries(g.tiles(projection))
    return [options.time("tiles", lambda: g.tiles(projection), **facts)]


if __name__ == "__main__":
    sys.exit(suite.main({"tiles": run}))
