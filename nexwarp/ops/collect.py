"""Collection pass (paper Sec. 4.2): each pixel's K heaviest hits, their plain colour, and that of all other hits."""

from dataclasses import dataclass

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from nexwarp.errors import check_tensors
from nexwarp.kernels.collect import collect_kernel
from nexwarp.kernels.collect_backward import collect_backward_kernel
from nexwarp.kernels.reduce import reduce_slots_kernel
from nexwarp.kernels.splat_error import splat_error_kernel
from nexwarp.kernels.types import MAX_HITS, types
from nexwarp.kernels.walk import BLOCK_DIM
from nexwarp.ops._interop import (
    Argument,
    Context,
    array,
    from_fixed_point,
    launch,
    real_of,
    sums_in_fixed_point,
    sums_like,
)
from nexwarp.ops.pinhole import Pinhole
from nexwarp.ops.project import Projection
from nexwarp.ops.tiles import Tiles


@dataclass
class SplatErrorRequest:
    """Request that the backward pass also adds up blended errors; see `Rendering.request_splat_error`.

    Attributes:
        errors: (H, W) error of each pixel, set between forward and backward; None requests nothing.
        sums_after_backward: (N,) what `splat_error` would return; the backward pass sets it.
    """

    errors: torch.Tensor | None = None
    sums_after_backward: torch.Tensor | None = None


@dataclass(frozen=True)
class Hits:
    """Outputs of the collection pass.

    Attributes:
        plain: (H, W, 3) sum of weight * plain colour over the hits outside the buffer (N, paper Eq. 6); differentiable.
        base: (H, W, 3) the same sum over the hits in the buffer: their colour without a texture; differentiable.
        ids: (H, W, K) int32 surfels, heaviest hit first, -1 in empty slots.
        depths: (H, W, K) z-depths in world units, 0 in empty slots; differentiable.
        weights: (H, W, K), 0 in empty slots; differentiable.
        alpha: (H, W) 1 - final transmittance; differentiable.
        stops: (H, W) int32, end of the part of the tile's list that the pixel's walk took.
        error_request: request for blended errors, empty at first.
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
        projection.records.contiguous(),
        projection.centers,
        projection.limits,
        tiles,
        camera,
        max_hits,
        low_pass,
        request,
    )
    plain, base, ids, depths, weights, alpha, stops = buffers
    return Hits(plain, base, ids, depths, weights, alpha, stops, request)


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
    sums = SlotSums(records, tiles)
    slots = sums.new()
    errors = errors.detach().to(records.dtype).contiguous()
    inputs = walk_inputs(records, projection.centers.detach(), projection.limits, tiles, camera)
    pixels = [sums.slots, array(hits.stops.view(-1), wp.int32), array(errors.view(-1), real)]
    variant = (real, low_pass, tiles.tile_size)
    kernel = splat_error_kernel(*variant, sums.fixed_point)
    launch_walk(records, kernel, tiles, inputs + pixels, [sums.array(slots, real), sums.bad_array])
    return sums.reduce(slots[:, None], real)[:, 0]


def launch_walk(
    like: torch.Tensor, kernel: wp.Kernel, tiles: Tiles, inputs: list[Argument], outputs: list[Argument]
) -> None:
    """Launch a kernel over the pixels of all tiles."""
    pixels = tiles.tile_size**2
    count = (len(tiles.tile_offsets) - 1) * pixels
    # All pixels of a tile write to its entries, so one CPU thread must walk them all.
    launch(like, kernel, count, inputs, outputs, block_dim=BLOCK_DIM, align=pixels, smallest=pixels, even=False)


def walk_inputs(
    records: torch.Tensor,
    centers: torch.Tensor,
    limits: torch.Tensor,
    tiles: Tiles,
    camera: Pinhole,
) -> list[Argument]:
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


class SlotSums:
    """Where a walk adds up what it finds for each surfel.

    On a CPU each (tile, surfel) entry has a slot, which one thread owns, and `reduce` adds up each surfel's slots in a
    fixed order. On CUDA, and on a CPU with lists of a given capacity, each surfel has one slot, to which all its pixels
    add by atomics: in fixed point, if the order must not matter.
    """

    def __init__(self, like: torch.Tensor, tiles: Tiles) -> None:
        self.like, self.tiles = like, tiles
        self.count = len(tiles.entries) if tiles.exact else len(like)
        self.slots = array(tiles.entries if tiles.exact else None, wp.int32)
        self.fixed_point = sums_in_fixed_point(like)
        self.bad = torch.zeros(1, dtype=torch.int32, device=like.device) if self.fixed_point else None
        self.bad_array = array(self.bad, wp.int32)

    def new(self, *shape: int) -> torch.Tensor:
        """Zeros (slots, *shape), in fixed point (slots, *shape, 2)."""
        return sums_like(self.like, (self.count, *shape), self.fixed_point)

    def array(self, slots: torch.Tensor | None, dtype: type) -> Argument:
        """View what `new` returned as the kernels do: (slots, ...) of `dtype`, in fixed point (slots, integers)."""
        if slots is not None and self.fixed_point:
            return array(slots.view(len(slots), -1), wp.int64)
        return array(slots, dtype)

    def reduce(self, slots: torch.Tensor, dtype: type) -> torch.Tensor:
        """Return each surfel's sum (N, columns, ...) of slots (slots, columns, ...), a column being a `dtype`."""
        if self.bad is not None:
            slots = from_fixed_point(slots, self.bad, self.like.dtype)
        if not self.tiles.exact:
            return slots
        sums = slots.new_zeros(len(self.like), *slots.shape[1:])
        order, ends = (array(x, wp.int32) for x in (self.tiles.order, self.tiles.ends))
        inputs = [order, ends, array(slots, dtype), slots.shape[1]]
        launch(slots, reduce_slots_kernel(dtype), len(self.like), inputs, [array(sums, dtype)])
        return sums


class _Context(Context):
    rest: tuple[Tiles, Pinhole, int, bool, SplatErrorRequest]


class _Collect(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: _Context,
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
            *(array(x.view(-1, 3), types(real).vec3) for x in (plain, base)),
            _buffer_array(ids, wp.int32),
            _buffer_array(depths, real),
            _buffer_array(weights, real),
            array(alphas.view(-1), real),
            array(stops.view(-1), wp.int32),
        ]
        inputs = [*walk_inputs(records, centers, limits, tiles, camera), array(tiles.reaches, types(real).vec2)]
        variant = (real, max_hits, low_pass, tiles.tile_size)
        launch_walk(records, collect_kernel(*variant), tiles, inputs, outputs)
        ctx.save_for_backward(records, centers, limits, plain, base, ids, weights, alphas, stops)
        ctx.mark_non_differentiable(ids, stops)
        ctx.rest = (tiles, camera, max_hits, low_pass, request)
        return plain, base, ids, depths, weights, alphas, stops

    @staticmethod
    @once_differentiable
    def backward(
        ctx: _Context,
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
        sums = SlotSums(records, tiles)
        inputs = [
            *walk_inputs(records, centers, limits, tiles, camera),
            array(tiles.reaches, t.vec2),
            sums.slots,
            *(array(x.view(-1, 3), t.vec3) for x in (plain, base)),
            _buffer_array(ids, wp.int32),
            _buffer_array(weights, real),
            array(alphas.view(-1), real),
            array(stops.view(-1), wp.int32),
            *(array(x.contiguous().view(-1, 3), t.vec3) for x in (grad_plain, grad_base)),
            *(_buffer_array(x.contiguous(), real) for x in (grad_depths, grad_weights)),
            array(grad_alphas.contiguous().view(-1), real),
            array(None if request.errors is None else request.errors.view(-1), real),
        ]
        variant = (real, max_hits, low_pass, tiles.tile_size, request.errors is not None)
        grad_records = sums.new(4, 4)
        # Centres carry a gradient only through the low-pass.
        grad_centers = sums.new(3) if low_pass else None
        error_sums = None if request.errors is None else sums.new()
        outputs = [sums.array(grad_records, t.vec4), sums.array(grad_centers, t.vec3), sums.array(error_sums, real)]
        kernel = collect_backward_kernel(*variant, sums.fixed_point, tiles.exact)
        launch_walk(records, kernel, tiles, inputs, [*outputs, sums.bad_array])
        if error_sums is not None:
            request.sums_after_backward = sums.reduce(error_sums[:, None], real)[:, 0]
        grad_records = sums.reduce(grad_records, t.vec4)
        if grad_centers is not None:
            grad_centers = sums.reduce(grad_centers[:, None], t.vec3)[:, 0]
        return grad_records, grad_centers, *(None,) * 6


def _buffer_array(buffer: torch.Tensor, dtype: type) -> Argument:
    """View a K-buffer (H, W, K) as the kernels do, (H * W, K); K = 0 gives one unused element."""
    return array(buffer.view(-1, buffer.shape[-1]) if buffer.shape[-1] else buffer.new_empty(1, 1), dtype)
