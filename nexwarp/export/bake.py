"""The neural texture baked into an image, for renderers without a hash grid and an MLP. Not in the paper.

The texture is evaluated at the texels, then these, SH and opacities are fitted to the photos (`fit`).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch.nn.functional import grid_sample, normalize

from nexwarp import ops
from nexwarp.cameras.camera import Camera
from nexwarp.errors import FormatError
from nexwarp.export.baked_scene import BakedScene
from nexwarp.export.fit import Views, cameras_of, fit
from nexwarp.kernels.types import MAX_HITS
from nexwarp.model.model import Model
from nexwarp.model.surfels import END, Activated, Surfels, axes
from nexwarp.model.texture import NeuralTexture

# Hits below this blending weight do not decide where a surfel has a texture: of 255 grey levels they change 4 at most.
LEAST_WEIGHT = 1.0 / 64.0
NOWHERE = 1e30
TINY_WEIGHT = 1e-3  # hits below it keep their plain colours

SIDE = 4096  # texels of the atlas along an axis at most
MAX_SIDE = 256  # texels of one surfel along one axis
FILLED = 0.85  # fraction of the atlas that rectangles cover at most: packing leaves gaps
TEXELS_AT_A_TIME = 2**20
UNCLIPPED = 0.98  # of the colours that 8 bits are to hold
GROWTH = 1.05  # of texels, until all rectangles fit

Progress = Callable[[str, int, int], None]  # name of a stage, how much of it is done, and of how much


@dataclass(frozen=True)
class Observations:
    """What a set of views sees of N surfels."""

    # (N, 4) u0, v0, u1, v1, in units of the scales: the box of all textured hits of some weight; u0 > u1 without any
    boxes: torch.Tensor
    pixels: torch.Tensor  # (N, 2) largest number of pixels that one scale covers along the surfel's x and y axes
    influence: torch.Tensor  # (N,) sum over pixels of the squared blending weight: what its colours change in photos
    textured: torch.Tensor  # (N,) fraction of the surfel's blending weight that is textured
    directions: torch.Tensor  # (N, 3) mean direction from which it is seen, unit, world frame; 0 if no view sees it


@dataclass(frozen=True)
class Layout:
    """Rectangles of N surfels in an atlas of `width` x `height` texels.

    The centres of a rectangle's outer texels lie on the sides of the surfel's box. Beyond its box a surfel has the
    colours of the box's side: samplers clamp the coordinates, and bilinear sampling never reads a neighbour's texel.
    """

    rects: torch.Tensor  # (N, 4) int32 left, top, width, height; the one texel at (0, 0) for surfels without a texture
    boxes: torch.Tensor  # (N, 4) u0, v0, u1, v1, in units of the scales; 0, 0, 0, 0 for surfels without a texture
    width: int
    height: int

    def textured(self) -> torch.Tensor:
        """Return the surfels (T,) int64 that have a texture."""
        return (self.boxes[:, 2] > self.boxes[:, 0]).nonzero()[:, 0]

    def spans(self) -> torch.Tensor:
        """Return the `rects` (N, 4) of a `BakedScene`: each first texel, and the way from it to the last one."""
        return torch.cat([self.rects[:, :2], self.rects[:, 2:] - 1], dim=1).float()

    def centres(self) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """Yield columns and rows of about a million texels (M, 2), their surfels (M,), coordinates on these (M, 2)."""
        textured = self.textured()
        part = self.rects[textured, 2:].long().prod(1).cumsum(0) // TEXELS_AT_A_TIME
        for members in textured.split(part.unique_consecutive(return_counts=True)[1].tolist()):
            counts = self.rects[members, 2:].long().prod(1)
            ids = members.repeat_interleave(counts)
            rects, boxes = self.rects[ids].long(), self.boxes[ids]
            index = torch.arange(len(ids), device=ids.device) - (counts.cumsum(0) - counts).repeat_interleave(counts)
            inside = torch.stack([index % rects[:, 2], index // rects[:, 2]], dim=1)
            share = inside / (rects[:, 2:] - 1).clamp_min(1)
            yield rects[:, :2] + inside, ids, boxes[:, :2] + share * (boxes[:, 2:] - boxes[:, :2])


def bake(model: Model, views: Views, *, steps: int | None = None, progress: Progress = lambda *_: None) -> BakedScene:
    """Bake a model's texture into an atlas whose texels are about a pixel of the closest of the given views.

    It is fitted to the photos of the views, or for cameras to the model's renderings; see `fit`. `progress` is called
    with each stage's name, how many views or steps of it are done, and of how many. The scene is at the mean exposure.
    """
    scene, _ = measure(model, views, progress)
    scene = fit(scene, model, views, steps, partial(progress, "baking the texture"))
    raw, logits = model.surfels, torch.logit(scene.shape.opacities, END)  # bounded, as those of models are
    with torch.no_grad():
        shape = ops.activate(raw.raw_quats, raw.log_scales, logits, raw.raw_gammas)
    return replace(scene, shape=Activated(scene.shape.means, *shape))


def measure(model: Model, views: Views, progress: Progress = lambda *_: None) -> tuple[BakedScene, Observations]:
    """Return the scene with the first atlas, of the texture itself, before any fit, and what the views see."""
    seen = observe(model, cameras_of(views), partial(progress, "measuring surfels"))
    return evaluate(model, seen, lay_out(seen.boxes, seen.pixels, seen.influence)), seen


def points_on(surfels: Surfels | Activated, ids: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    """Return points (..., 3), world frame, at offsets (..., 2) [world units] along the axes of surfels (...)."""
    ways = zip(offsets.unbind(-1), axes(surfels.quats.detach())[:2], strict=True)
    return surfels.means.detach()[ids] + sum(x[..., None] * axis[ids] for x, axis in ways)


def dimmed(model: Model, colors: torch.Tensor) -> float:
    """Return by what to multiply colours (N, 3) at the mean exposure so that hardly any are clipped; at most 1.

    1 where the model has no exposures: photos of one exposure show what is brighter than 1 as clipped, too.
    """
    if model.exposures is None or model.options.exposure != "photos" or not len(colors):
        return 1.0
    brightest = colors.amax(1)
    return 1.0 / max(float(brightest.sort().values[int(UNCLIPPED * (len(brightest) - 1))]), 1.0)


@torch.no_grad()
def observe(
    model: Model, cameras: Sequence[Camera], progress: Callable[[int, int], object] = lambda *_: None
) -> Observations:
    """Render all views without texture and gather what they see of each surfel; K decides which hits are textured."""
    kept = model.options.max_hits
    options = model.options.changed(max_hits=MAX_HITS, exposure="mean", clamp_texture=False)
    untextured = Model(model.surfels, None, None, model.detail_limits, options, model.meta)
    count, means = len(model.surfels), model.surfels.means.detach()
    boxes = means.new_tensor([NOWHERE, NOWHERE, -NOWHERE, -NOWHERE]).repeat(count, 1)
    pixels, (influence, total, textured) = means.new_zeros(count, 2), means.new_zeros(3, count)
    directions, scales = means.new_zeros(count, 3), model.surfels.scales.detach()
    sides = axes(model.surfels.quats.detach())[:2]
    for done, camera in enumerate(cameras, 1):
        camera = camera.to(model.device)
        out = untextured.render(camera)
        slots = (out.weights >= TINY_WEIGHT).flatten().nonzero()[:, 0]  # of the hits; a pixel's first is the heaviest
        ids, weights, depths = (x.flatten()[slots] for x in (out.ids.long(), out.weights, out.depths))
        places, sides_of = slots // MAX_HITS, [axis[ids] for axis in sides]
        x = (places % camera.width + 0.5 - camera.cx) / camera.fx
        y = (places // camera.width + 0.5 - camera.cy) / camera.fy
        rays = torch.stack([x, y, torch.ones_like(weights)], dim=1) @ camera.viewmat[:3, :3].to(weights)
        offsets = camera.position.to(weights) + depths[:, None] * rays - means[ids]
        # Coordinates on the surfels, in units of the scales.
        local = torch.stack([(offsets * axis).sum(1) for axis in sides_of], dim=1) / scales[ids]
        rays = normalize(rays, dim=1)
        total.index_add_(0, ids, weights)
        influence.index_add_(0, ids, weights.square())
        directions.index_add_(0, ids, weights[:, None] * rays)
        heavy = slots % MAX_HITS < kept
        textured.index_add_(0, ids, weights * heavy)
        heavy &= weights >= LEAST_WEIGHT
        pairs = ids[heavy, None].expand(-1, 2)
        for side, how in ((0, "amin"), (2, "amax")):
            boxes[:, side : side + 2].scatter_reduce_(0, pairs, local[heavy], how)
        # Pixels that one scale covers: its part across the ray, over the size of a pixel at the hit.
        cosines = torch.stack([(axis * rays).sum(1) for axis in sides_of], dim=1)[heavy]
        sizes = depths[heavy] / camera.focal
        covered = scales[ids[heavy]] * (1 - cosines.square()).clamp_min(0).sqrt() / sizes[:, None]
        pixels.scatter_reduce_(0, pairs, covered, "amax")
        progress(done, len(cameras))
    return Observations(boxes, pixels, influence, textured / total.clamp_min(1e-12), normalize(directions, dim=-1))


def lay_out(boxes: torch.Tensor, pixels: torch.Tensor, influence: torch.Tensor, *, fewest: int = 2) -> Layout:
    """Give each surfel with a box (N, 4) of u1 > u0, in units of the scales, a rectangle.

    One scale covers `pixels` (N, 2) along either axis. A texel is a pixel large; where the atlas is too small for that,
    each surfel gets texels in proportion to its `influence` (N,). A surfel has `fewest` texels along an axis where
    there is room.
    """
    textured = boxes[:, 2] > boxes[:, 0]
    boxes = boxes.where(textured[:, None], 0.0)
    covered = ((boxes[:, 2:] - boxes[:, :2]) * pixels)[textured].double().cpu()
    # Size of texels, in pixels, at one texel for each unit of influence.
    coarseness = ((covered + 1).prod(1) / influence[textured].double().cpu().clamp_min(1e-6)).sqrt()
    fewest = max(min(fewest, int(math.sqrt(FILLED * SIDE * SIDE / max(len(covered), 1)))), 2)
    factor = 1 / max(float(coarseness.max()), 1e-12) if len(covered) else 1.0
    while True:
        sizes = (covered / (factor * coarseness).clamp_min(1)[:, None]).ceil() + 1
        sizes = sizes.clamp(fewest, MAX_SIDE).int()
        area = int(sizes.long().prod(1).sum())
        if area <= SIDE * SIDE:
            width = min(SIDE, max(64, 2 ** math.ceil(math.log2(math.sqrt(max(area, 1) / FILLED)))))
            places, height = _pack(sizes, width)
            if height <= SIDE and (not len(sizes) or int(sizes[:, 0].max()) <= width):
                break
        if int(sizes.max()) <= fewest:
            raise FormatError(f"surfels: expected fewer for an atlas of {SIDE}x{SIDE} texels, got {len(sizes):,}")
        factor *= GROWTH
    rects = torch.tensor([0, 0, 1, 1], dtype=torch.int32).repeat(len(boxes), 1)
    rects[textured.cpu()] = torch.cat([places, sizes], dim=1)
    return Layout(rects.to(boxes.device), boxes, width, height)


def _pack(sizes: torch.Tensor, width: int) -> tuple[torch.Tensor, int]:
    """Return left and top (M, 2) of rectangles on shelves, tallest first, and the atlas' height, a multiple of 4."""
    order = torch.argsort(sizes[:, 1], descending=True, stable=True)
    places: list[tuple[int, int]] = []
    left, top, tallest = 0, 1, 0  # the first row holds the texel of untextured surfels
    for across, along in sizes[order].tolist():
        if left + across > width:
            left, top, tallest = 0, top + tallest, 0
        places.append((left, top))
        left, tallest = left + across, max(tallest, along)
    packed = torch.empty_like(sizes)
    packed[order] = torch.tensor(places, dtype=torch.int32).reshape(-1, 2)
    return packed, -(-(top + tallest) // 4) * 4


def texels_at(scene: BakedScene, ids: torch.Tensor, local: torch.Tensor) -> torch.Tensor:
    """Return texels (..., 4) of surfels (...) at coordinates (..., 2) [scales] on them, bilinearly."""
    boxes, rects = scene.boxes[ids], scene.rects[ids]
    share = (local - boxes[..., :2]) / (boxes[..., 2:] - boxes[..., :2]).clamp_min(1e-12)
    places = rects[..., :2] + share.clamp(0, 1) * rects[..., 2:]
    size = places.new_tensor([scene.texels.shape[1], scene.texels.shape[0]])
    grid = ((2 * places + 1) / size - 1).reshape(1, -1, 1, 2)
    values = grid_sample(scene.texels.permute(2, 0, 1)[None], grid, align_corners=False, padding_mode="border")
    return values[0, :, :, 0].T.reshape(*local.shape[:-1], 4)


def mean_colors(model: Model, seen: Observations) -> torch.Tensor:
    """Return the plain colours (N, 3) of the surfels from the mean directions that the views see them in."""
    surfels, degree = model.surfels, model.options.sh_degree
    return ops.plain_colors((surfels.sh0, surfels.shN), seen.directions, surfels.means.new_zeros(3), degree)


@torch.no_grad()
def evaluate(model: Model, seen: Observations, layout: Layout) -> BakedScene:
    """Bake the texture, weighted by each surfel's textured share, at texels seen from the mean directions."""
    surfels, texture, options = model.surfels, model.texture, model.options
    texels = surfels.means.new_zeros(layout.height, layout.width, 4)
    scene = BakedScene(
        Activated(*(x.detach() for x in surfels.activated())),
        texels,
        layout.boxes,
        layout.spans(),
        (surfels.sh0.detach(), surfels.shN.detach()[:, : (options.sh_degree + 1) ** 2 - 1]),
        model.detail_limits if options.detail_limits else None,
        background=options.background,
    )
    if texture is None or options.max_hits == 0:
        return scene
    if not isinstance(texture, NeuralTexture):
        raise FormatError(f"texture: expected a nexwarp.NeuralTexture to bake, got {type(texture).__name__}")
    plain = torch.zeros_like(surfels.means) if texture.residual else mean_colors(model, seen)
    # A pixel of the closest view, in world units: levels of finer cells fade as they do there.
    sizes = (surfels.scales / seen.pixels.clamp_min(1e-12)).amin(1)
    colors_at = partial(texture.evaluate, focal=1.0, sh_degree=options.sh_degree, clamp=options.clamp_texture)
    for places, ids, local in layout.centres():
        points = points_on(surfels, ids, local * surfels.scales[ids])
        colors = colors_at(points[:, None], sizes[ids, None], seen.directions[ids])[:, 0]
        texels[places[:, 1], places[:, 0], :3] = seen.textured[ids, None] * (colors - plain[ids])
    return scene
