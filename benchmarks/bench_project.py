"""Plain colours and projection, a thread a surfel each."""

import sys

import torch

from benchmarks import suite
from benchmarks.scenes import SurfelScene, geometry, random_like, workload
from benchmarks.suite import Options
from benchmarks.timing import Measurement
from nexwarp import ops


def run(options: Options) -> list[Measurement]:
    return [m for scene in workload(options) for m in (*plain_colors(scene, options), *project(scene, options))]


def plain_colors(scene: SurfelScene, options: Options) -> list[Measurement]:
    """SH of degree 3 of every surfel."""
    s = scene.surfels
    sh0, shN, means = leaves = [x.detach().clone().requires_grad_() for x in (s.sh0, s.shN, s.means)]
    position = scene.camera.position
    colors = ops.plain_colors((sh0, shN), means, position, 3)
    (signal,) = random_like((colors,))
    return [
        options.time("plain colours, forward", lambda: ops.plain_colors((sh0, shN), means, position, 3), **scene.facts),
        options.time(
            "plain colours, backward",
            lambda: torch.autograd.grad(colors, leaves, signal, retain_graph=True),
            **scene.facts,
        ),
    ]


def project(scene: SurfelScene, options: Options) -> list[Measurement]:
    g = geometry(scene)
    records = g.project().records
    (signal,) = random_like((records,))
    return [
        options.time("project, forward", g.project, **scene.facts),
        options.time(
            "project, backward",
            lambda: torch.autograd.grad(records, g.leaves, signal, retain_graph=True),
            **scene.facts,
        ),
    ]


if __name__ == "__main__":
    sys.exit(suite.main({"project": run}))
