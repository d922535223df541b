"""Time and memory of a frame, and of a frame + backward, over the number of surfels, of pixels, and over K.

One size changes at a time. The note of each row is the cost of the step from the next smaller size. A step that costs
more than its share is marked as a cliff.
"""

import sys
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

import nexwarp as nw
from benchmarks import suite
from benchmarks.scenes import SurfelScene, cloud, random_like, texture
from benchmarks.suite import Options
from benchmarks.timing import Measurement, figure

ASPECT = 1.543
# A step may cost this much more than its share: medians of short runs vary.
SLACK = 1.25
CLIFF = " CLIFF"


class Point(NamedTuple):
    """A size to measure at."""

    surfels: int
    megapixels: float
    hits: int


@dataclass(frozen=True)
class Sweep:
    """Sizes to measure at: one sweep for each field of `base`, the other fields as in `base`.

    Attributes:
        base: the size that all sweeps contain.
        surfels, megapixels, hits: the values of each sweep; that of `base` is added.
        table_size: of the texture.
        limit: a step that would make a frame and its backward longer than this, in seconds, is left out.
        repeats: how `timing.measure` repeats.
    """

    base: Point
    surfels: tuple[int, ...]
    megapixels: tuple[float, ...]
    hits: tuple[int, ...]
    table_size: int
    limit: float
    repeats: dict[str, float]

    def along(self, axis: str) -> list[Point]:
        """Points of one sweep, small to large."""
        values = {getattr(self.base, axis), *getattr(self, axis)}
        return [self.base._replace(**{axis: value}) for value in sorted(values)]


SURFELS = (10_000, 20_000, 40_000, 100_000, 200_000, 400_000, 1_000_000, 2_000_000, 4_000_000)
MEGAPIXELS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
HITS = (0, 1, 2, 4, 8)
CUDA = Sweep(Point(400_000, 2.0, 2), SURFELS, MEGAPIXELS, HITS, 2**20, 2.0, {"seconds": 0.4})
CPU = Sweep(
    Point(10_000, 0.0625, 2),
    SURFELS,
    (0.03125, 0.0625, 0.125, *MEGAPIXELS),
    HITS,
    2**15,
    3.0,
    {"seconds": 0.5, "warmup": 1, "least": 3},
)
QUICK = Sweep(Point(500, 0.003, 2), (1_000,), (0.006,), (0,), 2**15, 10.0, {})


def run(options: Options) -> list[Measurement]:
    """Run the sweeps; that with the largest memory comes last, since Warp's high-water mark never falls."""
    sweep = QUICK if options.quick else CUDA if options.cuda else CPU
    results = [m for axis in ("hits", "megapixels", "surfels") for m in along(axis, sweep, options)]
    steps = [m for m in results if " for x" in m.note]
    cliffs = sum(CLIFF in m.note for m in steps)
    name = f"steps that cost over {SLACK} times their share"
    return [*results, figure(name, cliffs, options.device, unit="steps", scene="sizes", note=f"of {len(steps)}")]


def along(axis: str, sweep: Sweep, options: Options) -> list[Measurement]:
    """Measure along one axis until memory or time run out; measure the base again, beside its neighbours."""
    found: list[list[Measurement]] = []
    points = sweep.along(axis)
    scene = None
    for i, point in enumerate(points):
        step = share(axis, points[i - 1], point) if i else None
        if step and found[-1][-1].median / 1e3 * step > sweep.limit:
            found[-1][-1] = left_out(found[-1][-1], axis, points[i:], "too slow")
            break
        try:
            scene = scene_at(point, scene, sweep, options)
            rows = [replace(m, name=f"{m.name}, by {axis}") for m in at_size(scene, point.hits, sweep, options)]
        except (MemoryError, torch.OutOfMemoryError):
            if not found:
                raise
            found[-1][-1] = left_out(found[-1][-1], axis, points[i:], "out of memory")
            break
        if found:
            rows = [replace(m, note=growth(before, m, step)) for before, m in zip(found[-1], rows, strict=True)]
        found.append(rows)
    del scene
    if options.cuda:
        torch.cuda.empty_cache()
    return [m for rows in found for m in rows]


def share(axis: str, before: Point, after: Point) -> float | None:
    """Return the largest factor that a step's work may grow by; None from K = 0, which has no texture."""
    return getattr(after, axis) / getattr(before, axis) if getattr(before, axis) else None


def growth(before: Measurement, after: Measurement, step: float | None) -> str:
    """Return a note: the factors of a step in time and memory, beside its share of the work."""
    ratios = {"time": after.median / before.median}
    if before.peak_mib and after.peak_mib:
        ratios["memory"] = after.peak_mib / before.peak_mib
    costs = [
        f"{name} x{ratio:.2f}" + CLIFF * (step is not None and ratio > SLACK * step) for name, ratio in ratios.items()
    ]
    return ", ".join(costs) + (f" for x{step:.2f}" if step else "")


def left_out(last: Measurement, axis: str, points: list[Point], reason: str) -> Measurement:
    """Return the last measured row with a note on the sizes that were left out."""
    note = f"left out, {reason}: {axis} {', '.join(f'{getattr(point, axis):,}' for point in points)}"
    return replace(last, note="; ".join(filter(None, (last.note, note))))


def scene_at(point: Point, before: SurfelScene | None, sweep: Sweep, options: Options) -> SurfelScene:
    """Make a cloud and its texture, or keep the ones before and change the image's size."""
    height = round((1e6 * point.megapixels / ASPECT) ** 0.5)
    width = round(ASPECT * height)
    if before is None or len(before.surfels) != point.surfels:
        made = cloud(point.surfels, width, height).to(options.device)
        return replace(made, model=nw.Model(made.surfels, texture(made, table_size=sweep.table_size)))
    seen = cloud(1, width, height).to(options.device)
    return replace(before, name=f"cloud {point.surfels:,} at {width}x{height}", cameras=seen.cameras)


def at_size(scene: SurfelScene, hits: int, sweep: Sweep, options: Options) -> list[Measurement]:
    field = texture(scene) if hits else None
    leaves = [*scene.surfels.parameters(), *(field.parameters() if field else ())]

    def render() -> nw.Rendering:
        return nw.render(scene.surfels, field, scene.camera, max_hits=hits)

    facts = scene.facts | sweep.repeats
    facts["scene"] += f", K = {hits}"
    facts["sizes"]["max_hits"] = hits
    with torch.no_grad():
        out = render()
        if not out.image.isfinite().all() or out.alpha.mean() < 0.5:
            raise RuntimeError(f"{facts['scene']}: expected a finite picture of the scene, got something else")
        (signal,) = random_like((out.image,))
        del out
        forward = options.time("frame", lambda: render().image, **facts)
    both = options.time("frame + backward", lambda: torch.autograd.grad(render().image, leaves, signal), **facts)
    return [forward, both]


if __name__ == "__main__":
    sys.exit(suite.main({"sizes": run}))
