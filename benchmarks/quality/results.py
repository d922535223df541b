"""The quality benchmark's results file, one JSON line per training, and its table."""

import dataclasses
import json
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.quality.jobs import TrainingJob

METRICS = {"psnr": ("PSNR [dB]", 2), "ssim": ("SSIM", 4), "flip": ("FLIP", 4), "lpips": ("LPIPS", 4)}
COLUMNS = METRICS | {
    "train_psnr": ("train [dB]", 2),
    "megabytes": ("MB", 1),
    "seconds": ("s", 0),
    "peak_mib": ("MiB", 0),
}

Results = dict[TrainingJob, dict[str, Any]]


def read_results(paths: Iterable[Path]) -> Results:
    """Return results by job; of two results of one job, the later one.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a line is not the result of a training; the message names file and line.
    """
    defaults = {f.name: f.default for f in dataclasses.fields(TrainingJob)}  # lines of older versions lack some fields
    results = {}
    for path in paths:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            try:
                result = json.loads(line)
                job = TrainingJob(**{name: result.get(name, default) for name, default in defaults.items()})
                complete = "psnr" in result and all(x is not dataclasses.MISSING for x in vars(job).values())
            except (ValueError, AttributeError):
                complete = False
            if not complete:
                raise ValueError(f"{path}, line {number}: expected the JSON of a training, got {line[:60]!r}")
            results[job] = result
    return results


def drop_unfinished(path: Path) -> bool:
    """Cut off a last line that a killed program left unfinished; return whether there was one."""
    text = path.read_bytes()
    end = text.rfind(b"\n") + 1
    if end == len(text):
        return False
    with path.open("r+b") as file:
        file.truncate(end)
    return True


def result_line(job: TrainingJob, result: dict[str, Any]) -> str:
    """Return a training's figures as a line of text."""
    facts = [f"{title} {result[m]:.{digits}f}" for m, (title, digits) in METRICS.items() if result[m] is not None]
    return (
        f"{job.scene}{job.variant} {job.row} {job.size} seed {job.seed}: {', '.join(facts)}, {result['seconds']:.0f} s"
    )


def mean_of_known(values: Iterable[float | None]) -> float | None:
    """Return the mean of those values that are there; None without any."""
    known = [x for x in values if x is not None]
    return statistics.fmean(known) if known else None


def table(results: Results) -> str:
    """Return Markdown: means and standard deviations over seeds, by scene, variant, size and iterations."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for job, result in results.items():
        key = (job.scene, job.variant, job.downscale, job.size, job.iterations, job.row)
        groups.setdefault(key, []).append(result)
    header = ["scene", "size", "iterations", "row", *(title for title, _ in COLUMNS.values()), "seeds"]
    lines = []
    for (scene, variant, downscale, size, iterations, row), members in sorted(groups.items(), key=lambda x: x[0]):
        name = f"{scene} {variant}".strip() + (f", photos reduced by {downscale}" if downscale > 1 else "")
        figures = [_spread([r.get(figure) for r in members], digits) for figure, (_, digits) in COLUMNS.items()]
        lines.append([name, f"{size:,}", f"{iterations:,}", row, *figures, str(len(members))])
    return markdown(header, lines)


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a table of cells."""
    head, *rest = (f"| {' | '.join(cells)} |" for cells in (header, *lines))
    return "\n".join([head, "|---" * len(header) + "|", *rest])


def _spread(values: list[float | None], digits: int) -> str:
    known = [x for x in values if x is not None]
    if not known:
        return ""
    deviation = f" ± {statistics.stdev(known):.{digits}f}" if len(known) > 1 else ""
    return f"{statistics.fmean(known):.{digits}f}{deviation}"
