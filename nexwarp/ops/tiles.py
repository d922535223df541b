"""Tile lists: which surfels may be seen in which tile of the image, near to far."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
import warp as wp

from nexwarp.kernels import tile_lists as kernels
from nexwarp.kernels.launch import UNEVEN
from nexwarp.kernels.tiles import LARGEST_INT, MAX_CORNERS, MAX_ENTRIES, tile_polygon
from nexwarp.native.warp import tile_size_on
from nexwarp.ops._interop import launch, stream_of, warp_array, warp_streams
from nexwarp.ops.memory import check_memory
from nexwarp.ops.project import Pinhole, Projection

# Of the arrays that `intersect_tiles` makes, on a CPU two more than on CUDA.
BYTES_AN_ENTRY = 24

Order = Literal["depth", "distance"]


def check_order(order: object) -> None:
    """Raise ValueError unless `order` is one of `Order`."""
    if order not in get_args(Order):
        raise ValueError(f"order: expected {' or '.join(get_args(Order))}, got {order!r:.60}")


class UnknownLengthError(RuntimeError):
    """A CUDA graph is captured before any rendering of its kind has told how long lists must be."""


@dataclass(frozen=True)
class ListCapacity:
    """What tells whether lists suffice: their length, `ends` and `kind` as in `Tiles`."""

    entries: int
    ends: torch.Tensor
    kind: tuple[int, int]


@dataclass(frozen=True)
class Tiles:
    """Lists of (tile, surfel) entries. Integers, so nothing here is differentiable.

    They are `exact` where they hold exactly the entries that there are. Otherwise unused places are at the end; or,
    where `ends` counts more than M entries, the lists are incomplete and the walk goes over `order`.
    """

    order: torch.Tensor  # (N,) int32, surfels by signed z-depth, or distance, of their centres (float32), ties by index
    ends: torch.Tensor  # (N,) int32, end of the entries of the surfel order[rank] in emission order
    surfel_ids: torch.Tensor  # (M,) int32, surfels by tile, and near to far within a tile
    entries: torch.Tensor  # (M,) int32, emission index of each of those; empty unless `exact`
    tile_offsets: torch.Tensor  # (tiles + 1,) int32, half-open ranges of `surfel_ids` by tile, row by row
    reaches: torch.Tensor  # (N, 2) half the sides of the support rectangle, which |u| and |v| of a hit cannot exceed
    columns: int  # tiles in a row
    exact: bool
    kind: tuple[int, int]  # tile columns and rows: renderings of one kind need about as many entries

    @property
    def room(self) -> ListCapacity:
        """What `fits` needs to know of these lists."""
        return ListCapacity(len(self.surfel_ids), self.ends, self.kind)


def intersect_tiles(
    surfels: Sequence[torch.Tensor],
    projection: Projection,
    viewmat: torch.Tensor,
    camera: Pinhole,
    *,
    blending: Order = "depth",
    room: int | None = None,
) -> Tiles:
    """List, for each tile, the surfels (means, quats, scales, opacities, gammas) whose support touches it.

    `room` is the number of entries that the lists can hold. By default, on a CPU, it is the exact number; on CUDA,
    where that would cost a wait, an upper bound learnt from earlier renderings. Too few is slow but right.

    Raises:
        ValueError, OutOfMemoryError: there are more than MAX_ENTRIES entries, or more than memory holds; on CUDA only
            when that is noticed without a wait.
    """
    means, *shape = (x.detach().contiguous() for x in surfels)
    count = len(means)
    side = tile_size_on(means.is_cuda)
    kind = columns, rows = -(-camera.width // side), -(-camera.height // side)
    order = _depth_order(projection.centers.detach(), blending)
    corners, margins, reaches = (means.new_empty(count, *x) for x in ((MAX_CORNERS, 2), (), (2,)))
    polygons = (corners, order.new_empty(count, 3), margins)
    inputs = [(*shape, means), viewmat.contiguous(), camera.K.contiguous(), camera.near, rows]
    launch(means, tile_polygon, count, inputs, [reaches, polygons])
    arguments = [order, polygons, wp.vec2i(columns, rows)]
    threads = -(-count // 32) * 32 if means.is_cuda else count  # on a GPU whole warps, which work together
    totals, ends = (torch.empty(count, dtype=x, device=means.device) for x in (torch.int64, torch.int32))
    launch(means, kernels.count, threads, arguments, [totals], sharing=UNEVEN)
    totals.cumsum_(0)
    learns = room is None and means.is_cuda
    exact = room is None and not learns
    if room is None:
        room = _total(totals, columns * rows) if exact else _room(totals, kind)
    # Sorting takes the second half of its arrays as scratch; unused entries sort behind those of the last tile.
    values, tile_ids = ends.new_empty(2 * room), ends.new_empty(2 * room)
    # Sums on a CPU need to know each entry's emission index; elsewhere the surfels themselves are sorted.
    surfel_of = ends.new_empty(room) if exact else None
    emission, lists = [*arguments, totals, threads, columns * rows], [ends, tile_ids[:room], values[:room], surfel_of]
    launch(means, kernels.emit, threads, emission, lists, sharing=UNEVEN)
    if not threads:
        values[:room] = 0
        tile_ids[:room] = columns * rows
    _sort(tile_ids, values, room, (columns * rows).bit_length())
    if learns:
        _ask(ends, kind)
    surfel_ids, entries = values[:room], values[:0]
    if surfel_of is not None:
        surfel_ids, entries = surfel_of.index_select(0, values[:room]), values[:room]
    tiles = torch.arange(columns * rows + 1, dtype=torch.int32, device=means.device)
    offsets = torch.searchsorted(tile_ids[:room], tiles, out_int32=True)
    return Tiles(order, ends, surfel_ids, entries, offsets, reaches, columns, exact, kind)


def _depth_order(centers: torch.Tensor, blending: Order) -> torch.Tensor:
    """Indices of surfels by signed depth, or distance, of their centres (N, 3), ties by index (the sort is stable)."""
    if blending == "distance":
        centers = torch.cat([centers[:, :2], centers.norm(dim=-1, keepdim=True)], dim=-1)
    count = len(centers)
    keys, order = (torch.empty(2 * count, dtype=torch.int32, device=centers.device) for _ in range(2))
    launch(centers, kernels.depth_keys, count, [centers.contiguous()], [keys, order])
    _sort(keys, order, count, 32)
    return order[:count]


def _sort(keys: torch.Tensor, values: torch.Tensor, count: int, bits: int) -> None:
    """Sort the first `count` pairs by the low `bits` bits of their keys, stably, in place."""
    if count == 0:
        return
    sorted_keys, sorted_values = warp_array(keys, wp.uint32), warp_array(values, wp.int32)
    with warp_streams, wp.ScopedStream(stream_of(keys), sync_enter=False):
        wp.utils.radix_sort_pairs(sorted_keys, sorted_values, count, end_bit=bits)


def _total(totals: torch.Tensor, tiles: int) -> int:
    """Return the number of entries; ValueError or OutOfMemoryError when lists cannot be as long."""
    total = int(totals[-1]) if len(totals) else 0
    if total > MAX_ENTRIES:
        number = f"{total:,}{' or more' if total >= LARGEST_INT else ''}"
        raise ValueError(
            f"surfels: expected at most {MAX_ENTRIES:,} (tile, surfel) entries, got {number}, of {len(totals):,} "
            f"surfels and {tiles:,} tiles; render fewer or smaller surfels, or the image in parts (Camera.crop)"
        )
    check_memory(BYTES_AN_ENTRY * total, totals.device, f"a list of {total:,} (tile, surfel) entries")
    return total


@dataclass
class _Need:
    """Entries that renderings of one kind needed: their count arrives later, in pinned memory, without waiting."""

    room: int  # what was given to them
    total: torch.Tensor
    copied: torch.cuda.Event
    most: int = 0  # that is known
    asked: bool = False  # a count is on its way


_needs: dict[tuple[int | None, int, int, int], _Need] = {}


def _room(totals: torch.Tensor, kind: tuple[int, int]) -> int:
    """Capacity of lists on CUDA: what renderings of this kind needed so far, and half as much again.

    Waits for the GPU only for the first rendering of its kind (device, tile grid, number of surfels within a factor of
    two). A later one that needs more is still right, but slow; the next one finds more room. `totals` (N,) are
    integers, the last one the number of entries of this rendering.
    """
    if len(totals) == 0:
        return 0
    key = _key(totals, kind)
    need = _needs.get(key)
    if torch.cuda.is_current_stream_capturing():
        if need is None:
            raise UnknownLengthError("expected a rendering of its kind before one is captured")
        return need.room
    if need is not None and need.asked and need.copied.query():
        need.asked = False
        if int(need.total) > MAX_ENTRIES:
            # That rendering was right, but no list can be as long: count again whether this one's can be made.
            del _needs[key]
            need = None
        else:
            need.most = max(need.most, int(need.total))
            need.room = max(need.room, _with_margin(need.most))
    if need is None:
        room = _with_margin(_total(totals, kind[0] * kind[1]))
        # A scene that grew by splitting has at least the needs it had: one view may show little of it.
        if fewer := _needs.get((key[0], key[1] - 1, *kind)):
            room = max(room, fewer.room)
        with torch.inference_mode(False):  # later renderings write to it in any mode
            total = torch.empty(1, dtype=torch.int32, pin_memory=True)
        need = _needs[key] = _Need(room, total, torch.cuda.Event())
    return need.room


def _ask(ends: torch.Tensor, kind: tuple[int, int]) -> None:
    """Ask the GPU for the number of entries that a rendering of a kind needed, unless an answer is on its way."""
    need = _needs.get(_key(ends, kind))
    if need is None or need.asked or torch.cuda.is_current_stream_capturing():
        return
    need.total.copy_(ends[-1:], non_blocking=True)
    need.copied.record(torch.cuda.current_stream(ends.device))
    need.asked = True


def _key(ends: torch.Tensor, kind: tuple[int, int]) -> tuple[int | None, int, int, int]:
    return (ends.device.index, len(ends).bit_length(), *kind)


def fits(room: ListCapacity, *, margin: bool = True) -> bool:
    """Whether lists that a CUDA graph fills are as long as renderings of their kind need; call after each replay.

    Without `margin`, whether they have held all entries as far as is known now: cameras that move would need a new
    graph whenever they see a little more.
    """
    wanted = _room(room.ends, room.kind)
    _ask(room.ends, room.kind)
    need = None if margin else _needs.get(_key(room.ends, room.kind))
    return (wanted if need is None else need.most) <= room.entries


def _with_margin(total: int) -> int:
    return min(total + total // 2 + 4096, MAX_ENTRIES)
