"""Experiment: collect's forward pass written once over a pixel block, against the two forms of today, K = 2.

python3 -m benchmarks.bench_pixel_block                  # garden-like on CUDA, a small cloud on a CPU
"""

import sys

import torch
import warp as wp

from benchmarks import suite
from benchmarks.scenes import Scene, entries, geometry, workload
from benchmarks.suite import Options
from benchmarks.timing import Measurement, ratio
from nexwarp.kernels.collect import collect_kernel
from nexwarp.kernels.cpu.collect import collect_simd_kernel, strip_width
from nexwarp.kernels.pixel_block import collect_block_kernel
from nexwarp.kernels.types import types
from nexwarp.ops._interop import array, real_of
from nexwarp.ops.collect import launch_walk, walk_inputs

ROUNDS = 5


def run(options: Options) -> list[Measurement]:
    return [m for scene in workload(options) for hits in (2, 4) for m in forward(scene, options, hits)]


def forward(scene: Scene, options: Options, max_hits: int = 2) -> list[Measurement]:
    """Old and new in turns; the last of `ROUNDS` measurements of each, and whether the buffers are the same."""
    g = geometry(scene)
    with torch.no_grad():
        projection = g.project()
    tiles = g.tiles(projection)
    records, pinhole = projection.records, g.pinhole
    real = real_of(records)
    t = types(real)
    inputs = walk_inputs(records, projection.centers, projection.limits, tiles, pinhole)
    inputs.append(array(tiles.reaches, t.vec2))
    pixels = pinhole.height * pinhole.width
    floats = {"plain": 3, "base": 3, "depths": max_hits, "weights": max_hits, "alphas": 1}
    variant = (real, max_hits, False, tiles.tile_size)
    forms = {"today": (collect_kernel(*variant), 1), "block": (collect_block_kernel(*variant, simd=False), 1)}
    if not options.cuda:
        width = strip_width(tiles.tile_size)
        forms["today, SIMD"] = collect_simd_kernel(*variant), width
        forms["block, SIMD"] = collect_block_kernel(*variant, simd=True), width
    found: dict[str, list[torch.Tensor]] = {}
    timed: dict[str, Measurement] = {}
    facts = scene.facts
    facts["sizes"] |= {"entries": entries(tiles), "max_hits": max_hits}
    for _ in range(1 if options.quick else ROUNDS):
        for name, (kernel, width) in forms.items():
            buffers = {key: records.new_zeros(pixels, columns) for key, columns in floats.items()}
            ids = torch.zeros(pixels, max_hits, dtype=torch.int32, device=records.device)
            stops = torch.zeros(pixels, dtype=torch.int32, device=records.device)
            outputs = [
                array(buffers["plain"], t.vec3),
                array(buffers["base"], t.vec3),
                array(ids, wp.int32),
                array(buffers["depths"], real),
                array(buffers["weights"], real),
                array(buffers["alphas"][:, 0], real),
                array(stops, wp.int32),
            ]
            timed[name] = options.time(
                f"collect, forward, {name}",
                lambda kernel=kernel, width=width, outputs=outputs: launch_walk(
                    records, kernel, tiles, inputs, outputs, width
                ),
                **facts,
            )
            found[name] = [ids, stops, *buffers.values()]
    results = list(timed.values())
    for suffix in ("", ", SIMD") if not options.cuda else ("",):
        old, new = found[f"today{suffix}"], found[f"block{suffix}"]
        same = all(torch.equal(a, b) for a, b in zip(old, new, strict=True))
        worst = max((a.double() - b.double()).abs().max().item() for a, b in zip(old[2:], new[2:], strict=True))
        note = "same bits" if same else f"ids differ in {int((old[0] != new[0]).sum())}, values by {worst:.1g} at most"
        pair = timed[f"block{suffix}"], timed[f"today{suffix}"]
        results.append(ratio(f"block / today{suffix}, K = {max_hits}", *pair, note))
    return results


if __name__ == "__main__":
    sys.exit(suite.main({"pixel_block": run}))
