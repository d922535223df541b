"""A whole frame as a user renders it (`Model.render`, no gradients): its time and the GPU's part of it.

Untrained scenes get what a finished model has: a texture of the shipped shape, exposures with a lens that darkens the
corners, and detail limits. Frames go round the scene's cameras, since a user's camera moves.
"""

import itertools

import torch

import nexwarp as nw
from benchmarks.scenes import SHIPPED, SurfelScene, texture
from benchmarks.suite import Options
from benchmarks.timing import Measurement, figure, mean_ms
from nexwarp.model.exposures import Exposures
from nexwarp.train.finish import measure_detail_limits

STEADY_FRAMES = 50
FALLOFF = (-0.2, -0.05)  # of the light towards the corners, as a and b of `Exposures`


def frame(scene: SurfelScene, options: Options) -> list[Measurement]:
    model = finished(scene)
    cameras = itertools.cycle(scene.cameras)

    @torch.no_grad()
    def render() -> torch.Tensor:
        return model.render(next(cameras)).image

    measured = [options.time("frame", render, **scene.facts)]
    if options.cuda:
        measured.append(options.gpu_part("frame", render, STEADY_FRAMES, **scene.facts))
    # Without a pause between frames, as in a video.
    count = 3 if options.quick or not options.cuda else STEADY_FRAMES
    elapsed = mean_ms(render, count, options.device)
    return [*measured, figure(f"frame, of {count} back to back", elapsed, options.device, **scene.facts)]


def finished(scene: SurfelScene) -> nw.Model:
    """Return the scene's model with texture, exposures and detail limits, which a trained model has already."""
    trained = scene.model
    exposures = lens_of(scene) if trained.texture is None and trained.exposures is None else trained.exposures
    model = nw.Model(trained.surfels, texture(scene, **SHIPPED), exposures, trained.detail_limits, trained.options)
    if model.detail_limits is None:
        model.detail_limits = measure_detail_limits(model, [scene.camera])
    return model


def lens_of(scene: SurfelScene) -> Exposures:
    """Return exposures of the scene's cameras: seeded gains, and a lens that darkens the corners."""
    gains = 0.05 * torch.randn(len(scene.cameras), 3, generator=torch.Generator().manual_seed(3))
    c = scene.camera
    corner = (c.width / 2 / c.fx) ** 2 + (c.height / 2 / c.fy) ** 2
    return Exposures.of(gains, scene.cameras, (*FALLOFF, corner)).to(scene.surfels.device)
