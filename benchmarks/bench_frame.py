"""A whole frame as a user renders it (`Model.render`, no gradients): time, memory growth, waits of the host."""

import sys
import time
import warnings
from collections.abc import Callable

import torch
import warp as wp

import nexwarp as nw
from benchmarks import suite
from benchmarks.scenes import SurfelScene, texture, workload
from benchmarks.suite import Options
from benchmarks.timing import MIB, Measurement, figure, process_memory, synchronize
from nexwarp.finish.detail_limits import measure_detail_limits

STEADY_FRAMES = 50


def run(options: Options) -> list[Measurement]:
    return [m for scene in workload(options) for m in frame(scene, options)]


def frame(scene: SurfelScene, options: Options) -> list[Measurement]:
    model = finished(scene)

    @torch.no_grad()
    def render() -> torch.Tensor:
        return model.render(scene.camera).image

    return [
        options.time("frame", render, **scene.facts),
        back_to_back(render, scene, options),
        allocator_growth(render, scene, options),
        *waits(render, scene, options),
    ]


def finished(scene: SurfelScene) -> nw.Model:
    """Return the scene's model with a texture and detail limits, which a trained model has already."""
    trained = scene.model
    model = nw.Model(trained.surfels, texture(scene), trained.exposures, trained.detail_limits, trained.options)
    if model.detail_limits is None:
        model.detail_limits = measure_detail_limits(model, [scene.camera])
    return model


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
