"""The command line that all benchmarks share, and the table."""

import argparse
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import warp as wp

from benchmarks.gpu_time import gpu_time
from benchmarks.timing import ROOT, Measurement, Repeats, figure, measure
from nexwarp.model.model_file import MODEL_FILE


@dataclass(frozen=True)
class Options:
    """What to measure on.

    Attributes:
        device: where.
        quick: tiny scenes and few repeats, to see that everything runs.
        data: folder with garden_points.npz and the scenes.
        model: run folder of a trained fox; None leaves that scene out.
    """

    device: torch.device
    quick: bool = False
    data: Path = ROOT.parent / "shared" / "data"
    model: Path | None = None

    @property
    def cuda(self) -> bool:
        """Whether the device is a GPU."""
        return self.device.type == "cuda"

    def time(self, name: str, run: Callable[[], Any], **facts: Any) -> Measurement:
        """Time one function, see `time_in_turns`."""
        return self.time_in_turns({name: run}, **facts)[0]

    def time_in_turns(self, runs: Mapping[str, Callable[[], Any]], **facts: Any) -> list[Measurement]:
        """Call `timing.measure` on this device, with few repeats when quick."""
        repeats = Repeats(seconds=0.0, warmup=1, least=2) if self.quick else Repeats()
        return measure(runs, self.device, repeats, **facts)

    def gpu_part(self, name: str, run: Callable[[], Any], repeats: int = 10, **facts: Any) -> Measurement:
        """Return the time in which the GPU works for a call; the rest of the call's time is the host's."""
        return figure(f"{name}, GPU's part", gpu_time(run, repeats), self.device, **facts)


Stage = Callable[[Options], list[Measurement]]


def main(stages: dict[str, Stage], arguments: list[str] | None = None) -> int:
    """Run stages on the given devices and print the table; return 1 when a stage failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure nexwarp.")
    parser.add_argument("--only", help=f"stages, comma-separated: {', '.join(stages)}")
    parser.add_argument("--device", choices=("cuda", "cpu", "both"), help="default: all that there is")
    parser.add_argument("--quick", action="store_true", help="tiny scenes, few repeats")
    parser.add_argument("--out", type=Path, help="also write one JSON line a measurement to this file")
    parser.add_argument("--data", type=Path, default=Options.data, help="shared data (default: %(default)s)")
    parser.add_argument("--model", type=Path, metavar="DIR", help="run folder of a trained fox, to be timed too")
    given = parser.parse_args(arguments)
    chosen = given.only.split(",") if given.only else list(stages)
    if unknown := set(chosen) - set(stages):
        parser.error(f"--only: expected some of {', '.join(stages)}, got {', '.join(sorted(unknown))}")
    if given.model is not None and not (given.model / MODEL_FILE).is_file():
        parser.error(f"--model: expected a run folder with a {MODEL_FILE}, got {given.model}")
    kinds = _devices(given.device, parser)
    wp.config.log_level = wp.LOG_WARNING
    if given.out is not None:
        given.out.write_text("")
    results: list[Measurement] = []
    failed = []
    for name in chosen:
        for kind in kinds:
            print(f"{name} on {kind} ...", file=sys.stderr, flush=True)
            device = torch.device("cuda", torch.cuda.current_device()) if kind == "cuda" else torch.device(kind)
            try:
                found = stages[name](Options(device, given.quick, given.data, given.model))
            except Exception:
                # A failing stage must not lose the other stages' figures.
                traceback.print_exc()
                failed.append(f"{name} on {kind}")
                continue
            results += found
            if given.out is not None:
                with given.out.open("a") as file:
                    file.writelines(m.json() + "\n" for m in found)
    print(table(results))
    if given.model is None:
        print("the trained fox was left out: name its run folder with --model DIR")
    if failed:
        print(f"FAILED: {', '.join(failed)}")
    return 1 if failed else 0


def table(results: list[Measurement]) -> str:
    """Return a row for each measurement, then GPU against CPU where both were measured."""
    if not results:
        return "nothing was measured"
    header = ("", "scene", "on", "median", "p10", "p90", "unit", "runs", "peak MiB", "note")
    rows = [
        (m.name, m.scene, m.device, *map(_short, (m.median, m.p10, m.p90)), m.unit, str(m.repeats), *_extras(m))
        for m in results
    ]
    lines = [f"{kind}: {name}" for kind, name in dict.fromkeys((m.device, m.device_name) for m in results)]
    lines += [f"commit {results[0].commit}, {results[0].versions}, {results[0].date}", "", *_aligned([header, *rows])]
    if pairs := _gpu_against_cpu(results):
        lines += ["", *_aligned([("GPU against CPU", "scene", "CPU ms", "GPU ms", "times as fast"), *pairs])]
    return "\n".join(lines)


def _short(value: float) -> str:
    return f"{value:.4g}"


def _extras(m: Measurement) -> tuple[str, str]:
    return "" if m.peak_mib is None else f"{m.peak_mib:,.0f}", m.note


def _gpu_against_cpu(results: list[Measurement]) -> list[tuple[str, ...]]:
    timed = {(m.name, m.scene, m.device): m.median for m in results if m.unit == "ms"}
    return [
        (name, scene, *map(_short, (timed[name, scene, "cpu"], gpu, timed[name, scene, "cpu"] / gpu)))
        for (name, scene, kind), gpu in timed.items()
        if kind == "cuda" and (name, scene, "cpu") in timed
    ]


def _aligned(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _devices(asked: str | None, parser: argparse.ArgumentParser) -> list[str]:
    there = ["cuda", "cpu"] if torch.cuda.is_available() else ["cpu"]
    if asked is None:
        return there
    wanted = ["cuda", "cpu"] if asked == "both" else [asked]
    if missing := set(wanted) - set(there):
        parser.error(f"--device: no {missing.pop()} device here")
    return wanted
