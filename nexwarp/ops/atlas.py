"""Drawing of baked scenes: surfels, or cards cut out of an atlas, with texels."""

from typing import NamedTuple

import torch
import warp as wp

from nexwarp.errors import check_tensors
from nexwarp.kernels.atlas import atlas_types, blend_kernel, nearest_kernel
from nexwarp.kernels.launch import Sharing
from nexwarp.kernels.types import types
from nexwarp.native.warp import tile_size_on
from nexwarp.ops._interop import Argument, Context, array, first_derivative, launch, struct
from nexwarp.ops.collect import Walked
from nexwarp.ops.project import Pinhole, Projection
from nexwarp.ops.tiles import Tiles


class Cut(NamedTuple):
    """How alpha becomes the coverage of cut-outs, and how many hits of a pixel, the nearest, are blended."""

    cutoff: float
    steepness: float = 0.0  # of a sigmoid; 0 is a threshold
    layers: int = 1


def draw_atlas(
    projection: Projection,
    tiles: Tiles,
    camera: Pinhole,
    texels: torch.Tensor,
    places: tuple[torch.Tensor, torch.Tensor],
    *,
    cards: bool = False,
    cut: Cut | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Blend surfels with texels front to back; differentiable in `texels` and the records' colours and opacities.

    Args:
        projection: surfels in the camera's frame.
        tiles: their lists.
        camera: the image plane.
        texels: (height, width, 4). Without `cards`, the first three are added to the plain colours.
        places: boxes (N, 4) u0, v0, u1, v1 in units of the projected scales, and rects (N, 4), column and row of the
            first texel's centre, and from there to the last one's. Beyond its box a surfel has its sides' texels.
        cards: surfels are the rectangles |u|, |v| <= 1, with the texels' colours and alphas.
        cut: of cards alone: test depths instead of blending all. None blends in the order of the tiles' lists.

    Returns:
        (H, W, 3) colours without background, and (H, W) alpha.
    """
    boxes, rects = places
    tensors = {"records": (projection.records, ("N", 4, 4)), "boxes": (boxes, ("N", 4)), "rects": (rects, ("N", 4))}
    check_tensors(tensors | {"texels": (texels, ("height", "width", 4))})
    boxes = torch.cat([boxes[:, :2], 1 / (boxes[:, 2:] - boxes[:, :2]).clamp_min(1e-12)], dim=1)
    scene = Walked(projection.records.detach().contiguous(), projection.limits, tiles, camera)
    return _Draw.apply(projection.records, texels.contiguous(), boxes, rects.contiguous(), scene, cards, cut)


class _Context(Context):
    rest: tuple[Walked, bool, Cut | None]


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: _Context,
        records: torch.Tensor,
        texels: torch.Tensor,
        boxes: torch.Tensor,
        rects: torch.Tensor,
        scene: Walked,
        cards: bool,
        cut: Cut | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        real, size = scene.real, (scene.camera.height, scene.camera.width)
        image, alphas, ids = records.new_empty(*size, 3), records.new_empty(size), None
        if cut is not None:
            ids = torch.empty(alphas.numel(), cut.layers, dtype=torch.int32, device=records.device)
        atlas, drawn = _atlas(real, texels, boxes, rects, cut), _drawn(real, image, alphas, ids)
        if cut is not None:
            scene.launch(nearest_kernel(real, cut.layers), [atlas, drawn])
        unused = struct(atlas_types(real).Sums)
        scene.launch(blend_kernel(real, cards, cut is not None, False), [atlas, drawn, drawn, unused])
        ctx.save_for_backward(texels, boxes, rects, ids, image, alphas)  # type: ignore[arg-type]  # torch takes None, too
        ctx.rest = (scene, cards, cut)
        return image, alphas

    @staticmethod
    @first_derivative
    def backward(ctx: _Context, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        scene, cards, cut = ctx.rest
        texels, boxes, rects, ids, image, alphas = ctx.saved_tensors
        real, records = scene.real, scene.records
        t = types(real)
        grad_texels, grad_colors = torch.zeros_like(texels), records.new_zeros(len(records), 4)
        sums = struct(atlas_types(real).Sums, texels=array(grad_texels, t.vec4), colors=array(grad_colors, t.vec4))
        drawn = (_drawn(real, image, alphas, ids), _drawn(real, *(x.contiguous() for x in grads)))
        arguments = [*scene.arguments(), _atlas(real, texels, boxes, rects, cut), *drawn]
        threads = (len(scene.tiles.tile_offsets) - 1) * tile_size_on(records.is_cuda) ** 2
        alone = Sharing(smallest=max(threads, 1))  # neighbouring tiles add to the same texels, on a CPU without atomics
        launch(records, blend_kernel(real, cards, cut is not None, True), threads, arguments, [sums], sharing=alone)
        grad_records = torch.zeros_like(records)
        grad_records[:, 3, :3], grad_records[:, 0, 3] = grad_colors[:, :3], grad_colors[:, 3]
        return grad_records, grad_texels, None, None, None, None, None


def _atlas(real: type, texels: torch.Tensor, boxes: torch.Tensor, rects: torch.Tensor, cut: Cut | None) -> Argument:
    """The struct `Atlas` of the kernels."""
    vec4 = types(real).vec4
    arrays = {name: array(x, vec4) for name, x in (("texels", texels), ("boxes", boxes), ("rects", rects))}
    cutoff, steepness = (0.0, 0.0) if cut is None else cut[:2]
    return struct(atlas_types(real).Atlas, **arrays, cutoff=cutoff, steepness=steepness)


def _drawn(real: type, image: torch.Tensor, alphas: torch.Tensor, ids: torch.Tensor | None = None) -> Argument:
    """The struct `Drawn` of the kernels."""
    pixels = {"image": array(image.view(-1, 3), types(real).vec3), "alphas": array(alphas.view(-1), real)}
    return struct(atlas_types(real).Drawn, **pixels, ids=array(ids, wp.int32))
