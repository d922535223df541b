"""The quality benchmark's results: read, put together over seeds, compared with the default, made Markdown."""

import dataclasses
import json
import math
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.quality_rows import DEFAULT, GSPLAT, Job
from nexwarp.run.metrics import CONVENTION

METRICS = ("psnr", "ssim", "flip", "lpips")
OTHERS = ("train_psnr", "zoom_psnr", "quarter_psnr")
COMPARED = (*METRICS, "quarter_psnr")
UNITS = {"psnr": "PSNR [dB]", "ssim": "SSIM", "flip": "FLIP", "lpips": "LPIPS"}
UNITS |= {"train_psnr": "train [dB]", "zoom_psnr": "zoom [dB]", "quarter_psnr": "at 1/4 [dB]"}
DIGITS = {"psnr": 2, "ssim": 4, "flip": 4, "lpips": 4, "train_psnr": 2, "zoom_psnr": 1, "quarter_psnr": 2}


def read_results(paths: Iterable[Path]) -> dict[Job, dict[str, Any]]:
    """Results by job; of two for one job the later counts.

    Raises:
        FileNotFoundError: a file is not there.
        ValueError: a line is not the result of a training; the message names file and line.
    """
    defaults = {f.name: f.default for f in dataclasses.fields(Job)}  # older lines lack what came later
    found = {}
    for path in paths:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            try:
                result = json.loads(line)
                job = Job(**{name: result.get(name, default) for name, default in defaults.items()})
                complete = "psnr" in result and all(x is not dataclasses.MISSING for x in vars(job).values())
            except (ValueError, AttributeError):
                complete = False
            if not complete:
                raise ValueError(f"{path}, line {number}: expected the JSON of a training, got {line[:60]!r}")
            found[job] = result
    return found


def drop_unfinished(path: Path) -> bool:
    """Cut off a last line that a killed program left unfinished; return whether there was one."""
    text = path.read_bytes()
    end = text.rfind(b"\n") + 1
    if end == len(text):
        return False
    try:
        json.loads(text[end:])
    except ValueError:
        with path.open("r+b") as file:
            file.truncate(end)
        return True
    with path.open("ab") as file:  # whole but for its end
        file.write(b"\n")
    return False


def summary(results: dict[Job, dict[str, Any]]) -> list[dict[str, Any]]:
    """Results with seeds together, by scene, variant, downscale, size and length, best PSNR first.

    Each has the settings that differ from its preset, the seeds, and, by figure, [mean, standard deviation] over those
    that have it, None without any: the metrics, `train_psnr`, `zoom_psnr`, `quarter_psnr`, `megabytes`, and `seconds`,
    `rate` (it/s) and `peak_mib` of trainings that ran alone. The standard deviation of one is None. `commits` and
    `configs` are those of its trainings: where there is more than one of the latter, their settings were not the same.
    """
    groups: dict[tuple, list[tuple[Job, dict[str, Any]]]] = {}
    for job, result in results.items():
        key = (job.scene, job.variant, job.downscale, job.size, job.iterations, job.row)
        groups.setdefault(key, []).append((job, result))
    rows: list[dict[str, Any]] = []
    for (scene, variant, downscale, size, iterations, name), found in groups.items():
        each = [result for _, result in found]
        alone = [result for result in each if result.get("jobs") == 1]
        figures = {metric: [r[metric] for r in each] for metric in METRICS}
        figures |= {name: [r.get(name) for r in each] for name in OTHERS}
        figures["megabytes"] = [r["megabytes"] for r in each]
        figures["seconds"] = [r["seconds"] for r in alone]
        figures["rate"] = [iterations / r["seconds"] for r in alone]
        figures["peak_mib"] = [r.get("peak_mib") for r in alone]
        what = {"scene": scene, "variant": variant, "downscale": downscale}
        what |= {"size": size, "iterations": iterations, "row": name}
        known = {"settings": each[0]["settings"], "seeds": sorted(job.seed for job, _ in found)}
        known["commits"] = sorted({r["commit"] for r in each})
        known["configs"] = sorted({r["config"] for r in each if r.get("config")})
        rows.append(what | known | {figure: _spread(values) for figure, values in figures.items()})

    def order(row: dict[str, Any]) -> tuple:
        psnr = (row["psnr"] or [-math.inf])[0]
        return row["scene"], row["variant"], row["downscale"], row["size"], row["iterations"], -psnr

    return sorted(rows, key=order)


def markdown(results: dict[Job, dict[str, Any]], against: str = DEFAULT.name) -> str:
    """All of `summary` and `differences`.

    Args:
        results: by job.
        against: which row to compare with.
    """
    rows = summary(results)
    lines = ["# Quality", "", CONVENTION, ""]
    if any(row["lpips"] is None for row in rows):
        lines += ["LPIPS is left out where the weights of VGG could not be had.", ""]
    if any(row["flip"] is None for row in rows):
        lines += ["FLIP is left out where flip-evaluator was not installed.", ""]
    lines += [
        "Mean ± standard deviation over seeds. FLIP and LPIPS: lower is better. train: PSNR of every 8th training "
        "view. zoom: the middles of the test views at 4 times the focal length, reduced by 4 again, against the "
        "rendering itself. at 1/4: test views rendered at a quarter of the size, against their photos reduced by 4. "
        "s, it/s, MiB: of trainings that ran alone.",
        "",
    ]
    if mixed := [row["row"] for row in rows if len(row["configs"]) > 1]:
        lines += [f"Trained with more than one set of settings: {', '.join(dict.fromkeys(mixed))}.", ""]
    columns = [*UNITS.values(), "MB", "s", "it/s", "MiB", "seeds", "commits"]
    digits = DIGITS | {"megabytes": 1, "seconds": 0, "rate": 1, "peak_mib": 0}
    title = ""
    for row in rows:
        variant = f", {row['variant']}" if row["variant"] else ""
        here = f"{row['scene']}{variant}{_extent(row, row['downscale'])}"
        if here != title:
            lines += [""] * bool(title) + [f"## {here}", "", f"| | {' | '.join(columns)} |"]
            lines += ["|---" * (len(columns) + 1) + "|"]
            title = here
        cells = [_cell(row[figure], digits[figure]) for figure in digits]
        last = f"{len(row['seeds'])} | {', '.join(row['commits'])}"
        lines.append(f"| {row['row']} | " + " | ".join(cells) + f" | {last} |")
    for group in differences(results, against):
        lines += ["", f"## Mean of the scenes less that of {against}{_extent(group, *group['downscales'])}", ""]
        lines += ["± is the standard error that follows from the seeds' spread.", ""]
        lines += [f"| | {' | '.join(UNITS[m] for m in COMPARED)} | scenes |", "|---" * (len(COMPARED) + 2) + "|"]
        for row in group["rows"]:
            cells = [_cell(row[metric], DIGITS[metric], signed=True) for metric in COMPARED]
            lines.append(f"| {row['row']} | {' | '.join(cells)} | {', '.join(row['scenes'])} |")
    return "\n".join([*lines, ""])


def _extent(what: dict[str, Any], *downscale: int) -> str:
    """Of trainings, for a heading."""
    reduced = f", photos reduced by {' and '.join(map(str, downscale))}" if downscale != (1,) else ""
    return f"{reduced}, {what['size']:,} primitives, {what['iterations']:,} iterations"


def differences(results: dict[Job, dict[str, Any]], against: str = DEFAULT.name) -> list[dict[str, Any]]:
    """What each row has more than a certain one, on the mean of the scenes that both were trained on.

    Args:
        results: by job.
        against: that row.

    Returns:
        By size and length of training, where there are two scenes or more (unmoved, all photos; one whose photos are
        reduced differently counts apart), with their `downscales`: `rows`, the best PSNR first, each with its `scenes`
        and, by metric and for `quarter_psnr`, [difference, its standard error], None where a scene lacks it. Each scene
        counts alike, with the means over its seeds; the error is that of the seeds' spread, of their differences where
        each pair began together, None where a scene has one seed alone.
    """
    groups: dict[tuple, dict[str, dict[tuple[str, int], list[dict[str, Any]]]]] = {}
    for job, result in results.items():
        if not job.variant:
            rows = groups.setdefault((job.size, job.iterations), {})
            rows.setdefault(job.row, {}).setdefault((job.scene, job.downscale), []).append(result)
    found = []
    for (size, iterations), rows in sorted(groups.items()):
        base = rows.pop(against, {})
        shown = []
        for name, scenes in rows.items():
            both = [scene for scene in scenes if scene in base]
            if len(both) < 2:
                continue
            figures = {metric: [_difference(scenes[s], base[s], metric) for s in both] for metric in COMPARED}
            means = {m: _mean_difference(x) for m, x in figures.items()}
            shown.append({"row": name, "scenes": sorted(scene for scene, _ in both), "of": both} | means)
        if shown:
            shown.sort(key=lambda row: -(row["psnr"] or [-math.inf])[0])
            reduced = sorted({downscale for row in shown for _, downscale in row.pop("of")})
            found.append({"size": size, "downscales": reduced, "iterations": iterations, "rows": shown})
    return found


def _difference(one: list[dict], two: list[dict], metric: str) -> tuple[float, float | None] | None:
    """Of two means over seeds, and its variance."""
    pairs = {result["seed"]: result for result in two}
    if all(_began_together(result, pairs.get(result["seed"])) for result in one):
        values = [(result.get(metric), pairs[result["seed"]].get(metric)) for result in one]
        spread = None if any(None in x for x in values) else _spread(a - b for a, b in values)
        return spread and (spread[0], None if spread[1] is None else spread[1] ** 2 / len(one))
    spreads = [_spread(result.get(metric) for result in each) for each in (one, two)]
    if None in spreads:
        return None
    (a, s), (b, t) = spreads
    return a - b, None if s is None or t is None else s**2 / len(one) + t**2 / len(two)


def _began_together(one: dict, two: dict | None) -> bool:
    if two is None or one.get("together") is None or one["commit"] != two["commit"]:
        return False
    return one["together"] == two.get("together") and {one["row"], two["row"]} <= {*one["together"]["rows"]}


def _mean_difference(each: list[tuple[float, float | None] | None]) -> list[float | None] | None:
    """[mean, standard error] of differences with their variances."""
    if any(x is None for x in each):
        return None
    values, variances = zip(*each, strict=True)
    error = None if None in variances else math.sqrt(sum(variances)) / len(values)
    return [statistics.fmean(values), error]


def curves_of(
    results: dict[Job, dict[str, Any]], scene: str, metric: str, iterations: int
) -> dict[str, list[tuple[int, float, float]]]:
    """Curves of our default and of gsplat, photos at full size.

    Returns:
        (primitives, mean over seeds, their standard deviation) by size, for each of the two that has results.
    """
    found: dict[str, dict[int, list[float]]] = {}
    for job, result in results.items():
        which = (job.scene, job.variant, job.iterations, job.downscale)
        named = job.row in (DEFAULT.name, GSPLAT) and which == (scene, "", iterations, 1)
        if named and result[metric] is not None:
            found.setdefault(job.row, {}).setdefault(job.size, []).append(result[metric])
    return {
        row: [(n, statistics.fmean(x), statistics.stdev(x) if len(x) > 1 else 0.0) for n, x in sorted(sizes.items())]
        for row, sizes in found.items()
    }


def _spread(values: Iterable[float | None]) -> list[float | None] | None:
    """[mean, standard deviation]; None of nothing."""
    values = [x for x in values if x is not None]
    if not values:
        return None
    return [statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None]


def _cell(values: list[float | None] | None, digits: int, signed: bool = False) -> str:
    formats = f"{'+' * signed}.{digits}f", f".{digits}f"
    pairs = zip(values or (), formats, strict=False)
    return " ± ".join(f"{value:{form}}" for value, form in pairs if value is not None)
