"""The comparison of two checkouts; the measurements themselves are stubs, but for one stage of this checkout."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from benchmarks import before_after
from benchmarks.before_after import Checkout, Metric, Values, alternate, table, tensors_digest
from benchmarks.timing import ROOT


def test_checkouts_are_measured_in_turns() -> None:
    turns: list[str] = []

    def measure(checkout: Checkout) -> Values:
        turns.append(checkout.name)
        values: Values = {("step", "garden", "ms"): 10.0 * len(turns)}
        return values | ({("new", "garden", "ms"): 1.0} if checkout.name == "after" else {})

    step, new = alternate([Checkout("before", Path("a")), Checkout("after", Path("b"))], 3, measure)
    assert turns == ["before", "after"] * 3
    assert (step.before, step.after) == ([10.0, 30.0, 50.0], [20.0, 40.0, 60.0])
    assert step.ratio == pytest.approx(40 / 30)
    assert step.facts()["before"] == {"median": 30.0, "spread": [10.0, 50.0], "values": [10.0, 30.0, 50.0]}
    assert (new.before, new.after, new.ratio) == ([], [1.0] * 3, None)
    header, first, second = table([step, new]).splitlines()
    assert header.split() == ["scene", "before", "after", "unit", "after", "/", "before"]
    assert first.split("  ")[-1].strip() == "1.3333" and "30 (10 to 50)" in first
    assert "missing" in second


def test_a_ratio_to_nothing_is_left_out() -> None:
    assert Metric("growth", "garden", "MiB", [0.0], [1.0]).ratio is None


def test_a_failing_checkout_is_named(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=rf"(?s)after, {tmp_path}: exit code 1 of .*ZeroDivisionError"):
        Checkout("after", tmp_path).python("-c", "1 / 0")


def test_models_are_compared_by_their_tensors(tmp_path: Path) -> None:
    one, two = torch.arange(3.0), torch.ones(2, 2)
    save_file({"a": one, "b": two}, tmp_path / "first", {"nexwarp": "x"})
    save_file({"b": two, "a": one}, tmp_path / "second", {"nexwarp": "longer"})
    save_file({"a": one, "b": two + 1}, tmp_path / "third")
    first, second, third = (tensors_digest(tmp_path / name) for name in ("first", "second", "third"))
    assert first == second != third


def test_the_command_runs_both_checkouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trained = iter([({("test PSNR", "demo", "dB"): 30.0}, "a"), ({("test PSNR", "demo", "dB"): 30.3}, "b")])
    monkeypatch.setattr(before_after, "demo_values", lambda checkout, flags: next(trained))
    out = tmp_path / "report.json"
    command = [str(ROOT), str(ROOT), "--stages", "collect", "--repeats", "1", "--device", "cpu", "--demo"]
    assert before_after.main([*command, "--out", str(out)]) == 0
    report = json.loads(out.read_text())
    assert report["before"] == report["after"] and report["before"]["root"] == str(ROOT)
    names = [row["name"] for row in report["parts"]["collect"]]
    assert names[0] == "collect, forward" and "collection stage, forward + backward" in names
    assert all(row["before"]["median"] > 0 and row["after"]["median"] > 0 for row in report["parts"]["collect"])
    assert report["parts"]["demo"][0]["ratio"] == pytest.approx(1.01)
    assert report["demo_tensors"] == {"before": ["a"], "after": ["b"], "equal": False}
    assert "the models' tensors are DIFFERENT" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        before_after.main([str(tmp_path), str(ROOT)])
    assert "before: expected the root of a checkout of nexwarp" in capsys.readouterr().err
