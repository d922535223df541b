"""Compares the speed of two checkouts of nexwarp on one machine.

    python -m benchmarks.before_after /tmp/before . --only collect,frame,train_step --repeats 3 --out before_after.json

Each checkout runs its own `python -m benchmarks` in fresh processes, in turns (before, after, before, after), so that a
change of the machine's speed affects both. The table lists medians, their range over the repetitions, and the ratio
after / before; --out keeps all values. This script imports nothing of nexwarp.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

Values = dict[tuple[str, str, str], float]  # (name, scene, unit) -> value of one repetition


def measure(root: Path, options: list[str]) -> Values:
    """Run `python -m benchmarks` in a checkout; raise RuntimeError where it fails."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.jsonl"
        path = os.pathsep.join(filter(None, (str(root), os.environ.get("PYTHONPATH"))))
        command = [sys.executable, "-m", "benchmarks", *options, "--out", str(out)]
        run = subprocess.run(command, cwd=root, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)
        if run.returncode:
            raise RuntimeError(f"{root}: exit code {run.returncode} of {' '.join(command)}\n{run.stderr[-4000:]}")
        rows = [json.loads(line) for line in out.read_text().splitlines()]
    values = {(row["name"], row["scene"], row["unit"]): row["median"] for row in rows}
    peaks = {(f"{row['name']}, peak", row["scene"], "MiB"): row["peak_mib"] for row in rows if row["peak_mib"]}
    return values | peaks


def compare(before: list[Values], after: list[Values]) -> list[dict[str, Any]]:
    """Return a row for each figure that both checkouts have."""
    rows: list[dict[str, Any]] = []
    for key in before[0]:
        if all(key in values for values in (*before, *after)):
            sides = {"before": [values[key] for values in before], "after": [values[key] for values in after]}
            medians = {name: statistics.median(values) for name, values in sides.items()}
            ratio = medians["after"] / medians["before"] if medians["before"] else None
            rows.append({"name": key[0], "scene": key[1], "unit": key[2], **sides, "ratio": ratio})
    return rows


def table(rows: list[dict[str, object]]) -> str:
    """Return the rows as text."""

    def side(values: list[float]) -> str:
        return f"{statistics.median(values):.4g} ({min(values):.4g} to {max(values):.4g})"

    lines = []
    for row in rows:
        ratio = "" if row["ratio"] is None else f"{row['ratio']:.3f}"
        cells = f"{side(row['before']):>28}  {side(row['after']):>28} {row['unit']:5} {ratio}"  # type: ignore[arg-type]
        lines.append(f"{row['name']!s:46} {row['scene']!s:34} {cells}")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.before_after", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("before", type=Path, help="root of a checkout")
    parser.add_argument("after", type=Path, help="root of another")
    parser.add_argument("--only", default="collect,frame,train_step", help="stages (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=3, help="default: %(default)s")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options, rest = parser.parse_known_args(arguments)
    for root in (options.before, options.after):
        if not (root / "benchmarks").is_dir():
            parser.error(f"expected the root of a checkout of nexwarp, got {root}")
    results: dict[str, list[Values]] = {"before": [], "after": []}
    for _ in range(options.repeats):
        for name, root in (("before", options.before), ("after", options.after)):
            results[name].append(measure(root.resolve(), ["--only", options.only, *rest]))
    rows = compare(results["before"], results["after"])
    print(table(rows))
    if options.out is not None:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
