"""Every reader stands damaged files: a bounded run of `tests.robustness.fuzz`, and what its harness must notice."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.robustness.fuzz import Campaign
from tests.robustness.fuzz_targets import TARGETS, FuzzTarget, write_input
from tests.subprocesses import run_python

INPUTS = 80


@pytest.mark.timeout(0)
@pytest.mark.parametrize(
    "long", [pytest.param(False, marks=pytest.mark.long), pytest.param(True, marks=pytest.mark.slow)]
)
def test_readers_load_or_refuse_in_one_line(tmp_path: Path, long: bool) -> None:
    """As long as NEXWARP_FUZZ_SECONDS says, 600 s without it; what failed is kept in the test's folder.

    In a process of its own: what this one has done with torch's threads would follow the forked readers.
    """
    seconds, seed = os.environ.get("NEXWARP_FUZZ_SECONDS", "600"), os.environ.get("NEXWARP_FUZZ_SEED", "0")
    options = ["--seconds", seconds, "--seed", seed] if long else ["--seconds", "1200", "--inputs", str(INPUTS)]
    done = run_python("-m", "tests.robustness.fuzz", *options, "--failed", tmp_path)
    *lines, last = done.stdout.splitlines()
    assert done.returncode == 0 and " 0 failures," in last, done.stdout + done.stderr
    assert len(lines) == len(TARGETS)
    for line in lines:
        assert long or f" {INPUTS} inputs" in line, line
        assert " loaded" in line and "Error" in line, "inputs are neither all as good as new nor all unrecognisable"


@pytest.mark.parametrize("name", TARGETS)
def test_the_valid_files_load(tmp_path: Path, name: str) -> None:
    target = TARGETS[name]
    (tmp_path / "valid").mkdir()
    for index, files in enumerate(target.make(tmp_path / "valid")):
        write_input(tmp_path / str(index), files)
        target.read(tmp_path / str(index))


FAULTS: dict[str, Callable[[Path], object]] = {
    "crash": lambda _: os.abort(),
    "hang": lambda _: time.sleep(60),
    "memory": lambda _: np.empty(2 * 10**9, np.uint8),
    "KeyError": lambda _: {"a": 1}["x"],
    "message": lambda _: int("no path in the message"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_failures_are_noticed_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    if kind == "hang":
        monkeypatch.setattr("tests.robustness.fuzz.HANG", 1.0)
    target = FuzzTarget("one", lambda _: [{"a": b"good"}], FAULTS[kind], ("a",))
    result = Campaign(target, 3, tmp_path).run(seconds=60.0, inputs=1)
    (failure,) = result.failures
    assert failure.kind == kind and result.inputs == 1 and not result.outcomes
    assert failure.folder == tmp_path / f"one-0-{kind}" and (failure.folder / "failure.txt").is_file()
