"""The trainings of the quality benchmark: train, render the test views, compare them with their photos."""

import gc
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from benchmarks import peer_gsplat
from benchmarks.quality.curve import Curve, RenderImage, WatchedStages
from benchmarks.quality.jobs import Row, TrainingJob, config_of, scene_of
from benchmarks.quality.results import drop_unfinished, mean_of_known, read_results, result_line
from benchmarks.timing import git_commit
from nexwarp.data import Scene
from nexwarp.io.pictures import error_map, save_png, side_by_side, to_uint8
from nexwarp.run.evaluate import METRICS, psnr
from nexwarp.train.stages import StageRunner, StageStore


def missing_jobs(wanted: Sequence[TrainingJob], out: Path) -> list[TrainingJob]:
    """Return the jobs that a results file lacks, after cutting off a line that a killed program left unfinished."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.exists() and drop_unfinished(out):
        print(f"{out}: its last line was unfinished and is cut off")
    done = read_results([out]) if out.exists() else {}
    jobs = [job for job in wanted if job not in done]
    print(f"{len(jobs)} of {len(wanted)} trainings to do", flush=True)
    return jobs


@dataclass(frozen=True)
class Places:
    """Where trainings find their scenes, and what is kept of them.

    Attributes:
        data: folder of the scenes.
        pictures: folder for photo, rendering and error of each test view.
        models: folder to keep the models in.
        curve: keep metrics at times of the training; see `Curve`.
    """

    data: Path
    pictures: Path | None = None
    models: Path | None = None
    curve: bool = False


def run_jobs(jobs: Sequence[TrainingJob], rows: Mapping[str, Row], places: Places, out: Path, workers: int = 1) -> int:
    """Append the result of each job to a results file, so many trainings at once; return how many failed.

    `rows` has, by name, at least those of the jobs.
    """
    failed = 0
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        futures = {pool.submit(run_job, job, rows[job.row], places): job for job in jobs}
        for future in as_completed(futures):
            job = futures[future]
            try:
                result = future.result()
            except Exception as error:  # one failure must not lose the others' results
                failed += 1
                print(f"{job}: {type(error).__name__}: {error}", file=sys.stderr)
                continue
            with out.open("a") as file:
                file.write(json.dumps(result | {"jobs": workers}) + "\n")
            print(result_line(job, result), flush=True)
    return failed


def run_job(job: TrainingJob, row: Row, places: Places) -> dict[str, Any]:
    """Train, render the test views and compare them with their photos.

    Returns:
        A line of the results: the job and its row's settings; means of the metrics over the test views (None where one
        cannot be had), and by view; `pixels` of the first; `train_psnr` of every 8th training view; `primitives`;
        `megabytes` of the model file; `seconds` from the loaded scene to the finished model; `peak_mib` of GPU memory;
        device, date, commit.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    loading = time.perf_counter()
    scene = scene_of(job, places.data)
    watch = Curve(scene, loading) if places.curve else None
    if device.type == "cuda":
        gc.collect()  # arrays of the training before it in this process
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    begin = time.perf_counter()
    if row.preset is None:
        image, facts = _train_gsplat(job, row, scene, device, watch)
    else:
        image, facts = _train_nexwarp(job, row, scene, device, watch, places.models)
    seconds = facts.pop("end") - begin
    if watch is not None:
        watch.look(lambda: image, last=True)
        facts["curve"] = watch.points
    views = _compare(job, scene, image, places.pictures)
    camera = scene.test[0].camera
    means = {name: mean_of_known(view[name] for view in views.values()) for name in METRICS}
    if device.type == "cuda":
        facts["peak_mib"] = round(torch.cuda.max_memory_allocated() / 2**20)
    return {
        **asdict(job),
        "settings": row.settings,
        "pixels": f"{camera.width}x{camera.height}",
        **means,
        **facts,
        "seconds": seconds,
        "train_psnr": _train_psnr(scene, image),
        "views": views,
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "date": time.strftime("%Y-%m-%d"),
        "commit": git_commit(),
    }


def file_name(job: TrainingJob) -> str:
    """Return the name of a job's files."""
    return f"{job.scene}{job.variant}-{job.row}-{job.size}-{job.seed}".replace(" ", "_")


def _train_nexwarp(
    job: TrainingJob, row: Row, scene: Scene, device: torch.device, watch: Curve | None, models: Path | None
) -> tuple[RenderImage, dict[str, Any]]:
    store = StageStore() if watch is None else WatchedStages(watch)
    runner = StageRunner(scene, config_of(job, row), device, store)
    runner.train()
    trainer = runner.trainer
    model = trainer.finish()
    end = time.perf_counter()
    with tempfile.TemporaryDirectory() as temporary:
        file = model.save(Path(temporary) if models is None else models / file_name(job))
        megabytes = file.stat().st_size / 1e6
    return lambda camera: model.render(camera).image, {
        "primitives": len(model.surfels),
        "megabytes": megabytes,
        "teachers": len(trainer.targets.teachers),
        "end": end,
    }


def _train_gsplat(
    job: TrainingJob, row: Row, scene: Scene, device: torch.device, watch: Curve | None
) -> tuple[RenderImage, dict[str, Any]]:
    settings = peer_gsplat.PeerSettings(**row.settings)
    look = None if watch is None else lambda gaussians: watch.look(lambda: _gsplat_image(gaussians, device))
    gaussians = peer_gsplat.train(scene, job.size, job.iterations, job.seed, device, settings, look)
    torch.cuda.synchronize()
    facts = {"primitives": len(gaussians.splats["means"]), "megabytes": gaussians.megabytes, "end": time.perf_counter()}
    return _gsplat_image(gaussians, device), facts


def _gsplat_image(gaussians: peer_gsplat.Gaussians, device: torch.device) -> RenderImage:
    return lambda camera: gaussians.image(camera.to(device))


@torch.no_grad()
def _compare(
    job: TrainingJob, scene: Scene, image: RenderImage, pictures: Path | None
) -> dict[str, dict[str, float | None]]:
    """Return the metrics of each test view, and save its pictures."""
    views = {}
    for view in scene.test:
        photo, rendering = to_uint8(view.image), to_uint8(image(view.camera)).cpu()
        views[view.name] = {name: metric(rendering, photo, view.mask) for name, metric in METRICS.items()}
        if pictures is not None:
            captions = ["photo", f"{job.row}, {views[view.name]['psnr']:.2f} dB", "error (0 to 0.25)"]
            strip = side_by_side([photo, rendering, error_map(rendering, photo)], captions=captions)
            save_png(pictures / f"{file_name(job)}-{Path(view.name).stem}.png", strip)
    return views


@torch.no_grad()
def _train_psnr(scene: Scene, image: RenderImage) -> float:
    views = scene.train[::8]
    return statistics.fmean(psnr(to_uint8(image(view.camera)).cpu(), to_uint8(view.image)) for view in views)
