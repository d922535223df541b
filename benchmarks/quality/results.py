"""The quality benchmark's results file: one JSON line per training."""

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.quality.jobs import TrainingJob

METRICS = ("psnr", "ssim", "flip", "lpips")
OTHERS = ("train_psnr", "zoom_psnr", "quarter_psnr")
UNITS = {"psnr": "PSNR [dB]", "ssim": "SSIM", "flip": "FLIP", "lpips": "LPIPS"}
UNITS |= {"train_psnr": "train [dB]", "zoom_psnr": "zoom [dB]", "quarter_psnr": "at 1/4 [dB]"}
DIGITS = {"psnr": 2, "ssim": 4, "flip": 4, "lpips": 4, "train_psnr": 2, "zoom_psnr": 1, "quarter_psnr": 2}

Results = dict[TrainingJob, dict[str, Any]]


def read_results(paths: Iterable[Path]) -> Results:
    """Return results by job; of two results of one job, the later one.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a line is not the result of a training; the message names file and line.
    """
    defaults = {f.name: f.default for f in dataclasses.fields(TrainingJob)}  # lines of older versions lack some fields
    found = {}
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
    with path.open("ab") as file:  # the line lacks only its end
        file.write(b"\n")
    return False


def result_line(job: TrainingJob, result: dict[str, Any]) -> str:
    """Return a training's figures as a line of text."""
    facts = [f"{UNITS[m]} {result[m]:.{DIGITS[m]}f}" for m in METRICS if result[m] is not None]
    facts += [f"{k[:-5]} {result[k]:.2f} dB" for k in OTHERS if k in result]
    facts.append(f"{result['seconds']:.0f} s")
    return f"{job.scene}{job.variant} {job.row} {job.size} seed {job.seed}: {', '.join(facts)}"
