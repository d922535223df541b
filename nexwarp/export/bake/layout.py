"""Where each surfel's texels lie in the atlas."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch

MAX_SIDE = 256  # texels of one surfel along one axis
FILLED = 0.85  # fraction of the atlas that rectangles cover at most: packing leaves gaps
BISECTIONS = 24
TEXELS_AT_A_TIME = 2**20
LARGEST_TEXEL = 1e6  # pixels
GROWTH = 1.2


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

    def texels(self, ids: torch.Tensor, local: torch.Tensor) -> torch.Tensor:
        """Return places (..., 2) in the atlas, column and row, of coordinates (..., 2) on surfels (...).

        Whole numbers are centres of texels; the coordinates are in units of the scales.
        """
        boxes, rects = self.boxes[ids], self.rects[ids].to(local)
        share = (local - boxes[..., :2]) / (boxes[..., 2:] - boxes[..., :2]).clamp_min(1e-12)
        return rects[..., :2] + share.clamp(0, 1) * (rects[..., 2:] - 1)

    def centres(self) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """Yield the texels, about a million at a time, as an atlas has up to 16 million.

        Places (M, 2) int64, column and row; surfels (M,) int64; coordinates (M, 2) on them.
        """
        textured = self.textured()
        part = self.rects[textured, 2:].long().prod(1).cumsum(0) // TEXELS_AT_A_TIME
        for members in textured.split(part.unique_consecutive(return_counts=True)[1].tolist()):
            yield self._centres(members)

    def _centres(self, textured: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        rects, boxes = self.rects[textured].long(), self.boxes[textured]
        counts = rects[:, 2] * rects[:, 3]
        owner = torch.arange(len(textured), device=rects.device).repeat_interleave(counts)
        index = torch.arange(len(owner), device=rects.device) - (counts.cumsum(0) - counts)[owner]
        inside = torch.stack([index % rects[owner, 2], index // rects[owner, 2]], dim=1)
        share = inside / (rects[owner, 2:] - 1).clamp_min(1)
        local = boxes[owner, :2] + share * (boxes[owner, 2:] - boxes[owner, :2])
        return rects[owner, :2] + inside, textured[owner], local


def lay_out(
    boxes: torch.Tensor,
    textured: torch.Tensor,
    pixels: torch.Tensor,
    *,
    texel: float = 1.0,
    side: int = 4096,
    fewest: int = 2,
) -> Layout:
    """Give each textured surfel (N,) a rectangle for its box (N, 4), in units of the scales.

    One scale covers `pixels` (N, 2) along either axis. `texel`, the size of a texel in pixels, grows until the atlas of
    at most `side` texels a side holds all of them. A surfel has `fewest` texels along an axis where there is room.
    """
    boxes = boxes.where(textured[:, None], 0.0)
    covered = ((boxes[:, 2:] - boxes[:, :2]) * pixels)[textured].double().cpu()

    room = FILLED * side * side
    fewest = max(min(fewest, int(math.sqrt(room / max(len(covered), 1)))), 2)

    def sizes_at(step: float) -> torch.Tensor:
        return ((covered / step).ceil() + 1).clamp(fewest, MAX_SIDE).int()

    low = high = texel
    while _area(sizes_at(high)) > room and high < LARGEST_TEXEL:
        high *= 2
    for _ in range(BISECTIONS if high > low else 0):
        middle = math.sqrt(low * high)
        if _area(sizes_at(middle)) > room:
            low = middle
        else:
            high = middle
    while True:
        sizes = sizes_at(high)
        width = min(side, max(64, 2 ** math.ceil(math.log2(math.sqrt(max(_area(sizes), 1) / FILLED)))))
        places, height = _pack(sizes, width)
        if height <= side and (not len(sizes) or int(sizes[:, 0].max()) <= width):
            break
        if high > LARGEST_TEXEL:
            raise ValueError(f"side: expected a larger atlas than {side} for {len(sizes):,} surfels")
        high *= GROWTH  # the shelves leave more gaps than FILLED allows for
    rects = torch.tensor([0, 0, 1, 1], dtype=torch.int32).repeat(len(boxes), 1)
    rects[textured.cpu()] = torch.cat([places, sizes], dim=1)
    return Layout(rects.to(boxes.device), boxes, width, height)


def _area(sizes: torch.Tensor) -> int:
    return int(sizes.long().prod(1).sum())


def _pack(sizes: torch.Tensor, width: int) -> tuple[torch.Tensor, int]:
    """Place rectangles (M, 2) on shelves, tallest first, below a first row that holds the texel of untextured surfels.

    Returns left and top (M, 2) int32, and the height of the atlas, a multiple of 4.
    """
    order = torch.argsort(sizes[:, 1], descending=True, stable=True)
    places: list[tuple[int, int]] = []
    left, top, tallest = 0, 1, 0
    for across, along in sizes[order].tolist():
        if left + across > width:
            left, top, tallest = 0, top + tallest, 0
        places.append((left, top))
        left, tallest = left + across, max(tallest, along)
    packed = torch.empty_like(sizes)
    packed[order] = torch.tensor(places, dtype=torch.int32).reshape(-1, 2)
    return packed, -(-(top + tallest) // 4) * 4
