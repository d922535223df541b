"""Texturing of an image's hits, K = 2: hash lookup, MLP, SH and composition."""

import sys

import torch

from benchmarks import suite
from benchmarks.scenes import SurfelScene, geometry, random_like, texture, workload
from benchmarks.suite import Options
from benchmarks.timing import Measurement
from nexwarp import ops


def run(options: Options) -> list[Measurement]:
    return [m for scene in workload(options) for m in texturing(scene, options)]


def texturing(scene: SurfelScene, options: Options, max_hits: int = 2) -> list[Measurement]:
    """The hits are those of the scene, so that neighbouring ones lie as near each other as they do in use."""
    field = texture(scene)
    g = geometry(scene)
    with torch.no_grad():
        hits = g.hits(max_hits)
        positions, directions = ops.unproject(hits.depths, g.viewmat, g.pinhole)
        background = torch.zeros(3, device=options.device)
    depths = hits.depths.requires_grad_()
    positions.requires_grad_()
    focal = scene.camera.focal

    def forward() -> torch.Tensor:
        colors = field.colors(positions, depths, directions, focal)
        return ops.compose(hits.plain, colors, hits.weights, hits.alpha, background)[0]

    facts = scene.facts
    facts["sizes"] |= {"slots": hits.ids.numel(), "hits": int((hits.ids >= 0).sum())}
    facts["sizes"]["table_size"] = field.config["table_size"]
    with torch.no_grad():
        (signal,) = random_like((forward(),))
        without = options.time("texturing, forward", forward, **facts)
    leaves = [positions, depths, *field.parameters()]
    both = options.time(
        "texturing, forward + backward", lambda: torch.autograd.grad(forward(), leaves, signal), **facts
    )
    return [without, both]


if __name__ == "__main__":
    sys.exit(suite.main({"texture": run}))
