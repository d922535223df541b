"""Trainings spread over GPUs: by value, within the time, each result kept at once."""

import dataclasses
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.quality import spread as module
from benchmarks.quality.jobs import TrainingJob, config_of
from benchmarks.quality.published import of_today
from benchmarks.quality.results import read_results
from benchmarks.quality.rows import CHANGES, PEERS, ROWS, SUSPECTS
from benchmarks.quality.run import config_name
from benchmarks.quality.spread import (
    command_of,
    expected_seconds,
    kind_of,
    next_job,
    spread,
    undone_jobs,
    wanted_jobs,
)

FAILS, HANGS = 10_000, 20_000  # sizes

STAND_IN = """
import json, sys, time
words = sys.argv[1:]
size = int(words[words.index("--size") + 1])
time.sleep(1000 if size == 20_000 else 0.2)
row, scene, out = (words[words.index(name) + 1] for name in ("--row", "--scenes", "--out"))
line = {"scene": scene, "variant": "", "row": row.split(":")[0], "size": size, "seed": 0, "iterations": 30000}
line |= {"downscale": 1, "psnr": 30.0, "ssim": 0.9, "flip": None, "lpips": None, "seconds": 1.0}
if size == 10_000:
    sys.exit("no memory")
open(out, "w").write(json.dumps(line) + "\\n")
"""


def test_the_tables_trainings_come_by_value() -> None:
    jobs = wanted_jobs()
    assert len(jobs) == len(set(jobs)) and all(job.row in ROWS and expected_seconds(job) > 0 for job in jobs)
    sizes = [400_000] + [40_000] * 4 + [10_000] * 4
    assert [(job.row, job.size) for job in jobs[:9]] == [("default", size) for size in sizes]
    pairs = {(job.scene, job.row) for job in jobs if job.seed == 1 and job.size == 40_000 and job.row != "paper"}
    few = ("kitchen25", "saharov")
    both = {(scene, row) for scene in (*few, "fox") for row in ("default", module.EXPOSED)}
    assert pairs == both | {(scene, module.SKY) for scene in few}
    assert {row.name for row in (*PEERS[2:], *SUSPECTS)} <= {job.row for job in jobs}
    assert {job.scene for job in jobs if job.row == module.SKY} == {*few}
    assert {(job.scene, job.variant) for job in jobs if job.variant} == {("fox", "near"), ("fox", "arc")}
    assert {(job.scene, job.seed) for job in jobs[-8:]} == {("saharov", 1), ("kitchen25", 1)}
    even = {"ours": 1.0, "gsplat": 1.0}
    assert next_job(jobs, "ours", even, 1e9) == jobs[0]
    first = next_job(jobs, "gsplat", even, 1e9)
    assert first is not None and kind_of(first) == "gsplat"
    quick = next_job(jobs, "ours", even, 100.0)
    assert quick is not None and expected_seconds(quick) < 100 < expected_seconds(jobs[0])
    assert next_job(jobs, "ours", even | {"ours": 1e6}, 1000.0) is None


def test_results_of_other_settings_are_trained_anew() -> None:
    ours, peer = (next(job for job in wanted_jobs() if kind_of(job) == kind) for kind in ("ours", "gsplat"))
    today = {"config": config_name(config_of(ours, ROWS[ours.row]))}
    assert of_today(ours, today) and of_today(peer, {})
    assert not of_today(ours, {"config": "other"}) and not of_today(ours, {})
    assert not of_today(dataclasses.replace(ours, row="floaters left"), today), "a row that is no more"


def test_each_change_is_undone_on_validation_views() -> None:
    jobs = undone_jobs()
    assert len(jobs) == len(set(jobs)) and {job.variant for job in jobs} == {"inner"}
    rows = list(dict.fromkeys(job.row for job in jobs))
    assert rows[:2] == ["default", "no skybox"]
    assert {row.name for row in CHANGES} - set(rows) == set(module.NOT_UNDONE)
    assert {(job.scene, job.row) for job in jobs} == {(scene, row) for scene in module.SECONDS for row in rows}
    inner, test = (command_of(each[0], Path("data"), Path("out.jsonl")) for each in (jobs, wanted_jobs()))
    assert inner[inner.index("--variant") + 1] == "inner" and "--variant" not in test


def test_results_are_kept_failures_told_and_the_rest_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = module.command_of
    script = tmp_path / "stand_in.py"
    script.write_text(STAND_IN)
    monkeypatch.setattr(module, "command_of", lambda *given: [sys.executable, str(script), *real(*given)[4:]])
    monkeypatch.setattr(module, "expected_seconds", lambda job: 0.5)
    built, building = tmp_path / "built", "import time, pathlib; time.sleep(2); pathlib.Path({!r}).touch()"
    monkeypatch.setattr(
        module, "_build_gsplat", lambda: subprocess.Popen([sys.executable, "-c", building.format(str(built))])
    )
    sizes = (40_000, FAILS, HANGS, 5_000)
    jobs = [TrainingJob("fox", "", "default", size, 0, 30_000) for size in sizes]
    jobs.append(TrainingJob("fox", "", module.EXPOSED, 40_000, 0, 30_000))
    out = tmp_path / "out.jsonl"
    begun = time.monotonic()
    assert spread(out, tmp_path, 6.0, 2, [*jobs]) == 2
    assert time.monotonic() - begun < 20
    assert set(read_results([out])) == {jobs[0], jobs[3], jobs[4]}
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert all(line["psnr"] == 30.0 for line in lines)
    assert lines[-1]["row"] == module.EXPOSED and built.exists(), "gsplat begins once it is built"
    told = capsys.readouterr().out
    assert "failed: fox default 10000: no memory" in told and "cut off: fox default 20000" in told
