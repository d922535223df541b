"""Drawing of baked scenes: surfels, or cards cut out of an atlas, with texels."""

from typing import NamedTuple

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels.atlas import blend, blend_backward, nearest
from nexwarp.kernels.launch import Sharing
from nexwarp.native.warp import tile_size_on
from nexwarp.ops._interop import Argument, Context, Op, launch
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
    if cut is not None and not cards:
        raise ValueError("cut: expected together with cards, got a cut of surfels, which are blended")
    boxes, rects = places
    tensors = {"records": (projection.records, ("N", 4, 4)), "boxes": (boxes, ("N", 4)), "rects": (rects, ("N", 4))}
    check_tensors(tensors | {"texels": (texels, ("height", "width", 4))})
    boxes = torch.cat([boxes[:, :2], 1 / (boxes[:, 2:] - boxes[:, :2]).clamp_min(1e-12)], dim=1)
    scene = Walked(projection.records.detach().contiguous(), projection.limits, tiles, camera)
    return _Draw.apply(projection.records, texels.contiguous(), boxes, rects.contiguous(), scene, cards, cut)


class _Draw(Op):
    @staticmethod
    def forward(
        ctx: Context,
        records: torch.Tensor,
        texels: torch.Tensor,
        boxes: torch.Tensor,
        rects: torch.Tensor,
        scene: Walked,
        cards: bool,
        cut: Cut | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        size = scene.camera.height, scene.camera.width
        image, alphas, ids = records.new_empty(*size, 3), records.new_empty(size), None
        names, atlas = {"cards": cards, "cut": cut is not None}, _atlas(texels, boxes, rects, cut)
        if cut is not None:
            ids = torch.empty(alphas.numel(), cut.layers, dtype=torch.int32, device=records.device)
            scene.launch(nearest, [atlas, (None, None, ids)], layers=cut.layers, **names)
        scene.launch(blend, [atlas, (image, alphas, ids)], **names)
        ctx.save_for_backward(texels, boxes, rects, ids, image, alphas)
        ctx.rest = (scene, names, cut)
        return image, alphas

    @staticmethod
    def backward(ctx: Context, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        scene, names, cut = ctx.rest
        texels, boxes, rects, ids, image, alphas = ctx.saved_tensors
        records = scene.records
        sums = torch.zeros_like(texels), records.new_zeros(len(records), 4)
        atlas, incoming = _atlas(texels, boxes, rects, cut), tuple(x.contiguous() for x in grads)
        arguments = [*scene.arguments(), atlas, (image, alphas, ids), incoming]
        threads = (len(scene.tiles.tile_offsets) - 1) * tile_size_on(records.is_cuda) ** 2
        alone = Sharing(smallest=max(threads, 1))  # neighbouring tiles add to the same texels, on a CPU without atomics
        launch(records, blend_backward, threads, arguments, [sums], sharing=alone, **names)
        grad_records, (grad_texels, grad_colors) = torch.zeros_like(records), sums
        grad_records[:, 3, :3], grad_records[:, 0, 3] = grad_colors[:, :3], grad_colors[:, 3]
        return grad_records, grad_texels, None, None, None, None, None


def _atlas(texels: torch.Tensor, boxes: torch.Tensor, rects: torch.Tensor, cut: Cut | None) -> Argument:
    """The fields of the struct `Atlas` of the kernels, in their order."""
    cutoff, steepness = (0.0, 0.0) if cut is None else cut[:2]
    return texels, boxes, rects, cutoff, steepness
