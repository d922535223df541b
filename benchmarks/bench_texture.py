"""Texturing of an image's hits, K = 2, in the shape that training uses: hash lookup, MLP and SH, with detail limits.

The table's half-precision copy exists, as in training and in frames.
"""

import numpy as np
import torch

import nexwarp as nw
from benchmarks.scenes import SHIPPED, SurfelScene, both_ways, geometry, texture
from benchmarks.suite import Options
from benchmarks.timing import Measurement
from nexwarp import ops
from nexwarp.train.finish import measure_detail_limits


def texturing(scene: SurfelScene, options: Options, max_hits: int = 2) -> list[Measurement]:
    """The hits are those of the scene, so that neighbouring ones lie as near each other as they do in use."""
    field, limits = trained_like(scene)
    field.half_copy()
    g = geometry(scene)
    with torch.no_grad():
        hits = g.hits(max_hits)
        positions, directions = ops.unproject(hits.depths, g.viewmat, g.pinhole)
    focal = scene.camera.focal
    depths = ops.limit_depths(hits.ids, hits.depths, limits.nearest, limits.farthest, focal).requires_grad_()
    positions.requires_grad_()

    def colors() -> torch.Tensor:
        return field.evaluate(positions, depths, directions, focal)

    facts = scene.facts
    facts["sizes"] |= {"slots": hits.ids.numel(), "hits": int((hits.ids >= 0).sum())}
    facts["sizes"] |= {name: field.config[name] for name in ("levels", "features", "table_size", "max_resolution")}
    leaves = [positions, depths, *field.parameters()]
    with torch.no_grad():
        forward = options.time("texturing, forward", colors, **facts)
    run = both_ways(lambda: (colors(),), leaves)
    return [forward, options.time("texturing, forward + backward", run, **facts)]


def trained_like(scene: SurfelScene) -> tuple[nw.NeuralTexture, nw.DetailLimits]:
    """Return a texture and detail limits as training makes them for a scene; a trained scene has its own.

    The finest level's cells are as large as the pixels of nearly all views at the surfels in front of them.
    """
    if isinstance(scene.model.texture, nw.NeuralTexture) and scene.model.detail_limits is not None:
        return scene.model.texture, scene.model.detail_limits
    sizes = []
    for camera in scene.cameras:
        depths = camera.project(scene.surfels.means.detach())[1]
        sizes.append((camera.focal / depths[depths > camera.near]).cpu().numpy())
    finest = float(np.quantile(np.concatenate(sizes), 0.95))
    field = texture(scene, **SHIPPED, min_resolution=finest / 32, max_resolution=finest)
    return field, measure_detail_limits(nw.Model(scene.surfels, field), scene.cameras)
