"""Time and memory against the number of surfels, of pixels, and K: a whole frame, and a frame with its backward."""

import sys

import torch

import nexwarp as nw
from benchmarks import suite
from benchmarks.scenes import Scene, cloud, random_like, texture
from benchmarks.suite import Options
from benchmarks.timing import Measurement

# (surfels, megapixels, K), one of them changed at a time.
CUDA = {
    "base": (400_000, 1.66, 2),
    "surfels": (10_000, 40_000, 100_000, 1_000_000, 4_000_000),
    "megapixels": (0.25, 0.5, 1.0, 2.0, 4.0, 8.0),
    "hits": (0, 1, 4, 8),
}
CPU = {"base": (10_000, 0.06, 2), "surfels": (2_500, 40_000), "megapixels": (0.03, 0.12), "hits": (0, 4, 8)}
QUICK = {"base": (500, 0.003, 2), "surfels": (1_000,), "megapixels": (0.006,), "hits": (0,)}
ASPECT = 1.543


def run(options: Options) -> list[Measurement]:
    sizes = QUICK if options.quick else CUDA if options.cuda else CPU
    surfels, megapixels, hits = sizes["base"]
    points = [sizes["base"]]
    points += [(n, megapixels, hits) for n in sizes["surfels"]]
    points += [(surfels, m, hits) for m in sizes["megapixels"]]
    points += [(surfels, megapixels, k) for k in sizes["hits"]]
    return [m for point in points for m in at_size(*point, options)]


def at_size(surfels: int, megapixels: float, hits: int, options: Options) -> list[Measurement]:
    height = round((1e6 * megapixels / ASPECT) ** 0.5)
    scene = cloud(surfels, round(ASPECT * height), height).to(options.device)
    try:
        return sized(scene, hits, options)
    finally:
        del scene
        if options.cuda:
            torch.cuda.empty_cache()


def sized(scene: Scene, hits: int, options: Options) -> list[Measurement]:
    field = texture(scene, table_size=2**20 if options.cuda and not options.quick else 2**15)
    leaves = [*scene.surfels.parameters(), *(field.parameters() if hits else ())]

    def image() -> torch.Tensor:
        return nw.render(scene.surfels, field, scene.camera, max_hits=hits).image

    facts = scene.facts
    facts["scene"] += f", K = {hits}"
    facts["sizes"]["max_hits"] = hits
    facts["seconds"] = 0.5
    with torch.no_grad():
        (signal,) = random_like((image(),))
        forward = options.time("frame", image, **facts)
    return [forward, options.time("frame + backward", lambda: torch.autograd.grad(image(), leaves, signal), **facts)]


if __name__ == "__main__":
    sys.exit(suite.main({"sizes": run}))
