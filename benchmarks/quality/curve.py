"""The quality benchmark's curves: a metric over the number of primitives."""

import statistics
from pathlib import Path

from benchmarks.quality.results import UNITS, Results
from benchmarks.quality.rows import DEFAULT, PEERS

Curves = dict[str, list[tuple[int, float, float]]]


def curves_of(results: Results, scene: str, metric: str, iterations: int) -> Curves:
    """Return the curves of our default and of gsplat's rows, with photos at full size.

    Returns:
        By row, for those that have results: (primitives, mean over seeds, their standard deviation), by size.
    """
    rows = (DEFAULT.name, *(row.name for row in PEERS))
    found: dict[str, dict[int, list[float]]] = {row: {} for row in rows}
    for job, result in results.items():
        which = (job.scene, job.variant, job.iterations, job.downscale)
        named = job.row in found and which == (scene, "", iterations, 1)
        if named and result[metric] is not None:
            found[job.row].setdefault(job.size, []).append(result[metric])
    return {
        row: [(n, statistics.fmean(x), statistics.stdev(x) if len(x) > 1 else 0.0) for n, x in sorted(sizes.items())]
        for row, sizes in found.items()
        if sizes
    }


def draw_curves(curves: Curves, scene: str, metric: str, file: Path) -> None:
    """Save a picture of the curves that have several points; needs matplotlib."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    curves = {name: points for name, points in curves.items() if len(points) > 1}
    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for name, points in curves.items():
        sizes, means, spreads = zip(*points, strict=True)
        label = "nexwarp" if name == DEFAULT.name else name
        axes.errorbar(sizes, means, yerr=spreads, marker="o", capsize=3, label=label)
    ticks = sorted({size for points in curves.values() for size, _, _ in points})
    better = "lower is better" if metric in ("flip", "lpips") else "higher is better"
    axes.set(xscale="log", xlabel="primitives", ylabel=f"{UNITS[metric]}, {better}")
    axes.set_title(f"{scene}, test views; bars: standard deviation over seeds", fontsize="medium")
    axes.set_xticks(ticks, [f"{size / 1000:.0f}K" for size in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(file, dpi=150)
    pyplot.close(figure)
