"""Trainings are compared by the bytes of their models; the trainings themselves are stubs, but for one."""

import sys

import pytest

from benchmarks.repeat import Repeat, Run, table
from nexwarp.data import write_demo

STUB = """
import json, sys
from pathlib import Path
run = Path(sys.argv[-1])
run.mkdir()
number = int(run.name[3:])
content = b"the same" if {same} else b"%d" % number
(run / "model.safetensors").write_bytes(content)
metrics = {{"psnr": 30.0 + number / 10, "iterations_per_second": 100.0 * number}}
(run / "metrics.json").write_text(json.dumps(metrics))
sys.exit({code})
"""


def stubbed(monkeypatch: pytest.MonkeyPatch, same: bool, code: int = 0) -> None:
    command = [sys.executable, "-c", STUB.format(same=same, code=code)]
    monkeypatch.setattr(Repeat, "command", lambda self: command)


@pytest.mark.parametrize(
    ("same", "options", "code"),
    [
        (True, {"deterministic": True}, 0),
        (False, {"deterministic": True}, 1),
        (False, {"device": "cpu"}, 1),
        (False, {}, 0),  # on CUDA nobody promised
    ],
)
def test_different_bytes_fail_where_they_were_promised(monkeypatch, capsys, same, options, code):
    stubbed(monkeypatch, same)
    assert Repeat(runs=3, **options)() == code
    out, err = capsys.readouterr()
    assert ("3 runs, 1 different model: identical bytes" if same else "3 runs, 3 different models\n") in out
    assert "test PSNR 30.2000 ± 0.1000 (standard deviation; 30.1000 to 30.3000) dB" in out
    assert "200.0 ± 100.0 (standard deviation; 100.0 to 300.0) it/s" in out
    assert err.count("\n") == 3


def test_a_training_that_fails_is_told(monkeypatch, capsys):
    stubbed(monkeypatch, same=True, code=3)
    assert Repeat(runs=2)() == 2
    assert "training 1 ended with exit code 3" in capsys.readouterr().err
    assert Repeat(runs=0)() == 2


def test_the_table_is_markdown():
    lines = table([Run("ab" * 32, 31.23456, 50.04), Run("cd" * 32, None, 51.0)], "`nexwarp train x`").splitlines()
    assert lines[0] == "`nexwarp train x`:" and lines[3] == "|---|---|---|---|"
    assert lines[4] == "| 1 | abababababababab | 31.2346 dB | 50.0 |"
    assert lines[5] == "| 2 | cdcdcdcdcdcdcdcd |  | 51.0 |"
    assert "* test PSNR 31.2346 dB" in lines


def test_the_command_is_as_asked_for(tmp_path):
    (tmp_path / "fox").mkdir()
    command = Repeat(
        scene="fox", iterations=2000, max_surfels=40_000, deterministic=True, data=tmp_path, extra="--downscale 2"
    ).command()
    assert command[1:5] == ["-m", "nexwarp", "train", str(tmp_path / "fox")]
    assert sorted(command[5:]) == sorted(
        ["--device=cuda", "--deterministic", "--downscale", "2", "--iterations=2000", "--max-surfels=40000"]
    )
    assert Repeat(data=tmp_path).command()[4:] == ["demo", "--device=cuda"]


@pytest.mark.slow
def test_a_cpu_repeats_itself(tmp_path, capsys):
    """Really trained, twice, by `nexwarp train`."""
    scene = write_demo(tmp_path / "scene", width=32, height=24, views=9, points=100)
    small = "--set texture.levels=2 --set texture.table_size=64 --set texture.width=8"
    assert Repeat(scene=str(scene), device="cpu", iterations=3, max_surfels=50, extra=small)() == 0
    out = capsys.readouterr().out
    assert "2 runs, 1 different model: identical bytes" in out and "| 2 |" in out
    assert out.count(" dB | ") == 2
