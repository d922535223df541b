"""Which photos are compared, and which of them turn out to hang together."""

from collections.abc import Iterable
from itertools import combinations

TILE = 16  # photos: those of two tiles are compared together, so that their features stay in memory


def exhaustive_pairs(count: int) -> list[tuple[int, int]]:
    """Every pair (i, j) of `count` photos, i < j, tile by tile."""
    return sorted(combinations(range(count), 2), key=lambda pair: (pair[0] // TILE, pair[1] // TILE, *pair))


def sequential_pairs(count: int, overlap: int) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of `count` photos in a row: the next `overlap` ones, and those powers of two further on.

    Offsets go round, from the last photos to the first: who walks around a thing ends where the walk began.
    """
    offsets = {*range(1, overlap + 1), *(2**k for k in range(overlap) if 2**k < count)}
    pairs = set()
    for i in range(count):
        for offset in offsets:
            # Far neighbours need not go round: those are found from the other side.
            if i + offset < count or offset <= overlap:
                j = (i + offset) % count
                if i != j:
                    pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def components(nodes: Iterable[str], edges: Iterable[tuple[str, str]]) -> list[set[str]]:
    """Groups of nodes that edges join, largest first."""
    group = {node: {node} for node in nodes}
    for one, other in edges:
        if group[one] is not group[other]:
            small, large = sorted((group[one], group[other]), key=len)
            large |= small
            for node in small:
                group[node] = large
    unique = {id(members): members for members in group.values()}.values()
    return sorted(unique, key=lambda members: (-len(members), min(members)))
