import json
import os
import signal
import time
from pathlib import Path

import pytest
import torch

from tests.subprocesses import run_python
from tests.train.test_ranks_command import TORCHRUN, await_checkpoint, lines, ranks_of, start

pytestmark = [pytest.mark.cuda, pytest.mark.timeout(300)]

TWO_GPUS = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")


@pytest.mark.parametrize(
    ("backend", "ranks"),
    [("nccl", 1), pytest.param("nccl", 2, marks=TWO_GPUS), ("gloo", 2)],
    ids=["NCCL, 1 rank", "NCCL, 2 ranks", "gloo, 2 ranks of one GPU"],
)
def test_all_ways_of_a_step_give_the_same_bits(tiny_folder: Path, backend: str, ranks: int) -> None:
    """With `deterministic`: gradients summed in the graph, after it, or without one; on all ranks."""
    command = [*TORCHRUN, f"--nproc-per-node={ranks}", "-m", "tests.ranks_on_gpus", tiny_folder, backend, 240, 400]
    run = run_python(*command, timeout=280)
    assert run.returncode == 0, run.stderr[-2000:]
    told = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]
    modes = ["eager", "captured", "beside"] if backend == "nccl" else ["eager", "beside"]
    assert [each["mode"] for each in told] == modes
    assert len({digest for each in told for digest in each["digests"]}) == 1, told
    assert all(len(each["digests"]) == ranks and each["surfels"] > 200 for each in told), told
    assert all((each["graphs"] > 0) == (each["mode"] != "eager") for each in told), told


@TWO_GPUS
def test_a_killed_rank_ends_all(tiny_folder: Path, tmp_path: Path) -> None:
    """A rank on a GPU is killed while the other waits in an all-reduce of NCCL: all end within 40 s, with one line."""
    run = tmp_path / "run"
    options = ["--iterations", "60000", "--max-surfels", "400", "--checkpoint-every", "400", "--gpus", "2"]
    process = start(["train", str(tiny_folder), "--run", str(run), *options])
    await_checkpoint(run)
    ranks = ranks_of(process)
    assert len(ranks) == 2
    begun = time.monotonic()
    os.kill(ranks[1].pid, signal.SIGKILL)
    told = lines(process, 60)
    assert time.monotonic() - begun < 40 and process.returncode == 3 and not any(rank.is_running() for rank in ranks)
    (line,) = told
    expected = f"nexwarp: error: rank 1 (process {ranks[1].pid}) was ended by signal 9"
    assert line.startswith(expected) and "--resume" in line


def test_more_ranks_than_gpus_are_refused(tiny_folder: Path, tmp_path: Path) -> None:
    count = torch.cuda.device_count()
    run = tmp_path / "run"
    process = start(["train", str(tiny_folder), "--run", str(run), "--gpus", str(count + 1)])
    expected = f"expected at most {count}, as many as GPUs on this machine, got {count + 1}"
    assert lines(process, 60) == [f"nexwarp: error: --gpus: {expected}; --device cpu trains on CPUs instead"]
    # torchrun does not know of GPUs: the rank itself finds out.
    launcher = [*TORCHRUN, f"--nproc-per-node={count + 1}", "-m", "--"]
    process = start(["train", str(tiny_folder), "--run", str(run)], launcher)
    told = [line for line in lines(process, 100) if line.startswith("nexwarp:")]
    assert told == [
        f"nexwarp: error: rank {count}: expected a GPU of its own, but {count} are there for {count + 1} ranks"
    ]
    assert process.returncode != 0 and not run.exists()
