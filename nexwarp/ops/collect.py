"""Collection pass: the K heaviest hits of every pixel, their plain colour, and that of all others."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from nexwarp.checks import check_tensors
from nexwarp.kernels.collect import collect_kernel
from nexwarp.kernels.collect_backward import collect_backward_kernel
from nexwarp.kernels.cpu.collect import collect_rows_backward_kernel, collect_rows_kernel, row_lanes
from nexwarp.kernels.reduce import reduce_rows_kernel
from nexwarp.kernels.splat_error import splat_error_kernel
from nexwarp.kernels.types import MAX_HITS, types
from nexwarp.kernels.walk import BLOCK_DIM
from nexwarp.ops._interop import array, from_fixed_point, launch, real_of, sums_in_fixed_point, sums_like
from nexwarp.ops.pinhole import Pinhole
from nexwarp.ops.project import Projection
from nexwarp.ops.tiles import Tiles


@dataclass
class SplatErrorRequest:
    """Asks the backward pass to add up blended errors on its way; see `Rendering.request_splat_error`.

    Attributes:
        errors: (H, W) error of each pixel, set between forward and backward; None asks for nothing.
        sums_after_backward: (N,) what `splat_error` would give; the backward pass fills it.
    """

    errors: torch.Tensor | None = None
    sums_after_backward: torch.Tensor | None = None


@dataclass(frozen=True)
class Hits:
    """What the collection pass found.

    Attributes:
        plain: (H, W, 3) sum of weight * plain colour over the hits outside the buffer (N, paper Eq. 4); differentiable.
        base: (H, W, 3) the same sum over the hits in the buffer: their colour without a texture; differentiable.
        ids: (H, W, K) int32 surfels, heaviest hit first, -1 in empty slots.
        depths: (H, W, K) z-depths in world units, 0 in empty slots; differentiable.
        weights: (H, W, K), 0 in empty slots; differentiable.
        alpha: (H, W) 1 - final transmittance; differentiable.
        stops: (H, W) int32, end of the part of the tile's list that the pixel's walk took.
        error_request: asks the backward pass for blended errors.
    """

    plain: torch.Tensor
    base: torch.Tensor
    ids: torch.Tensor
    depths: torch.Tensor
    weights: torch.Tensor
    alpha: torch.Tensor
    stops: torch.Tensor
    error_request: SplatErrorRequest


def collect(
    projection: Projection, tiles: Tiles, camera: Pinhole, *, max_hits: int = 2, low_pass: bool = False
) -> Hits:
    """Walk every pixel's list front to back; differentiable with respect to the projection.

    Args:
        projection: surfels in the camera's frame.
        tiles: their lists.
        camera: the image plane.
        max_hits: K, length of the buffer, 0 to 8.
        low_pass: use max(surfel, screen-space Gaussian) as the kernel, for surfels smaller than a pixel.
    """
    if not 0 <= max_hits <= MAX_HITS:
        raise ValueError(f"max_hits: expected 0 to {MAX_HITS}, got {max_hits}")
    request = SplatErrorRequest()
    buffers = _Collect.apply(
        projection.records, projection.centers, projection.limits, tiles, camera, max_hits, low_pass, request
    )
    return Hits(*buffers, request)


def splat_error(
    projection: Projection,
    tiles: Tiles,
    hits: Hits,
    camera: Pinhole,
    errors: torch.Tensor,
    *,
    low_pass: bool = False,
) -> torch.Tensor:
    """Give each surfel the sum over pixels of its blending weight times the pixel's error.

    Args:
        projection: as given to `collect`.
        tiles: as given to `collect`.
        hits: as returned by `collect`.
        camera: as given to `collect`.
        errors: (H, W) error of each pixel, >= 0.
        low_pass: as given to `collect`.

    Returns:
        (N,) blended errors. Not differentiable.
    """
    check_tensors({"errors": (errors, (camera.height, camera.width))}, device=projection.records.device)
    records = projection.records.detach()
    real = real_of(records)
    rows, slots = _rows(tiles, records)
    fixed = sums_in_fixed_point(records)
    sums = sums_like(records, (slots,), fixed)
    inputs = walk_inputs(records, projection.centers.detach(), projection.limits, tiles, camera)
    errors = errors.detach().to(records.dtype).contiguous()
    inputs += [array(rows, wp.int32), array(hits.stops.view(-1), wp.int32), array(errors.view(-1), real)]
    kernel = splat_error_kernel(real, low_pass, tiles.tile_size, fixed)
    if fixed:
        bad = torch.zeros(1, dtype=torch.int32, device=records.device)
        launch_walk(records, kernel, tiles, inputs, [array(sums, wp.int64), array(bad, wp.int32)])
        sums = from_fixed_point(sums, bad, records.dtype)
    else:
        launch_walk(records, kernel, tiles, inputs, [array(sums, real), None])
    return _reduce(sums[:, None], tiles, len(records), real)[:, 0]


def launch_walk(
    like: torch.Tensor, kernel: wp.Kernel, tiles: Tiles, inputs: list[Any], outputs: list[Any], lanes: int = 1
) -> None:
    """Launch a kernel over the pixels of all tiles, `lanes` of them a thread."""
    threads = tiles.tile_size**2 // lanes
    # All pixels of a tile write to its entries, so one CPU thread must walk them all.
    options = {"block_dim": BLOCK_DIM, "align": threads, "smallest": threads}
    launch(like, kernel, (len(tiles.tile_offsets) - 1) * threads, inputs, outputs, **options)


def _rows_a_thread(like: torch.Tensor) -> bool:
    """Whether a thread walks with a row of pixels, as pays on a CPU, or with one pixel."""
    return like.device.type == "cpu"


def walk_inputs(
    records: torch.Tensor,
    centers: torch.Tensor,
    limits: torch.Tensor,
    tiles: Tiles,
    camera: Pinhole,
) -> list[Any]:
    """Arguments that the kernels share, from `records` to `near`."""
    t = types(real_of(records))
    return [
        array(records, t.vec4),
        array(centers, t.vec3),
        array(limits, t.real),
        *(array(x, wp.int32) for x in (tiles.surfel_ids, tiles.tile_offsets, tiles.order, tiles.ends)),
        wp.vec2i(camera.width, camera.height),
        tiles.columns,
        array(camera.K.contiguous()[None], t.mat33),
        camera.near,
    ]


def _rows(tiles: Tiles, records: torch.Tensor) -> tuple[torch.Tensor | None, int]:
    """Row that each entry's gradient goes to, and how many rows: by entry on a CPU; None is by surfel, on CUDA."""
    if tiles.exact:
        return tiles.entries, len(tiles.entries)
    return None, len(records)


def _reduce(slots: torch.Tensor, tiles: Tiles, count: int, dtype: type) -> torch.Tensor:
    """Add up each surfel's rows; on CUDA they already are. A row is (columns,) elements of `dtype`."""
    if not tiles.exact:
        return slots
    sums = slots.new_zeros(count, *slots.shape[1:])
    inputs = [array(tiles.order, wp.int32), array(tiles.ends, wp.int32), array(slots, dtype), slots.shape[1]]
    launch(slots, reduce_rows_kernel(dtype), count, inputs, [array(sums, dtype)])
    return sums


class _Collect(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        records: torch.Tensor,
        centers: torch.Tensor,
        limits: torch.Tensor,
        tiles: Tiles,
        camera: Pinhole,
        max_hits: int,
        low_pass: bool,
        request: SplatErrorRequest,
    ) -> tuple[torch.Tensor, ...]:
        real = real_of(records)
        shape = (camera.height, camera.width)
        plain, base = (records.new_empty(*shape, 3) for _ in range(2))
        ids = torch.empty(*shape, max_hits, dtype=torch.int32, device=records.device)
        depths, weights = (records.new_empty(*shape, max_hits) for _ in range(2))
        alphas = records.new_empty(shape)
        stops = torch.empty(shape, dtype=torch.int32, device=records.device)
        outputs = [
            array(plain.view(-1, 3), types(real).vec3),
            array(base.view(-1, 3), types(real).vec3),
            array(ids.view(-1, max_hits) if max_hits else ids.new_empty(1, 1), wp.int32),
            array(depths.view(-1, max_hits) if max_hits else depths.new_empty(1, 1), real),
            array(weights.view(-1, max_hits) if max_hits else weights.new_empty(1, 1), real),
            array(alphas.view(-1), real),
            array(stops.view(-1), wp.int32),
        ]
        inputs = [*walk_inputs(records, centers, limits, tiles, camera), array(tiles.reaches, types(real).vec2)]
        if _rows_a_thread(records):
            kernel = collect_rows_kernel(real, max_hits, low_pass, tiles.tile_size)
            launch_walk(records, kernel, tiles, inputs, outputs, row_lanes(tiles.tile_size))
        else:
            launch_walk(records, collect_kernel(real, max_hits, low_pass, tiles.tile_size), tiles, inputs, outputs)
        ctx.save_for_backward(records, centers, limits, plain, base, ids, weights, alphas, stops)
        ctx.mark_non_differentiable(ids, stops)
        ctx.rest = (tiles, camera, max_hits, low_pass, request)
        return plain, base, ids, depths, weights, alphas, stops

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any,
        grad_plain: torch.Tensor,
        grad_base: torch.Tensor,
        _ids: None,
        grad_depths: torch.Tensor,
        grad_weights: torch.Tensor,
        grad_alphas: torch.Tensor,
        _stops: None,
    ) -> tuple[torch.Tensor | None, ...]:
        records, centers, limits, plain, base, ids, weights, alphas, stops = ctx.saved_tensors
        tiles, camera, max_hits, low_pass, request = ctx.rest
        real = real_of(records)
        t = types(real)
        slots = max(max_hits, 1)

        def buffer(tensor: torch.Tensor, dtype: type) -> Any:
            return array(tensor.contiguous().view(-1, slots) if max_hits else tensor.new_empty(1, 1), dtype)

        rows, count = _rows(tiles, records)
        # Where rows are by surfel, many warps add to one: in fixed point, if their order must not matter.
        fixed = sums_in_fixed_point(records)
        grad_rows = sums_like(records, (count, 4, 4), fixed)
        # Centres carry a gradient only through the low-pass.
        grad_center_rows = sums_like(centers, (count if low_pass else 1, 3), fixed)
        inputs = [
            *walk_inputs(records, centers, limits, tiles, camera),
            array(tiles.reaches, t.vec2),
            array(rows, wp.int32),
            array(plain.view(-1, 3), t.vec3),
            array(base.view(-1, 3), t.vec3),
            buffer(ids, wp.int32),
            buffer(weights, real),
            array(alphas.view(-1), real),
            array(stops.view(-1), wp.int32),
            array(grad_plain.contiguous().view(-1, 3), t.vec3),
            array(grad_base.contiguous().view(-1, 3), t.vec3),
            buffer(grad_depths, real),
            buffer(grad_weights, real),
            array(grad_alphas.contiguous().view(-1), real),
            array(None if request.errors is None else request.errors.view(-1), real),
        ]
        error_rows = None if request.errors is None else sums_like(records, (count,), fixed)
        variant = (real, max_hits, low_pass, tiles.tile_size, request.errors is not None)
        if fixed:
            bad = torch.zeros(1, dtype=torch.int32, device=records.device)
            sums = (grad_rows, grad_center_rows, error_rows)
            outputs = [None if x is None else array(x.view(len(x), -1), wp.int64) for x in sums]
            kernel = collect_backward_kernel(*variant, fixed=True)
            launch_walk(records, kernel, tiles, inputs, [*outputs, array(bad, wp.int32)])
            grad_rows, grad_center_rows, error_rows = (
                None if x is None else from_fixed_point(x, bad, records.dtype) for x in sums
            )
        else:
            outputs = [array(grad_rows, t.vec4), array(grad_center_rows, t.vec3), array(error_rows, real)]
            if _rows_a_thread(records):
                kernel = collect_rows_backward_kernel(*variant)
                launch_walk(records, kernel, tiles, inputs, outputs, row_lanes(tiles.tile_size))
            else:
                launch_walk(records, collect_backward_kernel(*variant), tiles, inputs, [*outputs, None])
        if error_rows is not None:
            request.sums_after_backward = _reduce(error_rows[:, None], tiles, len(records), real)[:, 0]
        grad_records = _reduce(grad_rows, tiles, len(records), t.vec4)
        grad_centers = None
        if low_pass:
            grad_centers = _reduce(grad_center_rows[:, None], tiles, len(records), t.vec3)[:, 0]
        return grad_records, grad_centers, *(None,) * 6
