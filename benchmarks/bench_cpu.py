"""Collection on a CPU: against torch vectorised per tile, and with one thread against two."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import torch

from benchmarks import suite
from benchmarks.scenes import SurfelScene, cloud, geometry, outputs, random_like
from benchmarks.suite import Options
from benchmarks.timing import Measurement, figure, ratio
from nexwarp import ops
from nexwarp.kernels.launch import get_num_threads, set_num_threads
from nexwarp.kernels.types import ALPHA_MAX, ALPHA_MIN, TINY, TRANSMITTANCE_MIN

ROUNDS = 9


def run(options: Options) -> list[Measurement]:
    if options.cuda:
        return []
    return collection(cloud(500, 64, 48) if options.quick else cloud(20_000, 480, 320), options)


def collection(scene: SurfelScene, options: Options) -> list[Measurement]:
    """Time the pass alone, forward + backward, with 1 and 2 threads; our results must agree bit for bit.

    Torch is compared at its better number of threads: on a busy machine its second thread may slow it down.
    """
    g = geometry(scene)
    with torch.no_grad():
        projection = g.project()
    records = projection.records.requires_grad_()
    tiles = g.tiles(projection)
    signals = random_like(outputs(ops.collect(projection, tiles, g.pinhole)))

    def ours() -> list[torch.Tensor]:
        found = outputs(ops.collect(projection, tiles, g.pinhole))
        return [*found, *torch.autograd.grad(found, records, signals)]

    def theirs() -> tuple[torch.Tensor, ...]:
        return torch.autograd.grad(torch_collect(records, tiles, g.pinhole), records, signals)

    bits = []
    for count in (1, 2):
        with threads(count):
            bits.append(ours())
            theirs()
    # In turns, so that a machine that gets slower or faster meanwhile affects all alike.
    times: dict[tuple[str, int], list[float]] = {
        (who, count): [] for who in ("ours", "torch by tile") for count in (1, 2)
    }
    for _ in range(2 if options.quick else ROUNDS):
        for (who, count), values in times.items():
            with threads(count):
                start = time.perf_counter()
                (ours if who == "ours" else theirs)()
                values.append(1e3 * (time.perf_counter() - start))
    timed = {
        (who, count): figure(
            f"collect, forward + backward, {who}, {count} thread{'s' * (count > 1)}",
            values,
            options.device,
            **scene.facts,
        )
        for (who, count), values in times.items()
    }
    mine, others = ([timed[who, count] for count in (1, 2)] for who in ("ours", "torch by tile"))
    different = sum(int((a != b).sum()) for a, b in zip(*bits, strict=True))
    same = figure("values that differ between 1 and 2 threads", different, options.device, unit="", **scene.facts)
    ratios = [
        ratio("torch by tile over ours, 1 thread each", others[0], mine[0]),
        ratio("torch by tile, its better number of threads, over ours, 2", min(others, key=_median), mine[1]),
        ratio("ours, 1 thread over 2", mine[0], mine[1]),
    ]
    return [*mine, *others, *ratios, same]


def _median(m: Measurement) -> float:
    return m.median


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let Warp's launches and torch use this many threads."""
    before = get_num_threads(), torch.get_num_threads()
    set_num_threads(count)
    torch.set_num_threads(count)
    try:
        yield
    finally:
        set_num_threads(before[0])
        torch.set_num_threads(before[1])


def torch_collect(
    records: torch.Tensor, tiles: ops.Tiles, camera: ops.Pinhole, max_hits: int = 2
) -> tuple[torch.Tensor, ...]:
    """`ops.collect` in torch with autograd, all pixels and entries of a tile at once.

    Returns:
        plain (H, W, 3), depths (H, W, K), weights (H, W, K), alpha (H, W).
    """
    size, columns = tiles.tile_size, tiles.columns
    offsets = tiles.tile_offsets.tolist()
    rows = (len(offsets) - 1) // columns
    ids = tiles.surfel_ids.long()
    pieces = [
        _tile(records[ids[start:end]], _rays(tile % columns, tile // columns, size, camera), camera.near, max_hits)
        for tile, (start, end) in enumerate(pairwise(offsets))
    ]
    images = []
    for parts in zip(*pieces, strict=True):
        image = torch.stack(parts).view(rows, columns, size, size, -1).permute(0, 2, 1, 3, 4)
        images.append(image.reshape(rows * size, columns * size, -1)[: camera.height, : camera.width])
    plain, depths, weights, alpha = images
    return plain, depths, weights, alpha[..., 0]


def _rays(column: int, row: int, size: int, camera: ops.Pinhole) -> torch.Tensor:
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    x = (torch.arange(size) + (column * size + 0.5 - cx)) / fx
    y = (torch.arange(size) + (row * size + 0.5 - cy)) / fy
    return torch.stack([*torch.meshgrid(x, y, indexing="xy"), torch.ones(size, size)], dim=-1).view(-1, 3)


def _tile(records: torch.Tensor, rays: torch.Tensor, near: float, max_hits: int) -> tuple[torch.Tensor, ...]:
    """Blend one tile's records (L, 4, 4), near to far, along its rays (P, 3)."""
    pixels, count = len(rays), len(records)
    if count == 0:
        zeros = [rays.new_zeros(pixels, n) for n in (3, max_hits, max_hits, 1)]
        return tuple(zeros)
    a, b, n, rest = records.unbind(1)
    inverse = 1 / (rays @ n[:, :3].T)
    u, v = (rays @ a[:, :3].T) * inverse, (rays @ b[:, :3].T) * inverse
    depth = rest[:, 3] * inverse
    terms = [(gamma * (x * x).clamp_min(TINY).log()).clamp_max(50).exp() for x, gamma in ((u, b[:, 3]), (v, n[:, 3]))]
    exponent = terms[0] + terms[1]
    alpha = (a[:, 3] * torch.exp(-0.5 * exponent)).clamp_max(ALPHA_MAX)
    alpha = torch.where((alpha >= ALPHA_MIN) & (depth > near), alpha, 0.0)
    passed = torch.log1p(-alpha)
    behind = passed.cumsum(1)
    # The hit that takes the transmittance below the limit is the last one.
    reached = (behind - passed).detach().exp() >= TRANSMITTANCE_MIN
    weights = torch.where(reached, alpha * torch.exp(behind - passed), 0.0)
    slots = min(max_hits, count)
    heaviest, chosen = weights.topk(slots, dim=1)
    plain = weights.scatter(1, chosen, 0.0) @ rest[:, :3]
    depths = torch.where(heaviest > 0, depth.gather(1, chosen), 0.0)
    pad = (0, max_hits - slots)
    total = weights.sum(1, keepdim=True)
    return plain, torch.nn.functional.pad(depths, pad), torch.nn.functional.pad(heaviest, pad), total


if __name__ == "__main__":
    sys.exit(suite.main({"cpu": run}))
