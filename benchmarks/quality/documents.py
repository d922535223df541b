"""Markdown of the documents' tables, by the names of the blocks that they fill."""

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from benchmarks.quality.jobs import DEFAULT, ITERATIONS, PEERS, RAW, RAW_PEER, SCENES, SIZE
from benchmarks.quality.results import Results, markdown

# A block stands between the lines <!-- results: NAME --> and <!-- end of results -->.
BLOCK = re.compile(r"(<!-- results: ([\w-]+) -->\n)(.*?)(<!-- end of results -->)", re.DOTALL)
MISSING = "not run"
PAIRS = (*((scene, size) for size in (SIZE, SIZE // 4) for scene in SCENES), ("train", 400_000))
Cell = Sequence[Mapping[str, Any]]


def blocks(results: Results) -> dict[str, str]:
    """Return the Markdown of each block."""
    full = {
        job: result
        for job, result in results.items()
        if (job.variant, job.downscale, job.iterations) == ("", 1, ITERATIONS)
    }
    return {"readme": readme(full), "peers": peers(full)}


def fill(page: str, tables: Mapping[str, str]) -> str:
    """Return a page with its marked blocks replaced; raise ValueError where it has none, or an unknown one."""
    names = [match[2] for match in BLOCK.finditer(page)]
    if not names or not set(names) <= set(tables):
        raise ValueError(
            f"expected lines <!-- results: NAME --> of {', '.join(tables)}, got {', '.join(names) or 'none'}"
        )
    return BLOCK.sub(lambda match: f"{match[1]}{tables[match[2]]}\n{match[4]}", page)


def cell_of(results: Results, scene: str, row: str, size: int) -> Cell:
    """Return the results of all seeds of a row."""
    return [x for job, x in results.items() if (job.scene, job.row, job.size) == (scene, row, size)]


def best_peer(results: Results, scene: str, size: int) -> Cell:
    """Return the results of the gsplat row with the best mean PSNR; none where none was run."""
    cells = [cell_of(results, scene, row.name, size) for row in PEERS]
    return max(cells, key=lambda cell: mean(cell, "psnr") if cell else float("-inf"))


def mean(cell: Cell, metric: str) -> float:
    """Return the mean over seeds."""
    return sum(result[metric] for result in cell) / len(cell)


def figures(cell: Cell) -> str:
    """Return the means of PSNR, SSIM and FLIP."""
    return f"{mean(cell, 'psnr'):.2f}, {mean(cell, 'ssim'):.4f}, {mean(cell, 'flip'):.4f}" if cell else MISSING


def readme(results: Results) -> str:
    """Return the README's table: 40,000 primitives, raw with LPIPS, and PSNR of the default and gsplat's best row."""
    metrics = {"psnr": 2, "ssim": 4, "lpips": 3}
    lines: list[list[str]] = []
    shown: list[Mapping[str, Any]] = []
    for scene in SCENES:
        own, peer = (cell_of(results, scene, row, SIZE) for row in (RAW.name, RAW_PEER.name))
        exposed = (cell_of(results, scene, DEFAULT.name, SIZE), best_peer(results, scene, SIZE))
        cells = [scene]
        for cell in (own, peer):
            cells += [f"{mean(cell, m):.{n}f}" for m, n in metrics.items()] if cell else [MISSING, "", ""]
        cells += [f"{mean(cell, 'psnr'):.2f}" if cell else MISSING for cell in exposed]
        shown += [result for cell in (own, peer, *exposed) for result in cell]
        lines.append(cells)
    header = ["scene", "nexwarp: PSNR", "SSIM", "LPIPS", "gsplat: PSNR", "SSIM", "LPIPS", "default: PSNR", "best: PSNR"]
    return f"{markdown(header, lines)}\n\n{caption(shown)}"


def peers(results: Results) -> str:
    """Return the comparison with gsplat: as in its example, and the best row of each scene."""
    lines, shown = [], []
    for scene, size in PAIRS:
        own, example = (cell_of(results, scene, row, size) for row in (DEFAULT.name, PEERS[0].name))
        best = best_peer(results, scene, size)
        shown += [*own, *example, *best]
        margin = f"{mean(own, 'psnr') - mean(best, 'psnr'):+.2f} dB" if own and best else MISSING
        lines.append([scene, f"{size:,}", *(figures(cell) for cell in (own, example, best)), margin])
    header = ["scene", "primitives", "nexwarp", "gsplat as in its example", "gsplat, best row", "nexwarp less best"]
    return f"{markdown(header, lines)}\n\n{caption(shown)}"


def caption(shown: Collection[Mapping[str, Any]], command: str = "benchmarks.quality train") -> str:
    """Return by which command, on what and when results were measured."""
    if not shown:
        return f"*To be measured by* `python -m {command}`."
    devices = " and ".join(sorted({str(x["device"]) for x in shown}))
    dates = sorted(str(x["date"]) for x in shown)
    return f"*Measured by* `python -m {command}`, {devices}, {dates[0]} to {dates[-1]}."
