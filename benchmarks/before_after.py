"""Compares two checkouts of nexwarp on one machine: speed, memory, and the quality of trainings.

    python -m benchmarks.before_after /tmp/before . --data ../shared/data --out before_after.json
    python -m benchmarks.before_after /tmp/before . --stages "" --demo
    python -m benchmarks.before_after /tmp/before . --stages "" --fox ../shared/data/fox

Each figure is measured several times, in fresh processes that alternate between the checkouts (before, after, before,
after), so that a change of the machine's speed affects both. Each checkout runs its own `python -m benchmarks`,
`nexwarp` and `benchmarks.quality`. Without a CUDA device the sizes are tiny and tell only that everything runs.

The table lists medians, their range over the repetitions, and the ratio after / before; --out keeps all values. This
script imports nothing of nexwarp.
"""

import argparse
import datetime
import functools
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

STAGES = ("train_step", "frame", "collect")
MODEL_FILE, METRICS_FILE = "model.safetensors", "metrics.json"
HERE = Path(__file__).resolve().parents[1]
SHOWN = 4000  # characters of a failed process's stderr

Values = dict[tuple[str, str, str], float]  # (name, scene, unit) -> value of one repetition


@dataclass(frozen=True)
class Checkout:
    """One of the two checkouts.

    Attributes:
        name: "before" or "after".
        root: its repository root.
    """

    name: str
    root: Path

    def python(self, *arguments: str) -> str:
        """Run Python in this checkout, in a process of its own, and return what it prints.

        Raises:
            RuntimeError: its exit code is not 0.
        """
        environment = os.environ | {"PYTHONPATH": str(self.root)}
        command = [sys.executable, *arguments]
        done = subprocess.run(command, cwd=self.root, env=environment, capture_output=True, text=True)
        if done.returncode != 0:
            told = f"{self.name}, {self.root}: exit code {done.returncode} of {' '.join(command)}"
            raise RuntimeError(f"{told}\n{done.stdout[-SHOWN:]}{done.stderr[-SHOWN:]}")
        return done.stdout

    def commit(self) -> str:
        """Return its commit; "unknown" without git."""
        git = ["git", "describe", "--always", "--dirty"]
        try:
            done = subprocess.run(git, cwd=self.root, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return "unknown"
        return done.stdout.strip()


@dataclass
class Metric:
    """One figure of both checkouts.

    Attributes:
        name: what was measured.
        scene: what it was measured on.
        unit: of the values.
        before, after: a value for each repetition.
    """

    name: str
    scene: str
    unit: str
    before: list[float] = field(default_factory=list)
    after: list[float] = field(default_factory=list)

    @property
    def ratio(self) -> float | None:
        """Median after / median before; None where a side is missing or the divisor is 0."""
        if not self.before or not self.after or statistics.median(self.before) == 0:
            return None
        return statistics.median(self.after) / statistics.median(self.before)

    def facts(self) -> dict[str, Any]:
        """Return all that is known, for JSON; `spread` is the range over the repetitions."""
        found: dict[str, Any] = {"name": self.name, "scene": self.scene, "unit": self.unit, "ratio": self.ratio}
        for side, values in (("before", self.before), ("after", self.after)):
            median = statistics.median(values) if values else None
            spread = [min(values), max(values)] if values else None
            found[side] = {"median": median, "spread": spread, "values": values}
        return found


def alternate(checkouts: Sequence[Checkout], repeats: int, measure: Callable[[Checkout], Values]) -> list[Metric]:
    """Measure the checkouts in turns; return the metrics in the order in which they first appear."""
    metrics: dict[tuple[str, str, str], Metric] = {}
    for number in range(1, repeats + 1):
        for checkout in checkouts:
            print(f"  {number} of {repeats}, {checkout.name}", file=sys.stderr, flush=True)
            for key, value in measure(checkout).items():
                getattr(metrics.setdefault(key, Metric(*key)), checkout.name).append(value)
    return list(metrics.values())


def stage_values(checkout: Checkout, stage: str, *, cuda: bool, data: Path) -> Values:
    """Run a stage of a checkout's `python -m benchmarks` and return its medians and peak memory."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.jsonl"
        flags = ["--device", "cuda"] if cuda else ["--device", "cpu", "--quick"]
        checkout.python("-m", "benchmarks", "--only", stage, *flags, "--data", str(data), "--out", str(out))
        rows = [json.loads(line) for line in out.read_text().splitlines()]
    values: Values = {}
    for row in rows:
        values[row["name"], row["scene"], row["unit"]] = row["median"]
        if row["peak_mib"] is not None:
            values[f"{row['name']}, peak memory", row["scene"], "MiB"] = row["peak_mib"]
    return values


def demo_values(checkout: Checkout, flags: Sequence[str]) -> tuple[Values, str]:
    """Train the demo with a checkout's `nexwarp train demo --device cpu`.

    Returns:
        Seconds of the command, seconds of the steps and test PSNR (both from the run's metrics.json); and the digest
        of the model's tensors.
    """
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        start = time.perf_counter()
        checkout.python("-m", "nexwarp", "train", "demo", "--device", "cpu", "--run", str(run), *flags)
        wall = time.perf_counter() - start
        metrics = json.loads((run / METRICS_FILE).read_bytes())
        digest = tensors_digest(run / MODEL_FILE)
    values = {("whole command", "demo", "s"): wall, ("training steps", "demo", "s"): metrics["seconds"]}
    if metrics.get("psnr") is not None:
        values["test PSNR", "demo", "dB"] = metrics["psnr"]
    return values, digest


def fox_values(checkout: Checkout, scene: Path, flags: Sequence[str]) -> Values:
    """Train a scene with a checkout's `benchmarks.quality`, by default at 40,000 surfels; return its figures."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.jsonl"
        table = ["--tables", "paper", "--only", "default", "--scenes", scene.name, "--seeds", "0"]
        checkout.python(
            "-m", "benchmarks.quality", "train", *table, "--data", str(scene.parent), "--out", str(out), *flags
        )
        (result,) = [json.loads(line) for line in out.read_text().splitlines()]
    units = {"psnr": "dB", "ssim": "", "flip": "", "quarter_psnr": "dB", "megabytes": "MB", "seconds": "s"}
    units |= {"peak_mib": "MiB", "primitives": ""}
    return {(name, scene.name, unit): result[name] for name, unit in units.items() if result.get(name) is not None}


def tensors_digest(path: Path) -> str:
    """Return a digest of the tensors of a safetensors file, whatever its metadata and their order."""
    content = path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    digest = hashlib.sha256()
    for name in sorted(header.keys() - {"__metadata__"}):
        entry = header[name]
        first, last = (8 + length + offset for offset in entry["data_offsets"])
        digest.update(f"{name} {entry['dtype']} {entry['shape']}".encode() + content[first:last])
    return digest.hexdigest()[:16]


def table(metrics: Sequence[Metric]) -> str:
    """Return metrics as lines of text."""
    rows = [("", "scene", "before", "after", "unit", "after / before")]
    for m in metrics:
        ratio = "" if m.ratio is None else f"{m.ratio:.4f}"
        rows.append((m.name, m.scene, _side(m.before), _side(m.after), m.unit, ratio))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join("  ".join(x.ljust(w) for x, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def _side(values: Sequence[float]) -> str:
    if not values:
        return "missing"
    return f"{statistics.median(values):.6g} ({min(values):.6g} to {max(values):.6g})"


def compare(given: argparse.Namespace, checkouts: Sequence[Checkout]) -> dict[str, Any]:
    """Measure all that is asked for, and write it to `given.out` after each part."""
    cuda = given.device == "cuda"
    report: dict[str, Any] = {
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat("T", "seconds"),
        "device": given.device,
        **{c.name: {"root": str(c.root), "commit": c.commit()} for c in checkouts},
        "parts": {},
    }
    digests: dict[str, list[str]] = {c.name: [] for c in checkouts}

    def measure_demo(checkout: Checkout) -> Values:
        values, digest = demo_values(checkout, given.demo_flags.split())
        digests[checkout.name].append(digest)
        return values

    def part(name: str, repeats: int, measure: Callable[[Checkout], Values]) -> None:
        print(f"{name} ...", file=sys.stderr, flush=True)
        metrics = alternate(checkouts, repeats, measure)
        report["parts"][name] = [m.facts() for m in metrics]
        if name == "demo":
            report["demo_tensors"] = digests | {"equal": len({*digests["before"], *digests["after"]}) == 1}
        print(f"{name}\n{table(metrics)}\n", flush=True)
        if given.out is not None:
            given.out.write_text(json.dumps(report, indent=1) + "\n")

    for stage in filter(None, given.stages.split(",")):
        part(stage, given.repeats, functools.partial(stage_values, stage=stage, cuda=cuda, data=given.data))
    if given.demo:
        part("demo", given.repeats, measure_demo)
        print(f"the models' tensors are {'equal' if report['demo_tensors']['equal'] else 'DIFFERENT'}\n")
    if given.fox is not None:
        scene = given.fox.resolve()
        part("fox", given.fox_repeats, lambda c: fox_values(c, scene, given.fox_flags.split()))
    return report


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    description = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.before_after", description=description)
    add = parser.add_argument
    add("before", type=Path, help="root of the older checkout")
    add("after", type=Path, help="root of the newer checkout")
    add("--stages", default=",".join(STAGES), help='of `python -m benchmarks`; "" for none (default: %(default)s)')
    add("--repeats", type=int, default=3, help="of each stage and of the demo (default: %(default)s)")
    add("--device", choices=("cuda", "cpu"), help="of the stages; default: cuda where there is one")
    add("--data", type=Path, default=HERE.parent / "shared" / "data", help="folder with garden_points.npz and scenes")
    add("--demo", action="store_true", help="also train the demo on the CPU")
    add("--demo-flags", default="", help='more options of `nexwarp train demo`, such as "--iterations 100"')
    add("--fox", type=Path, help="also train this scene at 40,000 surfels, as `benchmarks.quality` does")
    add("--fox-repeats", type=int, default=1, help="trainings of it for each checkout (default: %(default)s)")
    add("--fox-flags", default="", help='more options of `benchmarks.quality train`, such as "--iterations 1000"')
    add("--out", type=Path, help="JSON file to write")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    parser = make_parser()
    given = parser.parse_args(arguments)
    checkouts = [Checkout("before", given.before.resolve()), Checkout("after", given.after.resolve())]
    for checkout in checkouts:
        if not (checkout.root / "benchmarks" / "__main__.py").is_file():
            parser.error(f"{checkout.name}: expected the root of a checkout of nexwarp, got {checkout.root}")
    given.data = given.data.resolve()
    if given.device is None:
        there = checkouts[1].python("-c", "import torch; print(torch.cuda.is_available())")
        given.device = "cuda" if there.strip() == "True" else "cpu"
    compare(given, checkouts)
    return 0


if __name__ == "__main__":
    sys.exit(main())
