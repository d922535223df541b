"""Choice of the pairs of photos to match, and connected components of the matched pairs."""

from collections.abc import Iterable
from itertools import combinations

TILE = 16  # photos; the pairs of two tiles are matched together, so that their features stay in memory


def exhaustive_pairs(count: int) -> list[tuple[int, int]]:
    """Return all pairs (i, j), i < j, of `count` photos, ordered by tiles."""
    return sorted(combinations(range(count), 2), key=lambda pair: (pair[0] // TILE, pair[1] // TILE, *pair))


def sequential_pairs(count: int, overlap: int) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of `count` photos in sequence.

    Each photo is paired with its next `overlap` successors and with the successors at offsets 2, 4, 8, ...,
    2^(overlap - 1). The first `overlap` offsets wrap around from the last photo to the first, since a capture around an
    object ends where it began.
    """
    offsets = {*range(1, overlap + 1), *(2**k for k in range(overlap) if 2**k < count)}
    pairs = set()
    for i in range(count):
        for offset in offsets:
            # Only the first `overlap` offsets wrap around.
            if i + offset < count or offset <= overlap:
                j = (i + offset) % count
                if i != j:
                    pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def components(nodes: Iterable[str], edges: Iterable[tuple[str, str]]) -> list[set[str]]:
    """Return the connected components of a graph, largest first."""
    group = {node: {node} for node in nodes}
    for one, other in edges:
        if group[one] is not group[other]:
            small, large = sorted((group[one], group[other]), key=len)
            large |= small
            for node in small:
                group[node] = large
    unique = {id(members): members for members in group.values()}.values()
    return sorted(unique, key=lambda members: (-len(members), min(members)))
