"""Runs the trainings that the documents' tables need on all GPUs of a machine, in the order of their value.

    python -m benchmarks.quality.spread OUT.jsonl --seconds 800 --data DIR [--have FILES] [--undone]

--undone does others in their place: each change of the default undone, judged on validation views.

On each GPU one training of ours, which the GPU limits, runs beside one of gsplat, which the host limits; two beside
three where CUDA MPS lets kernels of several processes overlap. Seconds are not comparable then. Each result is appended
to OUT at once. Trainings that OUT or the files of --have hold are passed over, those of our presets only if they had
today's settings; none is begun that would not end in time. gsplat's trainings begin once its extension is built.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.quality.jobs import TrainingJob
from benchmarks.quality.published import of_today
from benchmarks.quality.results import drop_unfinished, read_results, result_line
from benchmarks.quality.rows import CHANGES, DEFAULT, MEGABYTES, PAPER, PEERS, ROWS, SUSPECTS
from benchmarks.timing import ROOT

# Seconds of our training with 40,000 surfels on an H100, roughly; the spread corrects them by what it sees.
SECONDS = {"kitchen25": 250, "train": 220, "fox": 120, "saharov": 140}
PEER_SECONDS = 230
PAPER_SLOWER = 1.4  # its table of 2^20 entries
MPS = "CUDA_MPS_PIPE_DIRECTORY" in os.environ
SLOTS = {"ours": 2 if MPS else 1, "gsplat": 3 if MPS else 1}  # trainings at once on a GPU, by default
EXPOSED, EVEN, SKY = (row.name for row in PEERS[2:5])
# The changes about which short and small runs say least.
UNDONE_FIRST = ("no skybox", "no depth jitter", "no filter of points", "no exposures")
# Detail limits and SH smoothing show in other views than these; the paper's table is a matter of the file's size.
NOT_UNDONE = ("no footprints", "no SH smoothing", "paper's table")


@dataclass
class Running:
    """A training that runs.

    Attributes:
        job: which.
        gpu: its number.
        process: runs it.
        folder: its results and its log.
        begun: by `time.monotonic`.
    """

    job: TrainingJob
    gpu: int
    process: subprocess.Popen[bytes]
    folder: Path
    begun: float


def wanted_jobs() -> list[TrainingJob]:
    """Return all trainings: the longest first, lest it end last; then those of the most value."""
    ours, paper, few = DEFAULT.name, PAPER.name, ("saharov", "kitchen25")
    scenes = {SKY: few}  # of 100 points of the sphere, fox keeps 4 and train 13
    wanted = [
        ("train", ours, 400_000, 0),
        *((scene, ours, size, 0) for size in (40_000, 10_000) for scene in SECONDS),
        # Four test views each, so that one seed cannot tell.
        *((scene, row, 40_000, 1) for scene in few for row in (ours, EXPOSED, SKY)),
        *((scene, SKY, size, 0) for size in (40_000, 10_000) for scene in few),
        *((scene, row.name, size, 0) for row, size in MEGABYTES for scene in scenes.get(row.name, SECONDS)),
        *((scene, ours, size, 0) for size in (100_000, 20_000, 5_000) for scene in SECONDS),
        *(("fox", ours, size, seed) for size in (40_000, 10_000) for seed in (1, 2, 3)),
        *((scene, EXPOSED, 10_000, 0) for scene in SECONDS),
        ("train", EXPOSED, 400_000, 0),
        *((scene, EVEN, size, 0) for size in (10_000, 40_000) for scene in SECONDS),
        *(("fox", row.name, 40_000, 0) for row in (PAPER, *SUSPECTS)),
        *(("train", paper, size, 0) for size in (100_000, 400_000, 40_000)),
        *(("fox", row, size, seed) for seed in (1, 2, 3) for row, size in ((EXPOSED, 40_000), (EVEN, 10_000))),
        ("fox", paper, 40_000, 1),
        *((scene, row.name, 40_000, 0) for row in PEERS[5:] for scene in SECONDS),
    ]
    other_views = [
        ("fox", variant, row, 40_000, 0) for variant, row in (("near", paper), ("arc", ours), ("arc", paper))
    ]
    again = [(scene, "", ours, size, 1) for size in (20_000, 10_000, 100_000, 5_000) for scene in few]
    whole = [(scene, "", row, size, seed) for scene, row, size, seed in dict.fromkeys(wanted)]
    return [TrainingJob(*job, 30_000) for job in (*whole, *other_views, *again)]


def undone_jobs() -> list[TrainingJob]:
    """Return trainings of the default and of each change undone, judged on validation views, by value."""
    names = dict.fromkeys([DEFAULT.name, *UNDONE_FIRST, *(row.name for row in CHANGES if row.name not in NOT_UNDONE)])
    return [TrainingJob(scene, "inner", row, 40_000, 0, 9_000) for row in names for scene in SECONDS]


def kind_of(job: TrainingJob) -> str:
    """Return whose training it is: "ours" or "gsplat"."""
    return "gsplat" if ROWS[job.row].preset is None else "ours"


def expected_seconds(job: TrainingJob) -> float:
    """Return how long a training takes on an H100, roughly."""
    if kind_of(job) == "gsplat":
        return PEER_SECONDS * (1.0 if job.size < 200_000 else 1.5)
    seconds = SECONDS[job.scene] * (PAPER_SLOWER if ROWS[job.row].preset == PAPER.preset else 1.0)
    return seconds * (0.55 + 0.45 * (job.size / 40_000) ** 0.5) * job.iterations / 30_000


def next_job(jobs: Sequence[TrainingJob], kind: str, slowness: Mapping[str, float], left: float) -> TrainingJob | None:
    """Return the first job of a kind that ends within the seconds that are left; None without any."""
    fitting = (job for job in jobs if kind_of(job) == kind and expected_seconds(job) * slowness[kind] < left)
    return next(fitting, None)


def command_of(job: TrainingJob, data: Path, out: Path) -> list[str]:
    """Return the command of one training."""
    row = ROWS[job.row]
    named = f"{row.name}:{row.preset or 'gsplat'}:{json.dumps(row.settings)}"
    command = [sys.executable, "-m", "benchmarks.quality", "train", "--row", named, "--scenes", job.scene]
    command += ["--seeds", str(job.seed), "--size", str(job.size), "--iterations", str(job.iterations)]
    command += ["--variant", job.variant] if job.variant else []
    return [*command, "--data", str(data), "--out", str(out)]


def spread(
    out: Path, data: Path, seconds: float, gpus: int, jobs: list[TrainingJob], slots: Mapping[str, int] = SLOTS
) -> int:
    """Run the jobs; return how many ended without a result, those that were cut off included."""
    end, failed = time.monotonic() + seconds, 0
    slowness = {"ours": 1.15 if slots["ours"] == 1 else 0.9 * slots["ours"], "gsplat": 1.1}
    running: list[Running] = []
    builder = _build_gsplat() if slots["gsplat"] and any(kind_of(job) == "gsplat" for job in jobs) else None
    with tempfile.TemporaryDirectory() as folder:
        try:
            while (left := end - time.monotonic()) > 0:
                for one in [x for x in running if x.process.poll() is not None]:
                    running.remove(one)
                    failed += not _collect(one, out, slowness)
                building = builder is not None and builder.poll() is None
                open_slots = {kind: most for kind, most in slots.items() if kind != "gsplat" or not building}
                for gpu in range(gpus):
                    for kind, most in open_slots.items():
                        while sum(x.gpu == gpu and kind_of(x.job) == kind for x in running) < most:
                            job = next_job(jobs, kind, slowness, left)
                            if job is None:
                                break
                            jobs.remove(job)
                            running.append(_begin(job, gpu, data, Path(tempfile.mkdtemp(dir=folder))))
                if not running and not building:
                    break
                time.sleep(0.5)
        finally:
            if builder is not None:
                builder.kill()
            for one in running:
                os.killpg(one.process.pid, signal.SIGKILL)
                one.process.wait()
                print(f"cut off: {one.job.scene} {one.job.row} {one.job.size}", flush=True)
    return failed + len(running)


def _build_gsplat() -> subprocess.Popen[bytes]:
    # Several trainings that build it at once delete each other's files.
    return subprocess.Popen([sys.executable, "-c", "import gsplat.cuda._backend"], stdout=subprocess.DEVNULL)


def _begin(job: TrainingJob, gpu: int, data: Path, folder: Path) -> Running:
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": str(gpu), "OMP_NUM_THREADS": "2"}
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            command_of(job, data, folder / "out.jsonl"),
            cwd=ROOT,
            env=environment,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    return Running(job, gpu, process, folder, time.monotonic())


def _collect(one: Running, out: Path, slowness: dict[str, float]) -> bool:
    """Append a training's result; return whether there is one."""
    kind, took = kind_of(one.job), time.monotonic() - one.begun
    file = one.folder / "out.jsonl"
    if one.process.returncode != 0 or not file.exists():
        last = " ".join((one.folder / "log").read_text(errors="replace").split()[-40:])
        print(f"failed: {one.job.scene} {one.job.row} {one.job.size}: {last[-300:]}", flush=True)
        return False
    with out.open("a") as results:
        results.write(file.read_text())
    slowness[kind] = (slowness[kind] + took / expected_seconds(one.job)) / 2
    print(result_line(one.job, read_results([file])[one.job]), flush=True)
    return True


def _slots(text: str) -> dict[str, int]:
    try:
        ours, gsplat = map(int, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected two numbers such as 2,3, got {text}") from None
    return {"ours": ours, "gsplat": gsplat}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.quality.spread", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--seconds", type=float, required=True, help="of wall time")
    parser.add_argument("--undone", action="store_true", help="undo each change of the default, on validation views")
    parser.add_argument("--have", help="comma-separated: further files of results, such as those of gsplat")
    parser.add_argument(
        "--slots",
        type=_slots,
        default=SLOTS,
        metavar="OURS,GSPLAT",
        help="trainings at once on a GPU; default: 2,3 with CUDA MPS, else 1,1",
    )
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the scenes")
    given = parser.parse_args(arguments)
    if given.out.exists():
        drop_unfinished(given.out)
    files = [*([given.out] if given.out.exists() else []), *map(Path, given.have.split(",") if given.have else ())]
    have = [job for file in files for job, result in read_results([file]).items() if of_today(job, result)]
    jobs = [job for job in (undone_jobs() if given.undone else wanted_jobs()) if job not in have]
    failed = spread(given.out, given.data, given.seconds, torch.cuda.device_count(), jobs, given.slots)
    print(f"{len(jobs)} trainings were not begun, {failed} have no result")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
