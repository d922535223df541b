"""A whole frame as a user renders it (`Model.render`, no gradients): its time and the GPU's part of it.

Untrained scenes get what a finished model has: a texture of the shipped shape, exposures with a lens that darkens the
corners, and detail limits. Frames go round the scene's cameras, since a user's camera moves.
"""

import itertools
import time
from collections.abc import Callable

import torch

import nexwarp as nw
from benchmarks.gpu_time import gpu_time
from benchmarks.scenes import SurfelScene, texture
from benchmarks.suite import Options
from benchmarks.timing import Measurement, figure, synchronize
from nexwarp.model.exposures import Exposures
from nexwarp.train.finish import measure_detail_limits

STEADY_FRAMES = 50
# The shape that `nexwarp train` gives a texture by default.
SHIPPED = {"levels": 8, "features": 4, "residual": True}
FALLOFF = (-0.2, -0.05)  # of the light towards the corners, as a and b of `Exposures`


def frame(scene: SurfelScene, options: Options) -> list[Measurement]:
    model = finished(scene)
    cameras = itertools.cycle(scene.cameras)

    @torch.no_grad()
    def render() -> torch.Tensor:
        return model.render(next(cameras)).image

    return [
        options.time("frame", render, **scene.facts),
        *gpu_part(render, scene, options),
        back_to_back(render, scene, options),
    ]


def gpu_part(render: Callable[[], torch.Tensor], scene: SurfelScene, options: Options) -> list[Measurement]:
    """Return the time in which the GPU works for a frame; the rest of the frame's time is the host's."""
    if not options.cuda:
        return []
    return [figure("frame, GPU's part", gpu_time(render, STEADY_FRAMES)[0], options.device, **scene.facts)]


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


def back_to_back(render: Callable[[], torch.Tensor], scene: SurfelScene, options: Options) -> Measurement:
    """Time frames without a pause between them, as in a video: wall time over their number."""
    count = 3 if options.quick or not options.cuda else STEADY_FRAMES
    synchronize(options.device)
    start = time.perf_counter()
    for _ in range(count):
        render()
    synchronize(options.device)
    elapsed = 1e3 * (time.perf_counter() - start) / count
    return figure(f"frame, of {count} back to back", elapsed, options.device, **scene.facts)
