"""The GPU's time in each kernel of a garden frame (`Model.render`) and of a default training step, by torch's profiler.

A row is the mean of a call; its note tells the share of the call's busy time. Rows of less than half a percent are
left out. Frames and steps are CUDA graphs, as users run them.
"""

import itertools
import re
import sys
from collections.abc import Callable, Iterator
from typing import Any

import torch

from benchmarks import suite
from benchmarks.bench_frame import finished
from benchmarks.bench_train_step import make_trainer
from benchmarks.gpu_time import gpu_time
from benchmarks.scenes import GARDEN, SurfelScene, garden, geometry, outputs
from benchmarks.suite import Options
from benchmarks.timing import Measurement, figure

CALLS = 20
SHOWN = 0.005  # share of a call, at least


def run(options: Options) -> list[Measurement]:
    if not options.cuda:
        return []
    frame_size, step_size = ((20_000, 400, 259),) * 2 if options.quick else ((GARDEN, 1600, 1037), (GARDEN, 1558, 1039))
    frame_scene = garden(*frame_size, options.data).to(options.device)
    results = [*frame(frame_scene, options), *counts(frame_scene, options)]
    del frame_scene
    torch.cuda.empty_cache()
    return results + step(garden(*step_size, options.data), options)


def frame(scene: SurfelScene, options: Options) -> list[Measurement]:
    """Time the kernels of frames that go round the scene's cameras."""
    model, cameras = finished(scene), itertools.cycle(scene.cameras)

    @torch.no_grad()
    def render() -> None:
        model.render(next(cameras))

    return [*kernels("frame", render, scene, options)]


def step(scene: SurfelScene, options: Options) -> list[Measurement]:
    """Time the kernels of training steps in the middle of a run."""
    trainer = make_trainer(scene, options)
    for _ in range(2 * len(scene.cameras) + 3):  # graphs are captured, and each view prepared
        trainer.step()
    return [*kernels("training step", trainer.step, scene, options)]


def kernels(name: str, call: Callable[[], Any], scene: SurfelScene, options: Options) -> Iterator[Measurement]:
    """Yield the busy time of a call, then that of its kernels, the longest first."""
    for _ in range(3):
        call()
    total, found = gpu_time(call, CALLS)
    yield figure(f"{name}, GPU's part", total, options.device, **scene.facts)
    times: dict[str, float] = {}
    for kernel, spent in found.items():
        times[short(kernel)] = times.get(short(kernel), 0.0) + spent
    for kernel, spent in sorted(times.items(), key=lambda item: -item[1]):
        if spent >= SHOWN * total:
            note = f"{100 * spent / total:.1f} % of the call"
            yield figure(f"{name}: {kernel}", spent, options.device, **(scene.facts | {"note": note}))


def short(kernel: str) -> str:
    """Return a kernel's name without hash, namespaces and arguments; of a template, its name and the next one's."""
    if found := re.match(r"(\w+?)_[0-9a-f]{8}_cuda_kernel_(forward|backward)", kernel):
        return f"{found[1]} ({found[2]})" if found[2] == "backward" else found[1]
    plain = re.sub(r"^void ", "", kernel.replace("(anonymous namespace)::", "")).split("(")[0]
    names = [part.split("::")[-1] for part in plain.split("<")]
    return "<".join(names[:2])[:60]


def counts(scene: SurfelScene, options: Options) -> list[Measurement]:
    """Count what floors are reckoned with: list entries, hits that are kept, and surfels in the image."""
    g = geometry(scene)
    with torch.no_grad():
        projection = g.project()
        tiles = g.tiles(projection)
        hits = g.collect(projection, tiles)
    found = {
        "list entries": int(tiles.ends[-1]),
        "surfels with an entry": int((tiles.ends.diff(prepend=tiles.ends.new_zeros(1)) > 0).sum()),
        "hits kept": int((outputs(hits)[2] > 0).sum()),
    }
    return [figure(name, count, options.device, unit="", **scene.facts) for name, count in found.items()]


if __name__ == "__main__":
    sys.exit(suite.main({"kernels": run}))
