"""Collection pass (paper Sec. 4.2): each pixel's K heaviest hits, their plain colour, and that of all other hits."""

from dataclasses import dataclass

import torch
import warp as wp

from nexwarp.errors import check_tensors
from nexwarp.kernels import collect as kernels
from nexwarp.kernels.collect_backward import collect_backward, reduce_slots
from nexwarp.kernels.launch import Sharing
from nexwarp.kernels.types import MAX_HITS, types
from nexwarp.native.staging import BLOCK_DIM
from nexwarp.native.warp import tile_size_on
from nexwarp.ops._interop import (
    Argument,
    Context,
    Kernel,
    Op,
    contiguous,
    from_fixed_point,
    launch,
    real_of,
    sums_in_fixed_point,
    sums_like,
)
from nexwarp.ops.project import Pinhole, Projection
from nexwarp.ops.tiles import Tiles

CHANNELS = 16  # of a wide walk, besides the three of every walk


@dataclass
class SplatErrorRequest:
    """Request that the backward pass also adds up blended errors; see `Rendering.request_splat_error`.

    `errors` (H, W) of the pixels are set between forward and backward, `sums_after_backward` (N,), what `splat_error`
    would return, by the backward pass.
    """

    errors: torch.Tensor | None = None
    sums_after_backward: torch.Tensor | None = None


@dataclass(frozen=True)
class Walked:
    """What a walk along rays reads: records (N, 4, 4) and limits (N,) of the surfels, their lists, the image plane.

    `channels` (N, 4, 4) are more channels of their colours, or None.
    """

    records: torch.Tensor
    limits: torch.Tensor
    tiles: Tiles
    camera: Pinhole
    channels: torch.Tensor | None = None

    def arguments(self) -> list[Argument]:
        """The fields of the structs `Surfels`, `TileLists` and `View` of the kernels, in their order."""
        tiles, camera = self.tiles, self.camera
        lists = (tiles.surfel_ids, tiles.tile_offsets, tiles.order, tiles.ends)
        view = (camera.K.contiguous(), wp.vec2i(camera.width, camera.height), tiles.columns, camera.near)
        return [(self.records, self.limits, tiles.reaches, self.channels), lists, view]

    def launch(self, kernel: Kernel, arguments: list[Argument], **names: Argument) -> None:
        """Launch a kernel over the pixels of all tiles, with these arguments behind those of `arguments`."""
        pixels = tile_size_on(self.records.is_cuda) ** 2  # of a tile
        threads = pixels * (len(self.tiles.tile_offsets) - 1)
        # All pixels of a tile write to its entries, so one CPU thread must walk them all.
        sharing = Sharing(smallest=pixels, align=pixels, even=False)
        everything = [*self.arguments(), *arguments]
        launch(self.records, kernel, threads, everything, [], block_dim=BLOCK_DIM, sharing=sharing, **names)


@dataclass(frozen=True)
class Hits:
    """Outputs of the collection pass; differentiable but for integers."""

    plain: torch.Tensor  # (H, W, 3) sum of weight * plain colour over the hits outside the buffer (N, paper Eq. 6)
    base: torch.Tensor  # (H, W, 3) the same sum over the hits in the buffer: their colour without a texture
    ids: torch.Tensor  # (H, W, K) int32 surfels, heaviest hit first, -1 in empty slots
    depths: torch.Tensor  # (H, W, K) z-depths in world units, 0 in empty slots
    weights: torch.Tensor  # (H, W, K), 0 in empty slots
    alpha: torch.Tensor  # (H, W) 1 - final transmittance
    stops: torch.Tensor  # (H, W) int32, end of the part of the tile's list that the pixel's walk took
    scene: Walked  # what was walked along
    error_request: SplatErrorRequest  # empty at first
    channels: torch.Tensor | None = None  # (H, W, 16) as `plain`, of sixteen more channels


def collect(
    projection: Projection,
    tiles: Tiles,
    camera: Pinhole,
    *,
    max_hits: int = 2,
    channels: torch.Tensor | None = None,
) -> Hits:
    """Walk every pixel's list front to back; differentiable with respect to the projection's records and `channels`.

    K is `max_hits`, 0 to 8; `channels` (N, 16) are more channels of the plain colour.
    """
    if not 0 <= max_hits <= MAX_HITS:
        raise ValueError(f"max_hits: expected 0 to {MAX_HITS}, got {max_hits}")
    request = SplatErrorRequest()
    if channels is not None:
        check_tensors({"records": (projection.records, ("N", 4, 4)), "channels": (channels, ("N", CHANNELS))})
        channels = channels.contiguous().view(-1, 4, 4)
    stored = None if channels is None else channels.detach()
    scene = Walked(projection.records.detach().contiguous(), projection.limits, tiles, camera, stored)
    outputs = _Collect.apply(projection.records, channels, scene, max_hits, request)
    plain, base, ids, depths, weights, alpha, stops, more = outputs
    more = None if more is None else more.flatten(2)
    return Hits(plain, base, ids, depths, weights, alpha, stops, scene, request, more)


def splat_error(hits: Hits, errors: torch.Tensor) -> torch.Tensor:
    """Return each surfel's sum (N,) over pixels of blending weight * errors (H, W) >= 0. Not differentiable."""
    check_tensors({"errors": (errors, hits.alpha.shape)}, device=hits.alpha.device)
    buffers = (hits.plain, hits.base, hits.ids, hits.depths, hits.weights, hits.alpha, hits.stops)
    outputs = tuple(x.detach() for x in buffers)
    errors = errors.detach().to(hits.alpha.dtype).contiguous()
    _, sums, _ = _backward(hits.scene, (*outputs, None), (*map(torch.zeros_like, outputs), None), errors)
    assert sums is not None
    return sums


class SlotSums:
    """Where a walk adds up what it finds for each surfel.

    On a CPU each (tile, surfel) entry has a slot, which one thread owns, and `reduce` adds up each surfel's slots in a
    fixed order. On CUDA, and on a CPU with lists of a given capacity, each surfel has one slot, to which all its pixels
    add by atomics: in fixed point, if the order must not matter.
    """

    def __init__(
        self, like: torch.Tensor, tiles: Tiles, *, with_errors: bool = False, with_channels: bool = False
    ) -> None:
        self.like, self.tiles, self.exact = like, tiles, tiles.exact
        self.fixed_point = sums_in_fixed_point(like)
        count = len(tiles.entries) if tiles.exact else len(like)
        self.bad = torch.zeros(1, dtype=torch.int32, device=like.device) if self.fixed_point else None
        self.records = sums_like(like, (count, 4, 4), self.fixed_point)
        self.errors = sums_like(like, (count,), self.fixed_point) if with_errors else None
        self.channels = sums_like(like, (count, 4, 4), self.fixed_point) if with_channels else None

    @property
    def names(self) -> dict[str, bool]:
        """What the kernels that add to it depend on."""
        return {"fixed_point": self.fixed_point, "by_place": self.exact}

    def argument(self) -> Argument:
        """The fields of the struct `Sums` of the kernels, in their order."""
        sums = self.records, self.errors, self.channels
        # In fixed point, pairs of a surfel lie one behind the other.
        flat = (x.flatten(1) if self.fixed_point and x is not None else x for x in sums)
        return (*flat, self.tiles.entries if self.exact else None, self.bad)

    def totals(self) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """Sums of the records' gradients (N, 4, 4) and, where asked for, of errors (N,) and channels' (N, 4, 4)."""
        real = real_of(self.like)
        records = self._reduced(self.records, types(real).vec4)
        errors = None if self.errors is None else self._reduced(self.errors[:, None], real)[:, 0]
        channels = None if self.channels is None else self._reduced(self.channels, types(real).vec4)
        return records, errors, channels

    def _reduced(self, slots: torch.Tensor, dtype: type) -> torch.Tensor:
        """Return each surfel's sum (N, columns, ...) of slots (slots, columns, ...), a column being a `dtype`."""
        if self.bad is not None:
            slots = from_fixed_point(slots, self.bad, self.like.dtype)
        if not self.exact:
            return slots
        sums = slots.new_zeros(len(self.like), *slots.shape[1:])
        inputs = [self.tiles.order, self.tiles.ends, slots, slots.shape[1]]
        launch(slots, reduce_slots, len(self.like), inputs, [sums], dtype=dtype)
        return sums


class _Collect(Op):
    @staticmethod
    def forward(
        ctx: Context,
        records: torch.Tensor,
        channels: torch.Tensor | None,
        scene: Walked,
        max_hits: int,
        request: SplatErrorRequest,
    ) -> tuple[torch.Tensor | None, ...]:
        shape = (scene.camera.height, scene.camera.width)
        plain, base = (records.new_empty(*shape, 3) for _ in range(2))
        ids = torch.empty(*shape, max_hits, dtype=torch.int32, device=records.device)
        depths, weights = (records.new_empty(*shape, max_hits) for _ in range(2))
        alphas = records.new_empty(shape)
        stops = torch.empty(shape, dtype=torch.int32, device=records.device)
        more = None if channels is None else records.new_empty(*shape, 4, 4)
        outputs = (plain, base, ids, depths, weights, alphas, stops, more)
        scene.launch(kernels.collect, [outputs], max_hits=max_hits, wide=more is not None)
        ctx.save_for_backward(*outputs)
        ctx.rest = (scene, request)
        ctx.mark_non_differentiable(ids, stops)
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Context, *given: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        (scene, request), outputs = ctx.rest, ctx.saved_tensors
        # Zeros for what nothing depends on, unlike torch's own not for integers.
        missing = [g is None and x is not None and x.is_floating_point() for g, x in zip(given, outputs, strict=True)]
        grads = tuple(torch.zeros_like(x) if m else g for m, g, x in zip(missing, given, outputs, strict=True))
        grad_records, errors, grad_channels = _backward(scene, outputs, grads, request.errors)
        if errors is not None:
            request.sums_after_backward = errors
        return grad_records, grad_channels, None, None, None


def _backward(
    scene: Walked,
    outputs: tuple[torch.Tensor | None, ...],
    grads: tuple[torch.Tensor | None, ...],
    errors: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
    """Gradients of the records (N, 4, 4), sums of weight * error (N,) where there are errors, and of channels."""
    plain, base, _ids, depths, weights, alphas, _stops, channels = contiguous(*grads)
    assert depths is not None
    max_hits, with_errors, wide = depths.shape[-1], errors is not None, channels is not None
    sums = SlotSums(scene.records, scene.tiles, with_errors=with_errors, with_channels=wide)
    incoming = (plain, base, depths, weights, alphas, errors, channels)
    names = {"max_hits": max_hits, "with_errors": with_errors, "wide": wide} | sums.names
    scene.launch(collect_backward, [outputs, incoming, sums.argument()], **names)
    return sums.totals()
