"""Depth and normals of each pixel, over all hits that the collection pass blended."""

from dataclasses import dataclass

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from nexwarp.kernels.surface import surface_kernel
from nexwarp.kernels.surface_backward import surface_backward_kernel
from nexwarp.kernels.types import types
from nexwarp.ops._interop import Argument, Context, array, real_of
from nexwarp.ops.collect import Hits, SlotSums, launch_walk, walk_inputs
from nexwarp.ops.pinhole import Pinhole
from nexwarp.ops.project import Projection
from nexwarp.ops.tiles import Tiles


@dataclass(frozen=True)
class Surface:
    """Depth and normals; 0 where nothing is hit.

    Attributes:
        expected_depth: (H, W) mean z-depth of all hits, weighted by their blending weights, world units.
        median_depth: (H, W) z-depth of the hit that takes the transmittance to 1/2, of the last hit where it stays
            above.
        top_depth: (H, W) z-depth of the heaviest hit.
        normals: (H, W, 3) unit, world frame: mean of the normals, weighted likewise, each towards the camera.
    """

    expected_depth: torch.Tensor
    median_depth: torch.Tensor
    top_depth: torch.Tensor
    normals: torch.Tensor


@dataclass(frozen=True)
class DifferentiableSurface(Surface):
    """A surface with gradients, and what losses of it need.

    Attributes:
        blended_normals: (H, W, 3) sum of weight * normal, world frame, each normal towards the camera; not normalised.
        distortion: (H, W) sum over pairs of hits of the products of their weights, times their difference in depth.
    """

    blended_normals: torch.Tensor
    distortion: torch.Tensor


def surface(
    projection: Projection, tiles: Tiles, hits: Hits, camera: Pinhole, viewmat: torch.Tensor, *, low_pass: bool = False
) -> DifferentiableSurface:
    """Walk every pixel's list once more, for what the K-buffer does not hold.

    Differentiable with respect to the projection and `viewmat`. The gradient of the median and of the top depth is that
    of the depth of the hit that they are taken from: which one it is, is piecewise constant.

    Args:
        projection: as given to `collect`.
        tiles: as given to `collect`.
        hits: as returned by `collect`.
        camera: as given to `collect`.
        viewmat: (4, 4) world to camera.
        low_pass: as given to `collect`.
    """
    given = (projection.records.contiguous(), projection.centers, projection.limits)
    expected, median, top, sums, distortion = _Surface.apply(*given, tiles, hits.stops, camera, low_pass)
    with torch.autocast(sums.device.type, enabled=False):
        blended = sums @ viewmat[:3, :3].to(sums)
        normals = torch.nn.functional.normalize(blended, dim=-1)
    return DifferentiableSurface(expected, median, top, normals, blended, distortion)


class _Context(Context):
    rest: tuple[Tiles, Pinhole, bool]


class _Surface(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: _Context,
        records: torch.Tensor,
        centers: torch.Tensor,
        limits: torch.Tensor,
        tiles: Tiles,
        stops: torch.Tensor,
        camera: Pinhole,
        low_pass: bool,
    ) -> tuple[torch.Tensor, ...]:
        real, shape = real_of(records), (camera.height, camera.width)
        t = types(real)
        expected, median, top, distortion = (records.new_empty(shape) for _ in range(4))
        normals = records.new_empty(*shape, 3)
        totals = picks = None
        if any(ctx.needs_input_grad):
            totals = records.new_empty(*shape, 3)
            picks = torch.empty(*shape, 2, dtype=torch.int32, device=records.device)
            ctx.save_for_backward(records, centers, limits, stops, expected, normals, distortion, totals, picks)
            ctx.rest = (tiles, camera, low_pass)
        inputs = [*_inputs(records, centers, limits, tiles, camera, stops)]
        outputs = [*_pixels(real, expected, median, top), *_pixels(t.vec3, normals), *_pixels(real, distortion)]
        outputs += [*_pixels(t.vec3, totals), *_pixels(wp.vec2i, picks)]
        launch_walk(records, surface_kernel(real, low_pass, tiles.tile_size), tiles, inputs, outputs)
        return expected, median, top, normals, distortion

    @staticmethod
    @once_differentiable
    def backward(
        ctx: _Context,
        grad_expected: torch.Tensor,
        grad_median: torch.Tensor,
        grad_top: torch.Tensor,
        grad_normals: torch.Tensor,
        grad_distortion: torch.Tensor,
    ) -> tuple[torch.Tensor | None, ...]:
        records, centers, limits, stops, expected, normals, distortion, totals, picks = ctx.saved_tensors
        tiles, camera, low_pass = ctx.rest
        real = real_of(records)
        t = types(real)
        sums = SlotSums(records, tiles)
        inputs = [
            *_inputs(records, centers, limits, tiles, camera, stops),
            sums.slots,
            *_pixels(real, expected),
            *_pixels(t.vec3, normals),
            *_pixels(real, distortion),
            *_pixels(t.vec3, totals),
            *_pixels(wp.vec2i, picks),
            *_pixels(real, grad_expected, grad_median, grad_top),
            *_pixels(t.vec3, grad_normals),
            *_pixels(real, grad_distortion),
        ]
        grad_records = sums.new(4, 4)
        # Centres carry a gradient only through the low-pass.
        grad_centers = sums.new(3) if low_pass else None
        outputs = [sums.array(grad_records, t.vec4), sums.array(grad_centers, t.vec3), sums.bad_array]
        kernel = surface_backward_kernel(real, low_pass, tiles.tile_size, sums.fixed_point)
        launch_walk(records, kernel, tiles, inputs, outputs)
        grad_records = sums.reduce(grad_records, t.vec4)
        if grad_centers is not None:
            grad_centers = sums.reduce(grad_centers[:, None], t.vec3)[:, 0]
        return grad_records, grad_centers, *(None,) * 5


def _inputs(
    records: torch.Tensor,
    centers: torch.Tensor,
    limits: torch.Tensor,
    tiles: Tiles,
    camera: Pinhole,
    stops: torch.Tensor,
) -> list[Argument]:
    inputs = walk_inputs(records, centers, limits, tiles, camera)
    return [*inputs, array(tiles.reaches, types(real_of(records)).vec2), array(stops.view(-1), wp.int32)]


def _pixels(dtype: type, *images: torch.Tensor | None) -> list[Argument]:
    """View images (H, W, ...) as the kernels do: (H * W,) of `dtype`."""
    return [array(None if x is None else x.contiguous().view(-1, *x.shape[2:]), dtype) for x in images]
