"""One training of the quality benchmark: train, render the test views, compare them with their photos."""

import gc
import hashlib
import json
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from benchmarks.quality.jobs import TrainingJob, config_of
from benchmarks.quality.metrics import RenderImage, quarter_psnr, train_psnr, zoom_psnr
from benchmarks.quality.results import METRICS
from benchmarks.quality.rows import Row
from benchmarks.quality.scenes import scene_of
from benchmarks.timing import ROOT
from nexwarp.cameras.camera import Camera
from nexwarp.data import Scene, View
from nexwarp.io.pictures import error_map, save_png, side_by_side, to_uint8
from nexwarp.model.model import Model
from nexwarp.model.model_file import load
from nexwarp.run.evaluate import METRICS as METRIC_FUNCTIONS
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from nexwarp.train.config import Config
from nexwarp.train.schedules import POSE_RATES
from nexwarp.train.stages import plan_teachers, student_trainer
from nexwarp.train.step_losses import POSE_PRIOR
from nexwarp.train.trainer import Trainer


@dataclass(frozen=True)
class SharedStart:
    """The first iterations that several jobs have in common.

    Attributes:
        rows: of the jobs.
        iterations: how many.
        folder: holds the checkpoint.
    """

    rows: tuple[str, ...]
    iterations: int
    folder: Path


@dataclass(frozen=True)
class Trained:
    """What a training leaves.

    Attributes:
        renderings: of the test views, (H, W, 3) uint8 on the CPU.
        facts: of its result.
        compact: the same renderings by the model as it is in a compact file.
        compact_bytes: size of that file.
    """

    renderings: list[tuple[View, torch.Tensor]]
    facts: dict[str, Any]
    compact: list[tuple[View, torch.Tensor]]
    compact_bytes: int


def train_shared_start(jobs: Sequence[TrainingJob], data: Path, row: Row, iterations: int, folder: Path) -> SharedStart:
    """Train the first iterations that several jobs have in common.

    Args:
        jobs: one or more.
        data: folder of the scenes.
        row: of the first job.
        iterations: how many.
        folder: made for the checkpoint.
    """
    trainer = Trainer(scene_of(jobs[0], data), config_of(jobs[0], row), _device())
    trainer.run(until=iterations)
    folder.mkdir()
    trainer.save_checkpoint(folder)
    return SharedStart(tuple(job.row for job in jobs), iterations, folder)


def run_job(
    job: TrainingJob,
    data: Path,
    row: Row,
    pictures: Path | None = None,
    models: Path | None = None,
    start: SharedStart | None = None,
    trainer: Callable[[Scene, Config, torch.device], Trainer] = student_trainer,
) -> dict[str, Any]:
    """Train, render the test views and compare them with their photos.

    Args:
        job: what to train.
        data: folder of the scenes.
        row: the job's.
        pictures: folder for photo, rendering and error of each test view.
        models: folder to keep the model in.
        start: where to continue from.
        trainer: makes a training of nexwarp from scene, settings and device, by default after its teachers; gsplat's
            rows do not use it.

    Returns:
        A line of the results: the job and its row's settings; means of the metrics (None where one cannot be had);
        `primitives`, `megabytes` of the model file, `seconds` from the loaded scene to the finished model, `peak_mib`
        of GPU memory (torch's), `training_mib` without the evaluation, `steps_mib` without finishing the model either
        (finishing teachers counts); `compact`, the metrics and megabytes of a compact file, and its PSNR by view; of
        nexwarp `config`, a digest of its settings, `teachers` where it had any, `train_psnr`, `zoom_psnr` and
        `quarter_psnr`; `together`, the rows and iterations of its shared start, if any; the metrics by view; device,
        date and commit.
    """
    device = _device()
    scene = scene_of(job, data)
    if device.type == "cuda":
        gc.collect()  # arrays of the training before it in this process
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    if row.preset is None:
        trained = _train_gsplat(job, row, scene, device)
    else:
        config = config_of(job, row)
        trained = _train_nexwarp(job, scene, lambda: trainer(scene, config, device), models, start)
        trained.facts["config"] = config_name(config)
        own = plan_teachers(config, len(scene.train))
        if own.count and "teachers" in trained.facts:
            trained.facts["teachers"]["max_surfels"] = own.max_surfels
    peak = _peak("peak_mib", device)
    views = _compare(job, trained.renderings, pictures)
    coded = _compare(job, trained.compact, None)
    return {
        **asdict(job),
        "settings": row.settings,
        **{key: _mean(v[key] for v in views.values()) for key in METRICS},
        **trained.facts,
        "compact": {key: _mean(v[key] for v in coded.values()) for key in METRICS}
        | {"megabytes": trained.compact_bytes / 1e6, "views": {name: x["psnr"] for name, x in coded.items()}},
        **peak,
        "views": views,
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "date": time.strftime("%Y-%m-%d"),
        "commit": _commit(),
    }


def file_name(job: TrainingJob) -> str:
    """Return the name of a job's files."""
    reduced = f"-downscale{job.downscale}" if job.downscale > 1 else ""
    return f"{job.scene}{job.variant}-{job.row}-{job.size}-{job.seed}{reduced}".replace(" ", "_")


def config_name(config: Config) -> str:
    """Return a digest of settings, whatever the seed.

    It is that of older results: constants that once were settings count, and a setting that was added does not where it
    is off.
    """
    settings = {name: value for name, value in config.as_dict().items() if name != "seed"} | {"clamp_image": True}
    if not config.skybox:
        del settings["skybox"]
    del settings["teachers"]  # `trained_with` compares them
    settings["losses"] |= {"poses": POSE_PRIOR, "distortion": 0.0}
    settings["densify"] |= {"floaters": False}
    settings["rates"] |= {"poses": POSE_RATES, "motions": (0.5, 0.02)}
    settings |= {"blur_poses": 1, "coarse": 0.0, "low_pass": False}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]


def trained_with(result: Mapping[str, Any], config: Config) -> bool:
    """Whether a result of nexwarp has these settings, whatever the seed, and the teachers that they lead to today.

    Where `config.teachers` is None, the number of photos is not known: a result without teachers counts, too. Teachers
    whose budget is not in the result had the student's.
    """
    teachers, own = result.get("teachers") or {}, plan_teachers(config, 1)
    count = teachers.get("count", 0)
    if count == 0:
        alike = not config.teachers
    else:
        budget = teachers.get("max_surfels", max(teachers.get("surfels", 0), config.max_surfels))
        alike = (count, budget) == (own.count, own.max_surfels)
    return result.get("config") == config_name(config) and alike


def _device() -> torch.device:
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _compare(
    job: TrainingJob, renderings: Sequence[tuple[View, torch.Tensor]], pictures: Path | None
) -> dict[str, dict[str, float | None]]:
    """Return the metrics of each test view, and save its pictures."""
    views = {}
    for view, image in renderings:
        photo = to_uint8(view.image)
        figures = {name: metric(image, photo, view.mask) for name, metric in METRIC_FUNCTIONS.items()}
        views[view.name] = figures
        if pictures is not None:
            strip = [photo, image, error_map(image, photo)]
            captions = ["photo", f"{job.row}, {figures['psnr']:.2f} dB", "error (0 to 0.25)"]
            file = pictures / f"{file_name(job)}-{Path(view.name).stem}.png"
            save_png(file, side_by_side(strip, captions=captions))
    return views


def _peak(name: str, device: torch.device) -> dict[str, int]:
    """Return the peak of a GPU's memory so far, in MiB, by a name; nothing on a CPU."""
    return {name: round(torch.cuda.max_memory_allocated() / 2**20)} if device.type == "cuda" else {}


def _train_nexwarp(
    job: TrainingJob, scene: Scene, make: Callable[[], Trainer], models: Path | None, start: SharedStart | None
) -> Trained:
    begin = time.perf_counter()
    trainer = make()
    device = trainer.device
    shared = {}
    if start is not None:
        _restore(trainer, start.folder)
        shared = {"together": {"rows": start.rows, "iterations": start.iterations}}
    before = trainer.seconds  # of the shared start
    trainer.run()
    memory = _peak("steps_mib", device)
    model = trainer.finish()
    seconds = before + time.perf_counter() - begin
    memory |= _peak("training_mib", device)

    def image(camera: Camera) -> torch.Tensor:
        return model.render(camera).image

    with tempfile.TemporaryDirectory() as temporary:
        file = model.save(Path(temporary) if models is None else models / file_name(job))
        megabytes = file.stat().st_size / 1e6
        coded = model.save(Path(temporary) / "compact.safetensors", compact=True)
        compact, compact_bytes = load(coded).to(device), coded.stat().st_size
    facts = {
        "primitives": len(trainer.surfels),
        "megabytes": megabytes,
        "seconds": seconds,
        "train_psnr": train_psnr(scene, image),
        "zoom_psnr": zoom_psnr(scene, image),
        "quarter_psnr": quarter_psnr(scene, image),
        **({} if trainer.teachers is None else {"teachers": _teachers_facts(trainer.teachers.models)}),
        **memory,
        **shared,
    }
    return Trained(
        _renderings(scene, image), facts, _renderings(scene, lambda camera: compact.render(camera).image), compact_bytes
    )


def _teachers_facts(models: Sequence[Model]) -> dict[str, int]:
    """Return how many teachers a model has learned from, and how many surfels the largest of them has."""
    return {"count": len(models), "surfels": max(len(model.surfels) for model in models)}


@torch.no_grad()
def _renderings(scene: Scene, image: RenderImage) -> list[tuple[View, torch.Tensor]]:
    """Return the test views with their renderings."""
    return [(view, to_uint8(image(view.camera)).cpu()) for view in scene.test]


def _restore(trainer: Trainer, folder: Path) -> None:
    """Continue from a checkpoint of other settings, as if it had been made with the trainer's own."""
    tensors, state = load_checkpoint(folder)
    with tempfile.TemporaryDirectory() as own:
        save_checkpoint(Path(own), tensors, state | {"config": trainer.config.as_dict()})
        trainer.restore(Path(own))


def _train_gsplat(job: TrainingJob, row: Row, scene: Scene, device: torch.device) -> Trained:
    from benchmarks import peer_gsplat

    begin = time.perf_counter()
    settings = peer_gsplat.PeerSettings(**row.settings)
    gaussians = peer_gsplat.train(scene, job.size, job.iterations, job.seed, device, settings)
    if device.type == "cuda":
        torch.cuda.synchronize()
    seconds = time.perf_counter() - begin
    memory = _peak("training_mib", device)

    def image(camera: Camera) -> torch.Tensor:
        return gaussians.image(camera.to(device))

    coded, compact_bytes = gaussians.compact()
    facts = {
        "primitives": len(gaussians.splats["means"]),
        "megabytes": gaussians.megabytes,
        "seconds": seconds,
        "train_psnr": train_psnr(scene, image),
        "quarter_psnr": quarter_psnr(scene, image),
        **memory,
    }
    compact = _renderings(scene, lambda camera: coded.image(camera.to(device)))
    return Trained(_renderings(scene, image), facts, compact, compact_bytes)


def _mean(values: Iterable[float | None]) -> float | None:
    known = [x for x in values if x is not None]
    return statistics.fmean(known) if known else None


@lru_cache
def _commit() -> str:
    """Return the commit of this checkout.

    Where the files come without their history, NEXWARP_COMMIT names it; otherwise it is a digest of the sources.
    """
    if name := os.environ.get("NEXWARP_COMMIT"):
        return name
    try:
        return subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return f"sources {sources_digest()}"


def sources_digest(package: Path = ROOT / "nexwarp") -> str:
    """Return a digest of a package's Python files, 12 digits: equal ones train alike."""
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(file.relative_to(package.parent).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()[:12]
