"""A whole frame as a user renders it (`Model.render`, no gradients): time, the GPU's part of it, memory, waits.

Untrained scenes get what a finished model has: a texture of the shipped shape, exposures with a lens that darkens the
corners, and detail limits. Frames go round the scene's cameras, since a user's camera moves.
"""

import itertools
import sys
import time
import warnings
from collections.abc import Callable

import torch
import warp as wp

import nexwarp as nw
from benchmarks import suite
from benchmarks.gpu_time import gpu_time
from benchmarks.scenes import SurfelScene, texture, workload
from benchmarks.suite import Options
from benchmarks.timing import MIB, Measurement, figure, process_memory, synchronize
from nexwarp.model.exposures import Exposures
from nexwarp.train.finish.detail_limits import measure_detail_limits

STEADY_FRAMES = 50
# The shape that `nexwarp train` gives a texture by default.
SHIPPED = {"levels": 8, "features": 4, "residual": True}
FALLOFF = (-0.2, -0.05)  # of the light towards the corners, as a and b of `Exposures`


def run(options: Options) -> list[Measurement]:
    return [m for scene in workload(options) for m in frame(scene, options)]


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
        allocator_growth(render, scene, options),
        *waits(render, scene, options),
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


def allocator_growth(render: Callable[[], torch.Tensor], scene: SurfelScene, options: Options) -> Measurement:
    """Return the growth of memory over 50 more frames: of torch's and Warp's pools, or of the process on a CPU."""
    before = _held(options.device)
    for _ in range(3 if options.quick else STEADY_FRAMES):
        render()
    grown = _held(options.device) - before
    return figure("frame, memory growth", grown, options.device, unit="MiB", **scene.facts)


def waits(render: Callable[[], torch.Tensor], scene: SurfelScene, options: Options) -> list[Measurement]:
    """Return how often torch makes the host wait for the GPU in a frame; Warp's own waits are not counted."""
    if not options.cuda:
        return []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            render()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    count = sum("called a synchronizing" in str(w.message) for w in caught)
    return [figure("frame, waits of the host", count, options.device, unit="a frame", **scene.facts)]


def _held(device: torch.device) -> float:
    if device.type == "cuda":
        synchronize(device)
        return (torch.cuda.memory_reserved(device) + wp.get_mempool_used_mem_current(f"cuda:{device.index or 0}")) / MIB
    return process_memory() or 0.0


if __name__ == "__main__":
    sys.exit(suite.main({"frame": run}))
