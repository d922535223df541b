"""Quality on real scenes: nexwarp beside gsplat's 3DGS-MCMC, the paper's ablations, the worth of each change of ours.

    python -m benchmarks.quality train --tables peers,hits --data DIR --out results.jsonl
    python -m benchmarks.quality table results.jsonl --out quality.md --json quality.json
    python -m benchmarks.quality curve results.jsonl --scene fox --out curve.png
    python -m benchmarks.quality train --tables demo --seeds 0 --pictures DIR --out demo.jsonl

`train` appends one JSON line a training, and leaves out what the file holds already: it can be stopped and resumed, on
several machines too. Rows of which only K or the removal of floaters differs train alike until that counts
(`more_hits_from`, `densify.stop`): up to there they are one training. The table `demo` needs no data: the built-in
scene, neighbouring cameras held out, minutes on a CPU. `table` makes Markdown of the lines, means and spreads over
seeds, and what each row has more than the default, or the row `--against`, on the mean of the scenes; nothing is
trained twice for two tables. `curve` draws a metric over the number of primitives. Metrics are those of
`nexwarp.run.metrics`; LPIPS needs the weights of VGG and is left out where they cannot be had. Speed and memory of a
training count when it ran alone (`--jobs 1`).
"""

import argparse
import dataclasses
import gc
import hashlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from functools import lru_cache
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any

import torch

from benchmarks.quality_rows import DEFAULT, DEMO, ROWS, SCENES, TABLES, Job, Row, config_of, jobs_of, together
from benchmarks.quality_tables import (
    DIGITS,
    METRICS,
    OTHERS,
    UNITS,
    curves_of,
    differences,
    drop_unfinished,
    markdown,
    read_results,
    summary,
)
from benchmarks.timing import ROOT
from nexwarp.camera import Camera
from nexwarp.data import Scene, View, load_scene
from nexwarp.data.demo import demo_folder
from nexwarp.data.images import downscale_image, downscale_mask
from nexwarp.io.pictures import error_map, save_png, side_by_side, to_uint8
from nexwarp.model.model_file import save_model
from nexwarp.render import render
from nexwarp.run.evaluate import METRICS as JUDGES
from nexwarp.run.metrics import CONVENTION, psnr
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from nexwarp.train.config import Config
from nexwarp.train.trainer import Trainer

ARC = 8  # held-out cameras in a row


# Scenes


def arc(scene: Scene) -> Scene:
    """Hold out a run of neighbouring cameras from the middle of the capture instead of every 8th."""
    views = sorted((*scene.train, *scene.test), key=lambda view: view.name)
    first = (len(views) - ARC) // 2
    test = views[first : first + ARC]
    return dataclasses.replace(scene, train=views[:first] + views[first + ARC :], test=test)


def moved(scene: Scene, factor: float = 1.0, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scene:
    """Map world points x to factor x + shift."""
    offset = torch.tensor(shift, dtype=torch.float64)

    def view(v: View) -> View:
        viewmat = v.camera.viewmat.double().clone()
        viewmat[:3, 3] = factor * viewmat[:3, 3] - viewmat[:3, :3] @ offset
        c = v.camera
        camera = Camera(viewmat.float(), c.K, c.width, c.height, c.near * factor)
        points = None if v.points is None else (factor * v.points.double() + offset).float()
        return dataclasses.replace(v, camera=camera, points=points)

    return dataclasses.replace(
        scene,
        train=[view(v) for v in scene.train],
        test=[view(v) for v in scene.test],
        points=(factor * scene.points.double() + offset).float(),
        scale=factor * scene.scale,
    )


VARIANTS = {
    "arc": arc,
    "x100": lambda scene: moved(scene, factor=100.0),
    "moved": lambda scene: moved(scene, shift=(1000.0, 0.0, 0.0)),
}


@lru_cache(maxsize=1)
def _load(path: Path, variant: str, downscale: int) -> Scene:
    scene = load_scene(path, downscale=downscale)
    return VARIANTS[variant](scene) if variant else scene


def _scene(job: Job, data: Path) -> Scene:
    return _load(demo_folder() if job.scene == DEMO else data / job.scene, job.variant, job.downscale)


# One training


@dataclass(frozen=True)
class Beginning:
    """What several trainings have in common.

    Attributes:
        rows: of the trainings.
        iterations: how many.
        folder: with a checkpoint from there.
    """

    rows: tuple[str, ...]
    iterations: int
    folder: Path


def begin(jobs: Sequence[Job], data: Path, row: Row, iterations: int, folder: Path) -> Beginning:
    """Train what several trainings have in common.

    Args:
        jobs: those.
        data: folder of the scenes.
        row: of any of them.
        iterations: how many.
        folder: for the checkpoint.
    """
    job = jobs[0]
    trainer = Trainer(_scene(job, data), config_of(job, row), _device())
    trainer.run(until=iterations)
    folder.mkdir()
    trainer.save(folder)
    return Beginning(tuple(job.row for job in jobs), iterations, folder)


def run_job(
    job: Job,
    data: Path,
    row: Row,
    pictures: Path | None = None,
    models: Path | None = None,
    beginning: Beginning | None = None,
) -> dict[str, Any]:
    """Train, render the test views and compare.

    Args:
        job: what to train.
        data: folder of the scenes.
        row: the job's.
        pictures: folder for photo, render and error of each test view.
        models: folder to keep the model in.
        beginning: where to go on from.

    Returns:
        A line of the results: the job and its row's settings; means of the metrics (None where one cannot be had);
        `primitives`, `megabytes` of the model file, `seconds` from the loaded scene to the trained model, `peak_mib` of
        GPU memory (torch's); of nexwarp `config`, which tells its settings apart, `removed_last`, the floaters that its
        last look took away, `train_psnr`, `zoom_psnr` and `quarter_psnr`; `together`, the rows and iterations of its
        beginning, if any; the metrics by view; device, date and commit.
    """
    device = _device()
    scene = _scene(job, data)
    if device.type == "cuda":
        gc.collect()  # what the training before it in this process held
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    if row.preset is None:
        pictured, facts = _train_gsplat(job, scene, device)
    else:
        pictured, facts = _train_nexwarp(job, row, scene, device, models, beginning)
    if device.type == "cuda":
        facts["peak_mib"] = round(torch.cuda.max_memory_allocated() / 2**20)
    views = {}
    for view, image in pictured:
        photo = to_uint8(view.image)
        views[view.name] = {name: judge(image, photo, view.mask) for name, judge in JUDGES.items()}
        if pictures is not None:
            name = f"{_name(job)}-{Path(view.name).stem}"
            strip = [photo, image, error_map(image, photo)]
            captions = ["photo", f"{job.row}, {views[view.name]['psnr']:.2f} dB", "error (0 to 0.25)"]
            save_png(pictures / f"{name}.png", side_by_side(strip, captions=captions))
    return {
        **asdict(job),
        "settings": row.settings,
        **{key: _mean(v[key] for v in views.values()) for key in METRICS},
        **facts,
        "views": views,
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "date": time.strftime("%Y-%m-%d"),
        "commit": _commit(),
    }


def _device() -> torch.device:
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _name(job: Job) -> str:
    """Of a training's files."""
    reduced = f"-downscale{job.downscale}" if job.downscale > 1 else ""
    return f"{job.scene}{job.variant}-{job.row}-{job.size}-{job.seed}{reduced}".replace(" ", "_")


def _train_nexwarp(
    job: Job, row: Row, scene: Scene, device: torch.device, models: Path | None, beginning: Beginning | None
) -> tuple[Any, dict]:
    start = time.perf_counter()
    trainer = Trainer(scene, config_of(job, row), device)
    shared = {}
    if beginning is not None:
        _go_on(trainer, beginning.folder)
        shared = {"together": {"rows": beginning.rows, "iterations": beginning.iterations}}
    begun = trainer.seconds  # of the beginning
    # The last look for floaters is part of the last iteration.
    trainer.run(until=trainer.config.iterations - 1)
    before = len(trainer.surfels)
    trainer.run()
    model = trainer.finish()
    seconds = begun + time.perf_counter() - start

    def image(camera: Camera) -> torch.Tensor:
        return render(model.surfels, model.texture, camera.to(device), **model.render_options).image

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if models is not None:
            folder = models / _name(job)
            folder.mkdir(parents=True, exist_ok=True)
        megabytes = save_model(folder, model).stat().st_size / 1e6
    facts = {
        "primitives": len(trainer.surfels),
        "removed_last": before - len(trainer.surfels),
        "megabytes": megabytes,
        "seconds": seconds,
        "config": config_name(trainer.config),
        "train_psnr": _train_psnr(scene, image),
        "zoom_psnr": _zoom_psnr(scene, image),
        "quarter_psnr": _quarter_psnr(scene, image),
        **shared,
    }
    with torch.no_grad():
        pictured = [(view, to_uint8(image(view.camera)).cpu()) for view in scene.test]
    return pictured, facts


def config_name(config: Config) -> str:
    """The same for the same settings, whatever the seed."""
    settings = {name: value for name, value in config.as_dict().items() if name != "seed"}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]


def _go_on(trainer: Trainer, folder: Path) -> None:
    """From a checkpoint of other settings, as if it had been made with the trainer's own."""
    tensors, state = load_checkpoint(folder)
    with tempfile.TemporaryDirectory() as own:
        save_checkpoint(Path(own), tensors, state | {"config": trainer.config.as_dict()})
        trainer.restore(Path(own))


@torch.no_grad()
def _train_psnr(scene: Scene, image: Callable[[Camera], torch.Tensor]) -> float:
    """Of every 8th training view."""
    views = scene.train[::8]
    return statistics.fmean(psnr(to_uint8(image(view.camera)).cpu(), to_uint8(view.image)) for view in views)


@torch.no_grad()
def _zoom_psnr(scene: Scene, image: Callable[[Camera], torch.Tensor]) -> float:
    """Of the middles of the test views, looked at with 4 times the focal length, reduced again, against themselves."""
    figures = []
    for view in scene.test:
        c, factor = view.camera, 4
        width, height = c.width // factor, c.height // factor
        left, top = (c.width - width) // 2, (c.height - height) // 2
        K = c.K.clone()
        K[:2] *= factor
        close = Camera(c.viewmat, K, c.width * factor, c.height * factor, c.near)
        close = close.crop(left * factor, top * factor, width * factor, height * factor)
        zoomed = image(close).clamp(0, 1).permute(2, 0, 1)
        reduced = torch.nn.functional.avg_pool2d(zoomed, factor).permute(1, 2, 0)
        plain = image(c)[top : top + height, left : left + width]
        figures.append(psnr(to_uint8(reduced).cpu(), to_uint8(plain).cpu()))
    return statistics.fmean(figures)


def smaller(camera: Camera, factor: int) -> Camera:
    """A camera whose pixels are blocks of pixels, as `downscale_image` makes them."""
    K = camera.K.clone()
    K[:2] /= factor
    return Camera(camera.viewmat, K, camera.width // factor, camera.height // factor, camera.near)


@torch.no_grad()
def _quarter_psnr(scene: Scene, image: Callable[[Camera], torch.Tensor]) -> float:
    """Of the test views at a quarter of the size, as from farther away, against their photos reduced by 4."""
    figures = []
    for view in scene.test:
        small = to_uint8(image(smaller(view.camera, 4))).cpu()
        mask = None if view.mask is None else downscale_mask(view.mask, 4)
        figures.append(psnr(small, downscale_image(to_uint8(view.image), 4), mask))
    return statistics.fmean(figures)


def _train_gsplat(job: Job, scene: Scene, device: torch.device) -> tuple[Any, dict]:
    from benchmarks import peer_gsplat

    start = time.perf_counter()
    gaussians = peer_gsplat.train(scene, job.size, job.iterations, job.seed, device)
    if device.type == "cuda":
        torch.cuda.synchronize()
    seconds = time.perf_counter() - start

    def image(camera: Camera) -> torch.Tensor:
        return gaussians.render(camera.to(device))[0]

    with torch.no_grad():
        pictured = [(view, to_uint8(image(view.camera)).cpu()) for view in scene.test]
    facts = {"primitives": len(gaussians.splats["means"]), "megabytes": gaussians.megabytes, "seconds": seconds}
    return pictured, facts | {"quarter_psnr": _quarter_psnr(scene, image)}


def _mean(values: Iterable[float | None]) -> float | None:
    values = [x for x in values if x is not None]
    return statistics.fmean(values) if values else None


@lru_cache
def _commit() -> str:
    """Of this checkout; NEXWARP_COMMIT names it where the files are there without their history."""
    if name := os.environ.get("NEXWARP_COMMIT"):
        return name
    try:
        return subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


# Commands


def train(given: argparse.Namespace) -> int:
    """Do what is missing."""
    rows = dict(ROWS)
    wanted: dict[Job, None] = {}
    seeds = [int(x) for x in given.seeds.split(",")]
    scenes = given.scenes.split(",")
    only = given.only.split(",") if given.only else [*ROWS]
    if unknown := [name for name in only if name not in ROWS]:
        raise ValueError(f"--only: expected some of {', '.join(ROWS)}, got {', '.join(unknown)}")
    for table in filter(None, (given.tables or "").split(",")):
        for job in jobs_of(table, scenes, seeds, given.iterations, given.size):
            if job.row in only:
                wanted[dataclasses.replace(job, downscale=given.downscale)] = None
    for text in given.row or ():
        # NAME:PRESET:SETTINGS, for trying things out.
        name, base, settings = text.split(":", 2)
        row = Row(name, base or "default", json.loads(settings or "{}")) if base != "gsplat" else Row(name, None)
        if rows.setdefault(name, row) != row:
            raise ValueError(f"--row: expected a name that no other row has, got {name}")
        for scene in scenes:
            for seed in seeds:
                wanted[Job(scene, given.variant, name, given.size, seed, given.iterations, given.downscale)] = None
    given.out.parent.mkdir(parents=True, exist_ok=True)
    have = {}
    if given.out.exists():
        if drop_unfinished(given.out):
            print(f"{given.out}: its last line was unfinished and is cut off")
        have = read_results([given.out])
    for job in wanted.keys() & have.keys():
        before, row = have[job].get("config"), rows[job.row]
        if before and row.preset is not None and before != config_name(config_of(job, row)):
            told = f"{job.scene} {job.row} {job.size} seed {job.seed} with the settings of today"
            raise ValueError(f"{given.out}: expected {told}, got others ({have[job]['commit']}): give another --out")
    jobs = [job for job in wanted if job not in have]
    print(f"{len(jobs)} of {len(wanted)} trainings to do")
    return _train_all(jobs, rows, given)


def _train_all(jobs: Sequence[Job], rows: Mapping[str, Row], given: argparse.Namespace) -> int:
    """Do these, `given.jobs` at once; each result is appended to `given.out` as it comes. Return the exit code."""
    failed = 0
    workers = ProcessPoolExecutor(given.jobs, get_context("spawn"), initializer=_end_with_parent)
    with tempfile.TemporaryDirectory() as beginnings, workers as pool:
        waiting: dict[Future, list[Job]] = {}

        def start(job: Job, beginning: Beginning | None = None) -> None:
            future = pool.submit(run_job, job, given.data, rows[job.row], given.pictures, given.models, beginning)
            waiting[future] = [job]

        try:
            for number, (members, alike) in enumerate(together(jobs, rows)):
                if alike:
                    folder = Path(beginnings) / str(number)
                    future = pool.submit(begin, members, given.data, rows[members[0].row], alike, folder)
                    waiting[future] = members
                else:
                    start(*members)
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    members = waiting.pop(future)
                    try:
                        result = future.result()
                    except Exception as error:  # one failure must not lose the others' results
                        failed += len(members)
                        for job in members:
                            print(f"{job}: {type(error).__name__}: {error}", file=sys.stderr)
                        continue
                    if isinstance(result, Beginning):
                        for job in members:
                            start(job, result)
                        continue
                    with given.out.open("a") as file:
                        file.write(json.dumps(result | {"jobs": given.jobs}) + "\n")
                    print(_told(members[0], result), flush=True)
        except KeyboardInterrupt:
            for worker in active_children():  # else each would train to its end, and then what waits
                worker.terminate()
            print("interrupted: the same command does what is missing", file=sys.stderr)
            return 130
    return 1 if failed else 0


def _end_with_parent() -> None:
    """For a worker: not to outlive the command, however that ends; Ctrl-C in a terminal is the command's to handle."""

    def follow() -> None:
        parent_process().join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=follow, daemon=True).start()


def _told(job: Job, result: dict[str, Any]) -> str:
    """A training in a line."""
    facts = [f"{UNITS[m]} {result[m]:.{DIGITS[m]}f}" for m in METRICS if result[m] is not None]
    facts += [f"{k[:-5]} {result[k]:.2f} dB" for k in OTHERS if k in result]
    facts.append(f"{result['seconds']:.0f} s")
    return f"{job.scene}{job.variant} {job.row} {job.size} seed {job.seed}: {', '.join(facts)}"


def table(given: argparse.Namespace) -> int:
    """Write Markdown, and JSON where that is asked for."""
    results = read_results(given.results)
    rows = {DEFAULT.name} | {job.row for job in results}
    if given.against not in rows:
        print(f"--against: expected one of {', '.join(sorted(rows))}, got {given.against}")
        return 2
    text = markdown(results, given.against)
    if given.json:
        tables = {"convention": CONVENTION, "rows": summary(results), "against": given.against}
        tables["differences"] = differences(results, given.against)
        given.json.write_text(json.dumps(tables, indent=1) + "\n")
    if given.out:
        given.out.write_text(text)
    else:
        print(text)
    return 0


def curve(given: argparse.Namespace) -> int:
    """Draw a metric over the number of primitives."""
    curves = curves_of(read_results(given.results), given.scene, given.metric, given.iterations)
    if not curves:
        print(f"--scene: expected one with results of {given.iterations:,} iterations, got {given.scene}")
        return 2
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for name, points in curves.items():
        sizes, means, spreads = zip(*points, strict=True)
        label = "nexwarp" if name == DEFAULT.name else name
        axes.errorbar(sizes, means, yerr=spreads, marker="o", capsize=3, label=label)
    sizes = sorted({size for points in curves.values() for size, _, _ in points})
    better = "lower is better" if given.metric in ("flip", "lpips") else "higher is better"
    axes.set(xscale="log", xlabel="primitives", ylabel=f"{UNITS[given.metric]}, {better}")
    axes.set_title(f"{given.scene}, test views; bars: standard deviation over seeds", fontsize="medium")
    axes.set_xticks(sizes, [f"{size // 1000}K" for size in sizes])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(given.out, dpi=150)
    pyplot.close(figure)
    for name, points in curves.items():
        print(f"{name}: " + ", ".join(f"{size:,} {mean:.{DIGITS[given.metric]}f}" for size, mean, _ in points))
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality", description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    training = commands.add_parser("train", help="do the trainings of some tables that are not there yet")
    training.set_defaults(run=train)
    training.add_argument("--tables", help=f"comma-separated: {', '.join(TABLES)}")
    training.add_argument("--only", help="comma-separated rows of the tables; default: all of them")
    training.add_argument("--row", action="append", help="NAME:PRESET:JSON settings, to try something out")
    training.add_argument("--variant", default="", choices=("", *VARIANTS), help="of the scene, for --row")
    training.add_argument(
        "--scenes",
        default=",".join(SCENES),
        help="default: %(default)s; curve, arc and frames are of fox alone, demo of the built-in scene",
    )
    training.add_argument("--seeds", default="0,1", help="default: %(default)s")
    training.add_argument(
        "--size", type=int, default=40_000, help="budget of primitives (default: %(default)s), but for the curve"
    )
    training.add_argument("--iterations", type=int, default=30_000, help="default: %(default)s")
    training.add_argument("--downscale", type=int, default=1, help="reduce photos by (default: %(default)s)")
    training.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the scenes")
    training.add_argument("--out", type=Path, default=Path("quality.jsonl"), help="default: %(default)s")
    training.add_argument("--jobs", type=int, default=1, help="trainings at once (default: %(default)s)")
    training.add_argument("--pictures", type=Path, help="folder for photo, render and error of each test view")
    training.add_argument("--models", type=Path, help="folder to keep the models in")
    tables = commands.add_parser("table", help="make Markdown of results")
    tables.set_defaults(run=table)
    tables.add_argument("results", type=Path, nargs="+")
    tables.add_argument("--against", default=DEFAULT.name, help="row to compare with (default: %(default)s)")
    tables.add_argument("--out", type=Path, help="file to write; default: the screen")
    tables.add_argument("--json", type=Path, help="file to write the same to, as JSON")
    curves = commands.add_parser("curve", help="draw a metric over the number of primitives")
    curves.set_defaults(run=curve)
    curves.add_argument("results", type=Path, nargs="+")
    curves.add_argument("--scene", default="fox", help="default: %(default)s")
    curves.add_argument("--metric", default="flip", choices=METRICS, help="default: %(default)s")
    curves.add_argument("--iterations", type=int, default=30_000, help="default: %(default)s")
    curves.add_argument("--out", type=Path, required=True, help="picture to write")
    given = parser.parse_args(arguments)
    return given.run(given)


if __name__ == "__main__":
    sys.exit(main())
