"""The comparison of two checkouts; but for one stage of this checkout, the measurements are stubs."""

import json
from pathlib import Path

import pytest

from benchmarks import before_after
from benchmarks.before_after import Values, compare, table
from benchmarks.timing import ROOT


def test_checkouts_are_measured_in_turns(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    turns: list[str] = []

    def measure(root: Path, options: list[str]) -> Values:
        assert options == ["--only", "frame", "--device", "cpu"]
        turns.append(root.name)
        return {("frame", "garden", "ms"): 10.0 * len(turns), ("new", "garden", "ms"): 1.0}

    for name in "ab":
        (tmp_path / name / "benchmarks").mkdir(parents=True)
    monkeypatch.setattr(before_after, "measure", measure)
    out = tmp_path / "report.json"
    command = [str(tmp_path / name) for name in "ab"]
    before_after.main([*command, "--only", "frame", "--device", "cpu", "--repeats", "2", "--out", str(out)])
    assert turns == ["a", "b"] * 2
    frame = json.loads(out.read_text())[0]
    assert (frame["before"], frame["after"]) == ([10.0, 30.0], [20.0, 40.0]) and frame["ratio"] == pytest.approx(1.5)


def test_figures_of_one_side_are_left_out() -> None:
    key = ("growth", "garden", "MiB")
    rows = compare([{key: 0.0, ("old", "", "ms"): 1.0}], [{key: 1.0}])
    assert [(row["name"], row["ratio"]) for row in rows] == [("growth", None)] and "growth" in table(rows)


def test_a_checkout_measures_itself() -> None:
    values = before_after.measure(ROOT, ["--quick", "--device", "cpu", "--only", "tiles"])
    assert values["tiles", "cloud 500 at 64x48", "ms"] > 0
