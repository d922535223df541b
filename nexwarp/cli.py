"""Command line: `nexwarp train`, `eval`, `render`, `info`, `warmup`."""

import dataclasses
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from rich.console import Console

from nexwarp import console as display
from nexwarp import warmup
from nexwarp.checkpoint import MODEL_FILE, Model, load, load_cameras, save_cameras, save_model, write_json
from nexwarp.config import Config, LearningRates, TextureConfig, preset
from nexwarp.data import Scene
from nexwarp.evaluate import evaluate
from nexwarp.kernels.types import MAX_HITS
from nexwarp.metrics import to_uint8
from nexwarp.paths import ellipse
from nexwarp.pictures import save_exr, save_png
from nexwarp.render import Rendering, render
from nexwarp.runs import (
    CAMERAS_FILE,
    DEMO,
    METRICS_FILE,
    SceneSource,
    create_run,
    keep_freed_memory,
    pick_device,
    prepare_run,
    read_metrics,
    read_run,
)
from nexwarp.trainer import Trainer

# The demo is small enough for two CPU cores: a short run, so its steps are larger.
DEMO_SETTINGS: dict[str, Any] = {
    "iterations": 1200,
    "max_surfels": 3000,
    "coarse": 0.4,
    "texture": TextureConfig(levels=12, table_size=2**15, width=32),
    "rates": LearningRates(
        means=(5e-4, 5e-6),
        quats=5e-3,
        scales=2.5e-2,
        opacities=0.05,
        gammas=5e-3,
        sh0=1.25e-2,
        shN=6e-4,
        grid=(2e-2, 2e-4),
        mlp=(3e-3, 3e-4),
    ),
}
CHECKPOINTS = 10

Scene_ = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
Run_ = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]


@dataclass
class Train:
    """Train a scene, evaluate it on its test views, and keep everything in a run folder."""

    scene: Scene_
    """Folder of a COLMAP, nerfstudio or Blender scene, or `demo` for the built-in one (docs/scenes.md)."""
    run: Path | None = None
    """Folder to write to; runs/SCENE by default."""
    max_surfels: int | None = None
    """Budget P of surfels, never exceeded (400,000; demo 3,000)."""
    iterations: int | None = None
    """Training steps; schedules stretch with them (30,000; demo 1,200)."""
    downscale: int = 1
    """Reduce photos by this factor, by area."""
    images: str = "images"
    """Folder of the photos below SCENE, such as images_4."""
    masks: str = "masks"
    """Folder of the masks below SCENE, if it is there; `alpha` for the photos' own transparency; `none`."""
    background: str | None = None
    """Behind transparent photos and renderings: white (default of Blender scenes), black, R,G,B up to 1, or random."""
    points: str | None = None
    """PLY file of the points to start from, in place of the scene's own."""
    format: str | None = None
    """`colmap`, `nerfstudio` or `blender`, for a folder that holds more than one of them."""
    max_hits: int | None = None
    """K, hits a pixel textures, 0 to 8 (2); 0 trains without a texture."""
    preset: str = "default"
    """`default`, or `paper` to reproduce the publication."""
    seed: int | None = None
    """Of every random choice (0)."""
    device: str | None = None
    """`cuda` or `cpu`; CUDA where present by default."""
    resume: bool = False
    """Continue the run in --run."""
    overwrite: bool = False
    """Replace the run in --run."""

    def __call__(self, console: Console) -> None:
        """Train."""
        source = self._source()
        run = self.run or Path("runs") / source.name
        prepare_run(run, source, resume=self.resume, overwrite=self.overwrite)
        if self.resume:
            source = self._resumed_source(source, run)
        device = pick_device(self.device)
        config = self._config(run)
        if self.downscale < 1:
            raise ValueError(f"--downscale: expected at least 1, got {self.downscale}")
        console.print(f"{source.name} on {_name(device)}, preset {config.preset}")
        with display.loading(console) as progress:
            scene = source.load(progress)
        if scene.background is not None and not self.resume:
            config = dataclasses.replace(config, background=scene.background)
        size = scene.train[0].camera
        console.print(
            f"{len(scene.train)} training and {len(scene.test)} test views of {size.width}x{size.height}, "
            f"{len(scene.points):,} points"
        )
        if device.type == "cpu":
            keep_freed_memory()
        trainer = Trainer(scene, config, device)
        if self.resume:
            trainer.restore(run)
            console.print(f"resumed at iteration {trainer.iteration:,}")
        else:
            create_run(run, source, config, device.type)
        _train(trainer, run, console)
        _finish(trainer, scene, run, device, console)

    def _source(self) -> SceneSource:
        """The scene that the flags ask for."""
        return SceneSource(
            self.scene, self.images, self.downscale, self.masks, self.background, self.points, self.format
        )

    def _resumed_source(self, source: SceneSource, run: Path) -> SceneSource:
        """Photos as in the run to resume; the scene's folder may have moved, other flags must agree."""
        old, config, _ = read_run(run)
        for flag, default, given, expected in (
            ("--downscale", 1, self.downscale, old.downscale),
            ("--images", "images", self.images, old.images),
            ("--masks", "masks", self.masks, old.masks),
            ("--background", None, self.background, old.background),
            ("--points", None, self.points and str(Path(self.points).resolve()), old.points),
            ("--format", None, self.format, old.format),
            ("--preset", "default", self.preset, config.preset),
        ):
            if given not in (default, expected):
                raise ValueError(f"{flag}: expected {expected} as in the run to resume, got {given}")
        return dataclasses.replace(old, path=source.path)

    def _config(self, run: Path) -> Config:
        """Settings from preset and flags, or, when resuming, from the run, which given flags must agree with."""
        given = {"iterations": self.iterations, "max_surfels": self.max_surfels, "max_hits": self.max_hits}
        given = {name: value for name, value in (given | {"seed": self.seed}).items() if value is not None}
        _check_max_hits(self.max_hits)
        if self.resume:
            config = read_run(run)[1]
            for name, value in given.items():
                if getattr(config, name) != value:
                    flag = f"--{name.replace('_', '-')}"
                    raise ValueError(f"{flag}: expected {getattr(config, name)} as in the run to resume, got {value}")
            return config
        base = preset(self.preset)
        if self.scene == DEMO:
            base = dataclasses.replace(base, **DEMO_SETTINGS)
        return dataclasses.replace(base, **given)


@dataclass
class Eval:
    """Evaluate a run on the test views of its scene."""

    run: Run_
    """Run folder."""
    scene: str | None = None
    """Where the scene is now, if it moved."""
    device: str | None = None
    """`cuda` or `cpu`; CUDA where present by default."""

    def __call__(self, console: Console) -> None:
        """Evaluate."""
        device = pick_device(self.device)
        source, _, _ = read_run(self.run)
        model = load(self.run).to(device)
        if self.scene is not None:
            source = dataclasses.replace(source, path=self.scene)
        with display.loading(console) as progress:
            scene = source.load(progress)
        metrics = _evaluate(model, scene, self.run, console)
        rows = {"test PSNR": f"{metrics['psnr']:.2f} dB", "test SSIM": f"{metrics['ssim']:.4f}"}
        console.print(display.results_table(rows, f"{source.name}: {len(scene.test)} test views"))


@dataclass
class Render:
    """Render a run without its photos: the test views and an ellipse around the scene, as PNG files in its renders/."""

    run: Run_
    """Run folder."""
    frames: int = 120
    """Views on the ellipse; 0 for none."""
    buffers: bool = False
    """Also write each test view's passes as a multi-part OpenEXR file."""
    device: str | None = None
    """`cuda` or `cpu`; CUDA where present by default."""

    @torch.no_grad()
    def __call__(self, console: Console) -> None:
        """Render."""
        if self.frames < 0:
            raise ValueError(f"--frames: expected at least 0, got {self.frames}")
        device = pick_device(self.device)
        model = load(self.run).to(device)
        cameras = load_cameras(self.run / CAMERAS_FILE)
        renders = self.run / "renders"
        jobs = {
            renders / "test" / f"{Path(name).with_suffix('')}.png": c for name, c in cameras.get("test", {}).items()
        }
        if self.frames:
            try:
                path = ellipse(list(cameras.get("train", {}).values()), self.frames)
            except ValueError as error:
                raise ValueError(f"{error}; --frames 0 renders the test views alone") from None
            jobs |= {renders / "ellipse" / f"{i:04d}.png": camera for i, camera in enumerate(path)}
        with display.counting(console, "rendering", len(jobs)) as done:
            for file, camera in jobs.items():
                out = render(model.surfels, model.texture, camera.to(device), **model.render_options)
                save_png(file, to_uint8(out.image).cpu())
                if self.buffers and file.is_relative_to(renders / "test"):
                    save_exr(file.with_suffix(".exr"), pass_buffers(out))
                done()
        console.print(f"{len(jobs)} pictures in {renders}")


@dataclass
class Info:
    """Tell what a run holds."""

    run: Run_
    """Run folder."""

    def __call__(self, console: Console) -> None:
        """Print a table."""
        source, config, _ = read_run(self.run)
        rows = {"scene": source.path, "preset": config.preset, "iterations": f"{config.iterations:,}"}
        if (self.run / MODEL_FILE).is_file():
            model = load(self.run)
            texture = model.texture.config
            rows |= {
                "surfels": f"{len(model.surfels):,} (budget {config.max_surfels:,})",
                "K": str(model.meta["max_hits"]),
                "texture": f"{texture['levels']} levels of {texture['table_size']:,}, "
                f"{texture['min_resolution']:.3g} to {texture['max_resolution']:.3g} cells per unit",
                "model file": f"{(self.run / MODEL_FILE).stat().st_size / 1e6:.1f} MB",
            }
        else:
            rows["model"] = "none yet: the training has not finished"
        if metrics := read_metrics(self.run):
            rows |= {"test PSNR": f"{metrics['psnr']:.2f} dB", "test SSIM": f"{metrics['ssim']:.4f}"}
        console.print(display.results_table(rows, str(self.run)))


@dataclass
class Warmup:
    """Compile ahead of time what train, eval and render need, into Warp's kernel cache."""

    preset: str = "default"
    """`default` or `paper`, as will be given to train."""
    max_hits: int | None = None
    """K, as will be given to train (2)."""
    device: str | None = None
    """`cuda` or `cpu`; CUDA where present by default."""

    def __call__(self, console: Console) -> None:
        """Compile."""
        start = time.perf_counter()
        _check_max_hits(self.max_hits)
        device = pick_device(self.device)
        config = preset(self.preset)
        if self.max_hits is not None:
            config = dataclasses.replace(config, max_hits=self.max_hits)
        before = warmup.cached_binaries()
        builds = warmup.needed(config, device)
        with display.counting(console, "compiling", len(builds) + 1) as done:
            warmup.compile_all(builds, device, done)
            listed = warmup.cached_binaries()
            warmup.rehearse(config, device)
            done()
        cached = warmup.cached_binaries()
        total = len(builds) + len(cached - listed)
        new = min(len(cached - before), total)  # another process may be compiling too
        console.print(
            f"{total} kernels ready on {_name(device)}, preset {config.preset}: {new} compiled, "
            f"{total - new} found in the cache, {time.perf_counter() - start:.1f} s",
            soft_wrap=True,
        )


def pass_buffers(out: Rendering) -> dict[str, torch.Tensor]:
    """Name every pass of a rendering, for an OpenEXR file: (H, W), (H, W, 3) float or (H, W) int32 each."""
    parts = {name: getattr(out, name) for name in ("image", "plain", "textured", "alpha")}
    for k in range(out.ids.shape[2]):
        parts |= {f"{name}.{k}": getattr(out, name)[..., k] for name in ("ids", "depths", "weights")}
    return parts


def _name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"


def _check_max_hits(max_hits: int | None) -> None:
    if max_hits is not None and not 0 <= max_hits <= MAX_HITS:
        raise ValueError(f"--max-hits: expected 0 to {MAX_HITS}, got {max_hits}")


def _train(trainer: Trainer, run: Path, console: Console) -> None:
    """Run the loop with its display; keep checkpoints on the way and when interrupted."""
    total = trainer.config.iterations
    every = max(total // CHECKPOINTS, 1)
    shown = display.TrainingDisplay(console, total, trainer.iteration, trainer.device)
    with shown, _deferred_interrupt() as interrupted:

        def observe(step: Any) -> None:
            shown(step)
            if step.iteration % every == 0 or step.iteration == total or interrupted():
                trainer.save(run)
            if interrupted():
                raise KeyboardInterrupt

        trainer.run(observe)


@contextmanager
def _deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Let a first Ctrl-C wait until it is asked for, between steps: no half step is saved. A second does not wait."""
    asked: list[int] = []

    def handle(number: int, _frame: Any) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield lambda: bool(asked)
    finally:
        signal.signal(signal.SIGINT, before)


def _finish(trainer: Trainer, scene: Scene, run: Path, device: torch.device, console: Console) -> None:
    """Write the model, then evaluate what was written."""
    file = save_model(run, trainer.model())
    sets = {"train": scene.train, "test": scene.test}
    save_cameras(run / CAMERAS_FILE, {name: {v.name: v.camera for v in views} for name, views in sets.items()})
    model = load(run).to(device)
    rate = trainer.iteration / max(trainer.seconds, 1e-9)
    facts = {
        "preset": trainer.config.preset,
        "iterations": trainer.iteration,
        "surfels": len(model.surfels),
        "megabytes": file.stat().st_size / 1e6,
        "seconds": trainer.seconds,
        "iterations_per_second": rate,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
    }
    rows = {}
    if scene.test:
        metrics = _evaluate(model, scene, run, console, facts)
        rows = {"test PSNR": f"{metrics['psnr']:.2f} dB", "test SSIM": f"{metrics['ssim']:.4f}"}
    rows |= {
        "surfels": f"{facts['surfels']:,}",
        "model file": f"{facts['megabytes']:.1f} MB",
        "training": f"{facts['seconds']:.0f} s, {rate:.1f} it/s",
        "run": str(run),
    }
    console.print(display.results_table(rows, f"{len(scene.test)} test views"))
    if scene.test:
        first = Path(scene.test[0].name).with_suffix("")
        console.print(f"photo, render, error: {run / 'renders' / 'compare' / f'{first}.png'}")


def _evaluate(
    model: Model, scene: Scene, run: Path, console: Console, facts: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Evaluate a model on its test views and write metrics.json, keeping the facts that an older one holds."""
    if not scene.test:
        raise ValueError(f"{scene.path}: expected test views, found none")
    with display.counting(console, "evaluating", len(scene.test)) as done:
        results = evaluate(
            model.surfels,
            model.texture,
            scene.test,
            options=model.render_options,
            renders=run / "renders",
            progress=done,
        )
    metrics = {**(read_metrics(run) if facts is None else facts), **results}
    write_json(run / METRICS_FILE, metrics)
    return metrics


def main(arguments: list[str] | None = None) -> int:
    """Run a command; bad input gives one line on stderr and exit code 2."""
    import warp as wp

    # Warp's notes on a missing CUDA driver or on kernels it compiles are no news to a person at a terminal.
    wp.config.log_level = wp.LOG_ERROR
    commands = {"train": Train, "eval": Eval, "render": Render, "info": Info, "warmup": Warmup}
    command = tyro.extras.subcommand_cli_from_dict(
        commands, prog="nexwarp", description="Nexels: neurally-textured surfels.", args=arguments
    )
    console = Console()
    try:
        command(console)
    except (ValueError, OSError) as error:
        message = " ".join(f"nexwarp: error: {error}".split())
        Console(stderr=True, soft_wrap=True, highlight=False).print(message, markup=False)
        return 2
    except KeyboardInterrupt:
        hint = "; continue with --resume" if isinstance(command, Train) else ""
        Console(stderr=True).print(f"nexwarp: interrupted{hint}")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
