"""Markdown of the documents' tables, by the names of the blocks that they fill."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise

from benchmarks.quality.jobs import CURVE, SCENES
from benchmarks.quality.published import PEER_NAMES, best_peer, best_peer_file, equal_seconds, mean, seeds_of
from benchmarks.quality.results import Results
from benchmarks.quality.rows import DEFAULT, MEGABYTES, PAPER, ROWS, SUSPECTS

MISSING = "not run"
SIZES = (40_000, 10_000)  # of the comparison with gsplat
BUDGETS = {"5 MB": 5.0, "10 MB": 10.0}  # largest compact file, by our row
COUNTS = {row.name: count for row, count in MEGABYTES if row.preset is not None}
PUBLISHED = {("train", 400_000): "21.50, 0.802"}  # arXiv:2512.13796, table of Tanks and Temples
HEADINGS = {
    "gsplat MCMC": "gsplat MCMC as in its example",
    "gsplat MCMC, background": "and background",
    "gsplat MCMC, exposures": "and background, exposures",
    "gsplat MCMC, even start": "and background, exposures, points of our cloud",
    "gsplat MCMC, skybox": "and background, exposures, all our initial points",
    "gsplat default": "gsplat default, background",
    "gsplat 2DGS": "gsplat 2DGS, background",
}
Cell = Sequence[Mapping[str, float]]


def blocks(results: Results, alone: Results | None = None) -> dict[str, str]:
    """Return the Markdown of each block.

    Args:
        results: as of `of_one_default`.
        alone: results of trainings that were alone on their GPU, whose seconds count.
    """
    found = {f"peers-{size}": _peers(results, size) for size in SIZES}
    found |= {"sizes": _sizes(results), "train": _train(results), "megabytes": _megabytes(results)}
    found |= {"suspects": _suspects(results), "short": _short(results), "readme": _readme(results)}
    return found | {"seconds": _equal_seconds(alone or {})}


def figures(found: Cell) -> str:
    """Return PSNR of each seed, or mean and range of more than two; mean SSIM and mean FLIP."""
    if not found:
        return MISSING
    each = " and ".join(f"{x['psnr']:.2f}" for x in found)
    if len(found) > 2:
        least, most = (of(x["psnr"] for x in found) for of in (min, max))
        each = f"{mean(found, 'psnr'):.2f} ({least:.2f} to {most:.2f}, {len(found)} seeds)"
    return f"{each}, {mean(found, 'ssim'):.4f}, {mean(found, 'flip'):.4f}"


def difference(one: Cell, other: Cell) -> str:
    """Return the differences of the means of PSNR, SSIM and FLIP."""
    if not one or not other:
        return MISSING
    psnr, ssim, flip = (mean(one, metric) - mean(other, metric) for metric in ("psnr", "ssim", "flip"))
    return f"{psnr:+.2f} dB, {ssim:+.4f}, {flip:+.4f}"


def _table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    head, *rest = (f"| {' | '.join(cells)} |" for cells in (header, *lines))
    return "\n".join([head, "|---" * len(header) + "|", *rest])


def _listed(values: Iterable[str]) -> str:
    """Return different values in their order: "a", "a and b", "a, b and c"."""
    *most, last = sorted(set(values)) or [""]
    return f"{', '.join(most)} and {last}" if most else last


def _measured(results: Results, tables: str, sizes: Iterable[int], rows: Iterable[str], short: bool = False) -> str:
    """Return the line below a table: command, devices, dates, and unless `short` commits and seeds of what it shows."""
    sizes, rows = set(sizes), set(rows)
    shown = {job: x for job, x in results.items() if job.size in sizes and job.row in rows}
    if not shown:
        return f"*To be measured by* `python -m benchmarks.quality train --tables {tables}`."
    kinds = {"nexwarp": DEFAULT.preset, "paper's preset": PAPER.preset, "gsplat": None}
    facts = []
    for kind, preset in kinds.items():
        of = {job: x for job, x in shown.items() if ROWS[job.row].preset == preset}
        if of:
            keys = ("device", "date") if short else ("device", "date", "commit")
            named = ", ".join(_listed(str(x[key]) for x in of.values()) for key in keys)
            seeds = sorted({job.seed for job in of})
            of_seeds = "" if short else f", seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
            facts.append(f"{kind} {named}{of_seeds}")
    return f"*Measured by* `python -m benchmarks.quality train --tables {tables}`: {'; '.join(facts)}."


def _peers(results: Results, size: int) -> str:
    shown = [name for name in PEER_NAMES if any(seeds_of(results, scene, name, size) for scene in SCENES)]
    lines = []
    for scene in SCENES:
        cells = {name: seeds_of(results, scene, name, size) for name in (DEFAULT.name, *shown)}
        own, best = cells[DEFAULT.name], best_peer(results, scene, size)
        margin = MISSING if best is None else difference(own, best[1])
        lines.append([scene, figures(own), *(figures(cells[name]) for name in shown), margin])
    header = ["scene", "nexwarp", *(HEADINGS[name] for name in shown), "nexwarp less the best gsplat"]
    absent = [name for name in PEER_NAMES if name not in shown]
    told = [f"Not run with {size:,}: {'; '.join(absent)}.", ""] if absent else []
    caption = _measured(results, "peers", [size], (DEFAULT.name, *PEER_NAMES))
    return "\n".join([_table(header, lines), "", *told, caption])


def _falls(results: Results, scene: str) -> float | None:
    """Return the largest fall of PSNR from one size to the next that was run, dB; None with fewer than two."""
    known = [mean(found, "psnr") for n in CURVE if (found := seeds_of(results, scene, DEFAULT.name, n))]
    return max((a - b for a, b in pairwise(known)), default=None)


def _sizes(results: Results) -> str:
    lines = []
    for scene in SCENES:
        fall = _falls(results, scene)
        cells = [figures(seeds_of(results, scene, DEFAULT.name, size)) for size in CURVE]
        lines.append([scene, *cells, MISSING if fall is None else f"{max(fall, 0.0):.2f} dB"])
    header = ["scene", *(f"{size:,}" for size in CURVE), "largest fall of PSNR"]
    return f"{_table(header, lines)}\n\n{_measured(results, 'sizes', CURVE, [DEFAULT.name])}"


def _train(results: Results) -> str:
    sizes, lines = (400_000, 100_000, 40_000, 10_000), []
    for size in sizes:
        cells = {name: seeds_of(results, "train", name, size) for name in (DEFAULT.name, PAPER.name)}
        best = best_peer(results, "train", size)
        peer = MISSING if best is None else f"{figures(best[1])} ({best[0]})"
        own = [figures(cells[name]) for name in (DEFAULT.name, PAPER.name)]
        lines.append([f"{size:,}", *own, PUBLISHED.get(("train", size), "not given"), peer])
    header = ["primitives", "default", "`--preset paper`", "publication: PSNR, SSIM", "best gsplat"]
    of_train = {job: x for job, x in results.items() if job.scene == "train"}
    caption = _measured(of_train, "paper,peers --scenes train", sizes, (DEFAULT.name, PAPER.name, *PEER_NAMES))
    return f"{_table(header, lines)}\n\n{caption}"


def _megabytes(results: Results) -> str:
    lines: list[list[str]] = []
    shown = set(BUDGETS)
    sums: dict[str, list[list[float]]] = {name: [] for name in BUDGETS}
    for scene in SCENES:
        cells = [scene]
        for name, budget in BUDGETS.items():
            own = seeds_of(results, scene, name, COUNTS[name], part="compact")
            best = best_peer_file(results, scene, budget)
            row, peer = ("", []) if best is None else best
            shown.add(row.rpartition(", ")[0])
            if own and peer:
                sums[name].append([mean(own, m) - mean(peer, m) for m in ("psnr", "ssim", "flip")])
            told = f"{figures(peer)} ({row.removeprefix('gsplat MCMC, ')})" if row else MISSING
            cells += [figures(own), told, difference(own, peer)]
        lines.append(cells)
    means = ["mean"]
    for name in BUDGETS:
        each = [sum(x) / len(x) for x in zip(*sums[name], strict=True)]
        whole = len(sums[name]) == len(SCENES)  # a mean of some would favour one side
        means += ["", "", f"{each[0]:+.2f} dB, {each[1]:+.4f}, {each[2]:+.4f}" if whole else MISSING]
    header = ["scene", *(f"{n}: {x}" for n in BUDGETS for x in ("nexwarp", "best gsplat", "difference"))]
    caption = _measured(results, "megabytes", {job.size for job in results if job.row in shown}, shown)
    return f"{_table(header, [*lines, means])}\n\n{caption}"


def _equal_seconds(alone: Results) -> str:
    lines, shown = [], []
    for scene in SCENES:
        found = equal_seconds(alone, scene)
        if found is None:
            lines.append([scene, *[MISSING] * 6])
            continue
        own, job, peer = found
        shown += [own, peer]
        told = f"{figures([peer])} ({job.row.removeprefix('gsplat MCMC, ')}, {job.iterations:,})"
        cells = [f"{own['seconds']:.0f} s", figures([own]), f"{peer['seconds']:.0f} s", told, difference([own], [peer])]
        lines.append([scene, own["device"], *cells])
    header = ["scene", "GPU", "nexwarp", "30,000 iterations", "gsplat", "row, iterations", "difference"]
    named = "; ".join(_listed(str(x[key]) for x in shown) for key in ("date", "commit"))
    caption = f"*{'Measured' if shown else 'To be measured'} by* `python -m benchmarks.quality.equal_seconds`"
    return f"{_table(header, lines)}\n\n{caption}{': ' * bool(shown)}{named}."


def _suspects(results: Results) -> str:
    scenes = [s for s in SCENES if any(seeds_of(results, s, row.name, 40_000) for row in SUSPECTS)] or ["fox"]
    rows = [(row.name, row.name, "") for row in (PAPER, *SUSPECTS)] + [("paper, near plane 0.2", PAPER.name, "near")]
    lines = [
        [told, *(figures(seeds_of(results, s, row, 40_000, variant)) for s in scenes)] for told, row, variant in rows
    ]
    shown = {job: x for job, x in results.items() if job.scene in scenes}
    caption = _measured(shown, "suspects", [40_000], (row.name for row in (PAPER, *SUSPECTS)))
    return f"{_table(['40,000 surfels', *scenes], lines)}\n\n{caption}"


def _margins(results: Results, size: int) -> dict[str, float]:
    """Return the margins over the best gsplat row, dB, of the scenes that have both."""
    found = {}
    for scene in SCENES:
        own = seeds_of(results, scene, DEFAULT.name, size)
        best = best_peer(results, scene, size)
        if own and best is not None:
            found[scene] = mean(own, "psnr") - mean(best[1], "psnr")
    return found


def _short(results: Results) -> str:
    """Return the short answers of the page."""
    lines = []
    for size in SIZES:
        margins = _margins(results, size)
        told = ", ".join(f"{scene} {margin:+.2f} dB" for scene, margin in margins.items()) or MISSING
        lines.append(f"* {size:,} primitives, default less the best gsplat row of the scene: {told}.")
    falls = {scene: fall for scene in SCENES if (fall := _falls(results, scene)) is not None}
    told = ", ".join(f"{scene} {max(fall, 0.0):.2f} dB" for scene, fall in falls.items()) or MISSING
    lines.append(
        f"* Largest fall of PSNR from one number of surfels to the next, of {CURVE[0]:,} to {CURVE[-1]:,}: {told}."
    )
    return "\n".join(lines)


def _readme(results: Results) -> str:
    """Return the table of README.md: means, 40,000 primitives, beside the best gsplat row of each scene.

    Commits and seeds are on the page of all tables.
    """
    columns = ["PSNR [dB]", "SSIM", "FLIP", "MB"]
    metrics = (("psnr", 2), ("ssim", 4), ("flip", 4), ("megabytes", 1))
    lines, named = [], {DEFAULT.name}
    for scene in SCENES:
        own = seeds_of(results, scene, DEFAULT.name, SIZES[0])
        best = best_peer(results, scene, SIZES[0])
        if best is not None:
            named.add(best[0])
        cells = [scene]
        for found in (own, [] if best is None else best[1]):
            cells += [f"{mean(found, m):.{n}f}" for m, n in metrics] if found else [MISSING, "", "", ""]
        lines.append(cells)
    header = ["scene", f"nexwarp: {columns[0]}", *columns[1:], f"gsplat: {columns[0]}", *columns[1:]]
    return f"{_table(header, lines)}\n\n{_measured(results, 'peers', SIZES[:1], named, short=True)}"
