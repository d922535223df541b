"""The collection stage and its parts, K = 2: plain colours and projection, tile lists, the walk along them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch

import nexwarp as nw
from benchmarks.scenes import SurfelScene, both_ways, entries, geometry, outputs, random_like, small_scene
from benchmarks.suite import Options
from benchmarks.timing import Measurement, ratio
from nexwarp import ops
from nexwarp.kernels.launch import get_num_threads, set_num_threads

MAX_HITS = 2


def project(scene: SurfelScene, options: Options) -> list[Measurement]:
    """SH of degree 3, then the projection; a thread a surfel each."""
    s, position = scene.surfels, scene.camera.position
    sh0, shN, means = leaves = [x.detach().clone().requires_grad_() for x in (s.sh0, s.shN, s.means)]

    def colors() -> torch.Tensor:
        return ops.plain_colors((sh0, shN), means, position, 3)

    g = geometry(scene)
    return [
        options.time("plain colours, forward", colors, **scene.facts),
        backward("plain colours, backward", (colors(),), leaves, scene, options),
        options.time("project, forward", g.project, **scene.facts),
        backward("project, backward", (g.project().records,), g.leaves, scene, options),
    ]


def tiles(scene: SurfelScene, options: Options) -> list[Measurement]:
    """Depth sort, count, scan, emit, tile sort. Nothing here is differentiable."""
    g = geometry(scene)
    projection = g.project()
    facts = scene.facts
    facts["sizes"]["entries"] = entries(g.tiles(projection))
    return [options.time("tiles", lambda: g.tiles(projection), **facts)]


def collect(scene: SurfelScene, options: Options) -> list[Measurement]:
    """The walk alone, given projection and lists; then the whole stage, from activated surfels to hits."""
    g = geometry(scene)
    with torch.no_grad():
        projection = g.project()
    records = projection.records.requires_grad_()
    lists = g.tiles(projection)
    hits = g.collect(projection, lists, MAX_HITS)
    walk = [
        options.time("collect, forward", lambda: g.collect(projection, lists, MAX_HITS), **scene.facts),
        backward("collect, backward", outputs(hits), [records], scene, options),
    ]
    with torch.no_grad():
        forward = options.time("collection stage, forward", lambda: g.hits(MAX_HITS), **scene.facts)
    return [*walk, forward, stage(scene, options)]


def stage(scene: SurfelScene, options: Options) -> Measurement:
    """The whole stage, forward + backward."""
    g = geometry(scene)
    run = both_ways(lambda: outputs(g.hits(MAX_HITS)), g.leaves)
    return options.time("collection stage, forward + backward", run, **scene.facts)


def rasterize(scene: SurfelScene, options: Options) -> list[Measurement]:
    """`nw.rasterize`, forward + backward, with 3 and 16 channels, against the passes of a training step."""
    g = geometry(scene)
    wide = torch.rand(len(g.colors), 16, device=g.colors.device, requires_grad=True)

    def trained(colors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        hits = replace(g, colors=colors).hits(MAX_HITS)
        return differentiable(*outputs(hits), *ops.unproject(hits.depths, g.viewmat, g.pinhole))

    def plain(colors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        hits = nw.rasterize(*g.shape, colors, scene.camera, MAX_HITS)
        return differentiable(hits.plain, hits.depths, hits.weights, hits.alpha, hits.points, hits.directions)

    runs = {
        "passes of a training step, forward + backward": both_ways(lambda: trained(g.colors), g.leaves),
        "rasterize, 3 channels, forward + backward": both_ways(lambda: plain(g.colors), g.leaves),
        "rasterize, 16 channels, forward + backward": both_ways(lambda: plain(wide), (*g.shape, wide)),
    }
    passes, three, sixteen = options.time_in_turns(runs, **scene.facts)
    return [
        passes,
        three,
        sixteen,
        ratio("rasterize, 3 channels, over the passes", three, passes),
        ratio("rasterize, 16 channels, over the passes", sixteen, passes),
    ]


def differentiable(*results: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return those results that have a gradient."""
    return tuple(x for x in results if x.requires_grad)


def backward(
    name: str, results: tuple[torch.Tensor, ...], leaves: Sequence[torch.Tensor], scene: SurfelScene, options: Options
) -> Measurement:
    """Time the backward pass of results that are there."""
    signals = random_like(results)
    return options.time(name, lambda: torch.autograd.grad(results, leaves, signals, retain_graph=True), **scene.facts)


def cpu(options: Options) -> list[Measurement]:
    """The collection stage on a CPU, forward + backward, with one thread and with two."""
    if options.cuda:
        return []
    scene = small_scene(options)
    with threads(1):
        one = stage(scene, options)
    with threads(2):
        two = stage(scene, options)
    return [one, two, ratio("collection stage, 1 thread over 2", one, two)]


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let Warp's launches and torch use this many threads."""
    before = get_num_threads(), torch.get_num_threads()
    set_num_threads(count)
    torch.set_num_threads(count)
    try:
        yield
    finally:
        set_num_threads(before[0])
        torch.set_num_threads(before[1])
