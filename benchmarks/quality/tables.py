"""The quality benchmark's tables: means over seeds, differences from a row, Markdown."""

import math
import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.quality.jobs import TrainingJob
from benchmarks.quality.results import DIGITS, METRICS, OTHERS, UNITS, Results
from benchmarks.quality.rows import DEFAULT
from nexwarp.run.metrics import CONVENTION

COMPARED = (*METRICS, "quarter_psnr")
COLUMNS = {**UNITS, "megabytes": "MB", "seconds": "s", "rate": "it/s", "peak_mib": "MiB"}
COLUMN_DIGITS = {**DIGITS, "megabytes": 1, "seconds": 0, "rate": 1, "peak_mib": 0}
LEGEND = (
    "Mean ± standard deviation over seeds. FLIP and LPIPS: lower is better. train: PSNR of every 8th training "
    "view. zoom: the middles of the test views at 4 times the focal length, reduced by 4 again, against the "
    "rendering itself. at 1/4: test views rendered at a quarter of the size, against their photos reduced by 4. "
    "s, it/s, MiB: of trainings that ran alone."
)
Spread = tuple[float, float | None]  # mean, and standard deviation or error; None of a single value


def summary(results: Results) -> list[dict[str, Any]]:
    """Return results averaged over seeds, by scene, variant, downscale, size and iterations, best PSNR first.

    Each has the settings that differ from its preset, the seeds, and, by figure, (mean, standard deviation) over the
    seeds that have it, None without any: the metrics, `train_psnr`, `zoom_psnr`, `quarter_psnr`, `megabytes`, and
    `seconds`, `rate` (it/s) and `peak_mib` of trainings that ran alone. The standard deviation of a single value is
    None. `commits` and `configs` are those of its trainings: several `configs` mean different settings.
    """
    groups: dict[tuple[Any, ...], list[tuple[TrainingJob, dict[str, Any]]]] = {}
    for job, result in results.items():
        key = (job.scene, job.variant, job.downscale, job.size, job.iterations, job.row)
        groups.setdefault(key, []).append((job, result))
    rows = [_summary_row(found) for found in groups.values()]

    def order(row: dict[str, Any]) -> tuple[Any, ...]:
        psnr = (row["psnr"] or [-math.inf])[0]
        return row["scene"], row["variant"], row["downscale"], row["size"], row["iterations"], -psnr

    return sorted(rows, key=order)


def _summary_row(found: Sequence[tuple[TrainingJob, dict[str, Any]]]) -> dict[str, Any]:
    """Return one row of `summary`, from jobs that differ in their seeds alone."""
    job = found[0][0]
    each = [result for _, result in found]
    alone = [result for result in each if result.get("jobs") == 1]
    figures = {metric: [r[metric] for r in each] for metric in METRICS}
    figures |= {name: [r.get(name) for r in each] for name in OTHERS}
    figures["megabytes"] = [r["megabytes"] for r in each]
    figures["seconds"] = [r["seconds"] for r in alone]
    figures["rate"] = [job.iterations / r["seconds"] for r in alone]
    figures["peak_mib"] = [r.get("peak_mib") for r in alone]
    return {
        "scene": job.scene,
        "variant": job.variant,
        "downscale": job.downscale,
        "size": job.size,
        "iterations": job.iterations,
        "row": job.row,
        "settings": each[0]["settings"],
        "seeds": sorted(job.seed for job, _ in found),
        "commits": sorted({r["commit"] for r in each}),
        "configs": sorted({r["config"] for r in each if r.get("config")}),
        **{figure: _spread(values) for figure, values in figures.items()},
    }


def markdown(results: Results, against: str = DEFAULT.name) -> str:
    """Return `summary` and `differences` as Markdown.

    Args:
        results: by job.
        against: the row to compare with.
    """
    rows = summary(results)
    lines = ["# Quality", "", CONVENTION, ""]
    if any(row["lpips"] is None for row in rows):
        lines += ["LPIPS is left out where the weights of VGG could not be had.", ""]
    if any(row["flip"] is None for row in rows):
        lines += ["FLIP is left out where flip-evaluator was not installed.", ""]
    lines += [LEGEND, ""]
    if mixed := [row["row"] for row in rows if len(row["configs"]) > 1]:
        lines += [f"Trained with more than one set of settings: {', '.join(dict.fromkeys(mixed))}.", ""]
    return "\n".join([*lines, *_summary_lines(rows), *_difference_lines(results, against), ""])


def _summary_lines(rows: Iterable[dict[str, Any]]) -> list[str]:
    """Return a heading and a table for each scene, variant, size and length of training."""
    lines: list[str] = []
    columns = [*COLUMNS.values(), "seeds", "commits"]
    title = ""
    for row in rows:
        variant = f", {row['variant']}" if row["variant"] else ""
        here = f"{row['scene']}{variant}{_extent(row, row['downscale'])}"
        if here != title:
            lines += [""] * bool(title) + [f"## {here}", "", f"| | {' | '.join(columns)} |"]
            lines += ["|---" * (len(columns) + 1) + "|"]
            title = here
        cells = [_cell(row[figure], COLUMN_DIGITS[figure]) for figure in COLUMNS]
        last = f"{len(row['seeds'])} | {', '.join(row['commits'])}"
        lines.append(f"| {row['row']} | " + " | ".join(cells) + f" | {last} |")
    return lines


def _difference_lines(results: Results, against: str) -> list[str]:
    """Return a heading and a table for each group of `differences`."""
    lines = []
    for group in differences(results, against):
        lines += ["", f"## Mean of the scenes less that of {against}{_extent(group, *group['downscales'])}", ""]
        lines += ["± is the standard error that follows from the seeds' spread.", ""]
        lines += [f"| | {' | '.join(UNITS[m] for m in COMPARED)} | scenes |", "|---" * (len(COMPARED) + 2) + "|"]
        for row in group["rows"]:
            cells = [_cell(row[metric], DIGITS[metric], signed=True) for metric in COMPARED]
            lines.append(f"| {row['row']} | {' | '.join(cells)} | {', '.join(row['scenes'])} |")
    return lines


def _extent(what: dict[str, Any], *downscale: int) -> str:
    """Return the size and the length of trainings, for a heading."""
    reduced = f", photos reduced by {' and '.join(map(str, downscale))}" if downscale != (1,) else ""
    return f"{reduced}, {what['size']:,} primitives, {what['iterations']:,} iterations"


def differences(results: Results, against: str = DEFAULT.name) -> list[dict[str, Any]]:
    """Return the difference of each row from a given row, on the mean of the scenes that both were trained on.

    Args:
        results: by job.
        against: the row to compare with.

    Returns:
        By size and length of training, where there are two scenes or more (without variant; one whose photos are
        reduced differently counts apart), with their `downscales`: `rows`, the best PSNR first, each with its `scenes`
        and, by metric and for `quarter_psnr`, (difference, its standard error), None where a scene lacks it. Each scene
        counts alike, with the means over its seeds; the error follows from the seeds' spread, or from the spread of
        their differences where each pair shares its first iterations; None where a scene has a single seed.
    """
    groups: dict[tuple[int, int], dict[str, dict[tuple[str, int], list[dict[str, Any]]]]] = {}
    for job, result in results.items():
        if not job.variant:
            rows = groups.setdefault((job.size, job.iterations), {})
            rows.setdefault(job.row, {}).setdefault((job.scene, job.downscale), []).append(result)
    found = []
    for (size, iterations), rows in sorted(groups.items()):
        base = rows.pop(against, {})
        shown: list[dict[str, Any]] = []
        for name, scenes in rows.items():
            both = [scene for scene in scenes if scene in base]
            if len(both) < 2:
                continue
            row: dict[str, Any] = {"row": name, "scenes": sorted(scene for scene, _ in both), "of": both}
            for metric in COMPARED:
                row[metric] = _mean_difference([_difference(scenes[s], base[s], metric) for s in both])
            shown.append(row)
        if shown:
            shown.sort(key=lambda row: -(row["psnr"] or [-math.inf])[0])
            reduced = sorted({downscale for row in shown for _, downscale in row.pop("of")})
            found.append({"size": size, "downscales": reduced, "iterations": iterations, "rows": shown})
    return found


def _difference(one: list[dict[str, Any]], two: list[dict[str, Any]], metric: str) -> Spread | None:
    """Return the difference of two means over seeds, and its variance in place of a deviation."""
    pairs = {result["seed"]: result for result in two}
    if all(_share_start(result, pairs.get(result["seed"])) for result in one):
        values = [(result.get(metric), pairs[result["seed"]].get(metric)) for result in one]
        known = [x - y for x, y in values if x is not None and y is not None]
        spread = _spread(known) if len(known) == len(values) else None
        return None if spread is None else (spread[0], None if spread[1] is None else spread[1] ** 2 / len(one))
    mine, other = (_spread(result.get(metric) for result in each) for each in (one, two))
    if mine is None or other is None:
        return None
    (a, s), (b, t) = mine, other
    return a - b, None if s is None or t is None else s**2 / len(one) + t**2 / len(two)


def _share_start(one: dict[str, Any], two: dict[str, Any] | None) -> bool:
    """Return whether two trainings share their first iterations."""
    if two is None or one.get("together") is None or one["commit"] != two["commit"]:
        return False
    return one["together"] == two.get("together") and {one["row"], two["row"]} <= {*one["together"]["rows"]}


def _mean_difference(each: Sequence[Spread | None]) -> Spread | None:
    """Return mean and standard error of differences with their variances."""
    known = [x for x in each if x is not None]
    if len(known) < len(each):
        return None
    variances = [variance for _, variance in known if variance is not None]
    error = math.sqrt(sum(variances)) / len(known) if len(variances) == len(known) else None
    return statistics.fmean(value for value, _ in known), error


def _spread(values: Iterable[float | None]) -> Spread | None:
    """Return mean and standard deviation; None without any value."""
    known = [x for x in values if x is not None]
    if not known:
        return None
    return statistics.fmean(known), statistics.stdev(known) if len(known) > 1 else None


def _cell(values: Spread | None, digits: int, signed: bool = False) -> str:
    formats = f"{'+' * signed}.{digits}f", f".{digits}f"
    pairs = zip(values or (), formats, strict=False)
    return " ± ".join(f"{value:{form}}" for value, form in pairs if value is not None)
