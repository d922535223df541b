"""gsplat's 2DGS and 3DGS rasterisation on the same surfels, camera and image size, gamma = 1, in the same process.

gsplat is optional: `pip install gsplat==1.5.3`, with a CUDA compiler to build it. Its forward pass does what our
collection stage does (project, tiles, blending), so the whole calls are compared. It is called as its users call it:
one camera, RGB of given colours, not packed, without the distortion loss.

A call is timed whole, with the host's part, and its GPU's part is given apart: the time in which the GPU works. The
near plane decides how many entries gsplat lists: its box of 1 sigma explodes for discs just before the camera's plane.
0.2 is the value of gsplat's own 2DGS example. Entries listed, and walked by a pixel up to its last hit, are given for
both sides.

What only one side computes: gsplat's 2DGS also blends normals and median depths and applies its low-pass; ours also
keeps the K = 2 heaviest hits of a pixel with their depths and weights, and splits the colour into theirs and the rest.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import torch

from benchmarks.scenes import Geometry, SurfelScene, both_ways, entries, fox, geometry, large_scene, outputs
from benchmarks.suite import Options
from benchmarks.timing import Measurement, figure, ratio
from nexwarp.native.warp import TILE_SIZE

NEARS = (0.01, 0.05, 0.2)
HEADLINE = 0.2
PRIMITIVES = ("2DGS", "3DGS")
# The third scale of a Gaussian that stands for a surfel in 3DGS, relative to the smaller of the other two.
FLATNESS = 0.01

Rasterize = Callable[[], tuple[torch.Tensor, ...]]


class Call(NamedTuple):
    """One side of the comparison.

    Attributes:
        name: of the side.
        forward: renders; returns differentiable outputs.
        leaves: of which gradients are taken.
        walked: returns the entries listed, and the mean over pixels of those walked up to the last hit.
    """

    name: str
    forward: Rasterize
    leaves: tuple[torch.Tensor, ...]
    walked: Callable[[], tuple[int, float]]


def run(options: Options) -> list[Measurement]:
    if not options.cuda:
        return []
    try:
        import gsplat
    except ImportError as error:
        print(f"no peers: {error}", file=sys.stderr)
        return []
    scenes = [at_near(large_scene(options), near) for near in NEARS]
    if options.model is not None:
        scenes.append(at_near(fox(options.model, options.data), HEADLINE))
    return [m for scene in scenes for m in compare(scene.to(options.device), options, gsplat)]


def at_near(scene: SurfelScene, near: float) -> SurfelScene:
    """Return the scene with its first camera at another near plane."""
    return replace(scene, name=f"{scene.name}, near {near:g}", cameras=(replace(scene.camera, near=near),))


def compare(scene: SurfelScene, options: Options, gsplat: Any) -> list[Measurement]:
    """Time both sides on a scene, and return the times, the work and the ratios."""
    g = with_gamma_1(geometry(scene))
    ours = list(timed(our_call(g), scene, options))
    found = [*ours, frame(scene, options)]
    for primitive in PRIMITIVES:
        theirs = list(timed(gsplat_call(g, gsplat, primitive), scene, options))
        found += theirs
        for mine, other in zip(ours, theirs, strict=True):
            if mine.unit == "ms":
                what = mine.name.removeprefix("ours, ")
                found.append(
                    ratio(f"ours over gsplat {primitive}, {what}", mine, other, f"gsplat {gsplat.__version__}")
                )
    return found


def frame(scene: SurfelScene, options: Options) -> Measurement:
    """Time what our users call for a picture of surfels alone: `Model.render`, by a CUDA graph.

    Beside the collection stage it activates the surfels, evaluates their SH and composes.
    """
    model = scene.model.bare(max_hits=2)

    @torch.no_grad()
    def render() -> torch.Tensor:
        return model.render(scene.camera).image

    return options.time("ours, Model.render without texture", render, **scene.facts)


def with_gamma_1(g: Geometry) -> Geometry:
    """Return the geometry with Gaussian kernels, which are all that gsplat has."""
    return replace(g, shape=g.shape._replace(gammas=torch.ones_like(g.shape.gammas).requires_grad_()))


def timed(call: Call, scene: SurfelScene, options: Options) -> Iterator[Measurement]:
    """Time one side's whole calls and their GPU's part, and count its entries."""
    facts = scene.facts
    with torch.no_grad():
        yield options.time(f"{call.name}, forward", call.forward, **facts)
        yield options.gpu_part(f"{call.name}, forward", call.forward, **facts)
    both = both_ways(call.forward, call.leaves)
    yield options.time(f"{call.name}, forward + backward", both, **facts)
    yield options.gpu_part(f"{call.name}, forward + backward", both, **facts)
    listed, walked = call.walked()
    yield figure(f"{call.name}, entries listed", listed / 1e6, options.device, unit="million", **facts)
    yield figure(f"{call.name}, entries walked", walked, options.device, unit="a pixel", **facts)


def our_call(g: Geometry, max_hits: int = 2) -> Call:
    """Our collection stage: project, tiles, collect."""

    def walked() -> tuple[int, float]:
        projection = g.project()
        tiles = g.tiles(projection)
        hits = g.collect(projection, tiles, max_hits)
        starts = tile_starts(tiles.tile_offsets[:-1].view(-1, tiles.columns), TILE_SIZE, hits.stops)
        return entries(tiles), (hits.stops - starts).float().mean().item()

    return Call("ours", lambda: outputs(g.hits(max_hits)), g.leaves, walked)


def gsplat_call(g: Geometry, gsplat: Any, primitive: str = "2DGS") -> Call:
    """Return a call of gsplat, whose outputs are (1, H, W, 3) colours and (1, H, W, 1) alphas.

    Colours that are not spherical harmonics need a camera dimension: gsplat's check accepts (N, 3), but its
    rasterisation then fails.

    Args:
        g: the surfels and the camera.
        gsplat: the module.
        primitive: "2DGS" or "3DGS".
    """
    means, quats, scales, opacities, _ = (x.detach() for x in g.shape)
    # A surfel has no third scale; 2DGS ignores it.
    third = torch.ones_like(scales[:, :1]) if primitive == "2DGS" else FLATNESS * scales.amin(dim=1, keepdim=True)
    scales = torch.cat([scales, third], dim=1)
    leaves = [x.clone().requires_grad_() for x in (means, quats, scales, opacities, g.colors.detach()[None])]
    p = g.pinhole
    call = {"viewmats": g.viewmat[None], "Ks": p.K[None], "width": p.width, "height": p.height, "near_plane": p.near}

    def rasterize() -> tuple[Any, ...]:
        return (gsplat.rasterization_2dgs if primitive == "2DGS" else gsplat.rasterization)(*leaves, **call)

    def walked() -> tuple[int, float]:
        image, *_, info = rasterize()
        starts = tile_starts(info["isect_offsets"][0], info["tile_size"], image[0, :, :, 0])
        last = last_entries(image)
        # A pixel without a hit has walked up to its first entry at least; gsplat gives it the index 0.
        return len(info["flatten_ids"]), (last - starts + 1).clamp_min(0).float().mean().item()

    return Call(f"gsplat {primitive}", lambda: rasterize()[:2], tuple(leaves), walked)


def tile_starts(offsets: torch.Tensor, tile_size: int, image: torch.Tensor) -> torch.Tensor:
    """Return the start of each pixel's list (H, W), given those of the tiles (rows, columns) and an image (H, W)."""
    height, width = image.shape
    return offsets.repeat_interleave(tile_size, 0).repeat_interleave(tile_size, 1)[:height, :width]


def last_entries(image: torch.Tensor) -> torch.Tensor:
    """Return the last entry (H, W) that each pixel of gsplat blended; its rasterisation keeps it for the backward."""
    pending, seen = [image.grad_fn], set()
    while pending:
        node = pending.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        if "RasterizeToPixels" in node.name():
            size = image.shape[1:3]
            saved = [x for x in getattr(node, "saved_tensors", ()) if x is not None]
            kept = [x for x in saved if x.dtype == torch.int32 and x.shape[-2:] == size]
            # 2DGS also keeps the entries of the median depths, which are not behind the last ones.
            return torch.stack([x.reshape(size) for x in kept]).amax(0)
        pending += [parent for parent, _ in node.next_functions]
    raise RuntimeError("gsplat: expected its rasterisation in the graph of its image")
