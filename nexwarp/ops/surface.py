"""Depth and normals of each pixel, over all hits that the collection pass blended."""

from dataclasses import dataclass

import torch

from nexwarp.kernels import surface as kernels
from nexwarp.ops._interop import Context, Op, contiguous
from nexwarp.ops.collect import Hits, SlotSums, Walked
from nexwarp.ops.project import Projection


@dataclass(frozen=True)
class Surface:
    """Depths (H, W) and normals (H, W, 3), those of `nexwarp.Rendering`; 0 where nothing is hit."""

    expected_depth: torch.Tensor
    median_depth: torch.Tensor
    top_depth: torch.Tensor
    normals: torch.Tensor


@dataclass(frozen=True)
class DifferentiableSurface(Surface):
    """A surface with gradients, and what losses of it need."""

    blended_normals: torch.Tensor  # (H, W, 3), not normalised


def surface(projection: Projection, hits: Hits, viewmat: torch.Tensor) -> DifferentiableSurface:
    """Walk every pixel's list once more, for what the K-buffer does not hold.

    Differentiable with respect to the projection and `viewmat`. The gradient of the median and of the top depth is that
    of the depth of the hit that they are taken from: which one it is, is piecewise constant. Hits are those of
    `collect` for the projection; `viewmat` (4, 4) is world to camera.
    """
    expected, median, top, sums = walk_surface(projection.records, hits.scene, hits.stops)
    with torch.autocast(sums.device.type, enabled=False):
        blended = sums @ viewmat[:3, :3].to(sums)
        normals = torch.nn.functional.normalize(blended, dim=-1)
    return DifferentiableSurface(expected, median, top, normals, blended)


def walk_surface(records: torch.Tensor, scene: Walked, stops: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """(expected, median, top) depths, and the sum of weight * normal in the camera's frame, (H, W, 3)."""
    return _Surface.apply(records, scene, stops)


class _Surface(Op):
    @staticmethod
    def forward(ctx: Context, records: torch.Tensor, scene: Walked, stops: torch.Tensor) -> tuple[torch.Tensor, ...]:
        shape = (scene.camera.height, scene.camera.width)
        expected, median, top = (records.new_empty(shape) for _ in range(3))
        normals = records.new_empty(*shape, 3)
        totals = picks = None
        if ctx.needs_input_grad[0]:
            totals = records.new_empty(shape)
            picks = torch.empty(*shape, 2, dtype=torch.int32, device=records.device)
            ctx.save_for_backward(stops, expected, normals, totals, picks)
            ctx.rest = scene
        scene.launch(kernels.surface, [stops, (expected, median, top, normals, totals, picks)])
        return expected, median, top, normals

    @staticmethod
    def backward(ctx: Context, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        stops, expected, normals, totals, picks = ctx.saved_tensors
        scene: Walked = ctx.rest
        sums = SlotSums(scene.records, scene.tiles)
        outputs = (expected, None, None, normals, totals, picks)
        scene.launch(kernels.surface_backward, [stops, outputs, contiguous(*grads), sums.argument()], **sums.names)
        return sums.totals()[0], None, None
