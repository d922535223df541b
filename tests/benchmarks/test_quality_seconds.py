"""Our training, two short ones of gsplat, and one that takes as long as ours: each once, in this order."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from benchmarks.quality import equal_seconds as module
from benchmarks.quality.equal_seconds import BEST, iterations_for, main
from benchmarks.quality.jobs import SCENES, TrainingJob
from benchmarks.quality.published import PEER_NAMES
from benchmarks.quality.results import read_results
from benchmarks.quality.rows import ROWS


class Stand:
    """In place of a schedule: ours takes 90 s, gsplat 3 s and 6 ms an iteration."""

    def __init__(self, rows: object, data: Path, out: Path) -> None:
        self.out = out

    def run(self, jobs: Sequence[TrainingJob]) -> int:
        if any(job.scene == "saharov" for job in jobs):
            return 1
        with self.out.open("a") as file:
            for job in jobs:
                seconds = 90.0 if ROWS[job.row].preset else 3.0 + 0.006 * job.iterations
                file.write(json.dumps(dataclasses.asdict(job) | {"psnr": 30.0, "seconds": seconds}) + "\n")
        return 0


def test_gsplat_trains_for_our_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tuple(BEST) == SCENES and set(BEST.values()) <= set(PEER_NAMES)
    monkeypatch.setattr(module, "Schedule", Stand)
    out = tmp_path / "out.jsonl"
    for _ in range(2):
        main([str(out), "--scenes", "fox,train"])
    done = [(job.scene, job.row, job.iterations) for job in read_results([out])]
    assert len(out.read_text().splitlines()) == len(done) == 8, "nothing is trained twice"
    assert done[:4] == [("fox", "default", 30_000), *(("fox", BEST["fox"], n) for n in (1_000, 3_000, 14_500))]
    with pytest.raises(RuntimeError, match=r"saharov.*: expected a result, got none"):
        main([str(out), "--scenes", "saharov"])
    with pytest.raises(SystemExit):
        main([str(out), "--scenes", "fox,garden"])
    assert "--scenes: expected some of train, fox, saharov, kitchen25, got garden" in capsys.readouterr().err


def test_as_many_iterations_as_fit_the_seconds() -> None:
    short = {1000: 9.0, 3000: 21.0}  # 3 s, and 6 ms an iteration
    assert iterations_for(90.05, short) == 14_500
    assert iterations_for(5.0, short) == 300 and iterations_for(1e4, short) == 30_000
    with pytest.raises(ValueError, match=r"short: expected more seconds for more iterations, got .*3000: 8"):
        iterations_for(90.0, short | {3000: 8.0})
