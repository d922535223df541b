"""Command line: `nexwarp train`, `eval`, `render`, `export`, `view`, `info`, `sfm`, `warmup`."""

import dataclasses
import io
import re
import signal
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import torch
import tyro
from rich.console import Console

from nexwarp import console as display
from nexwarp import warmup
from nexwarp.checkpoint import (
    CHECKPOINTS,
    MODEL_FILE,
    Model,
    has_checkpoint,
    load,
    load_cameras,
    save_cameras,
    save_model,
    write_json,
)
from nexwarp.config import Config, parse_settings, preset, setting, with_settings
from nexwarp.data import Scene
from nexwarp.errors import DivergedError, NexwarpError, OutOfMemoryError, SceneError, SettingError, StorageError
from nexwarp.evaluate import evaluate
from nexwarp.export import MAX_EXTENT
from nexwarp.kernels.types import MAX_HITS
from nexwarp.logs import TrainingLog, check_tensorboard
from nexwarp.outputs import RenderOrder, export_run
from nexwarp.runs import (
    CAMERAS_FILE,
    DEMO,
    METRICS_FILE,
    SceneSource,
    check_room,
    create_run,
    keep_camera_path,
    keep_freed_memory,
    pick_device,
    prepare_run,
    read_metrics,
    read_run,
    tidy_run,
)
from nexwarp.sfm import SfmOptions, reconstruct
from nexwarp.signals import Stopped, deferred_stop, stopped_by_signals
from nexwarp.trainer import Trainer
from nexwarp.watch import needed_memory

if TYPE_CHECKING:
    from nexwarp.viewer import Viewer

# The demo is small enough for two CPU cores: a short run, so its steps are larger.
DEMO_SETTINGS: dict[str, Any] = {
    "iterations": 1200,
    "max_surfels": 3000,
    "coarse": 0.4,
    "depth_jitter": 0.5,
    "texture.levels": 12,
    "texture.table_size": 2**15,
    "texture.features": 2,
    "texture.width": 32,
    "rates.means": (5e-4, 5e-6),
    "rates.quats": 5e-3,
    "rates.scales": 2.5e-2,
    "rates.opacities": 0.05,
    "rates.gammas": 5e-3,
    "rates.sh0": 1.25e-2,
    "rates.shN": 6e-4,
    "rates.grid": (2e-2, 2e-4),
    "rates.mlp": (3e-3, 3e-4),
}
CHECKPOINTS_A_RUN = 10
DIVERGED_FILE = "diverged.json"


def option(metavar: str, default: str | None = None) -> Any:
    """How --help shows an option's value, and its default where None stands for it."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=None if default is None else f"(default: {default})")


Scene_ = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
Run_ = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
Device_ = Annotated[str | None, option("{cuda,cpu}", "cuda where there is one, else cpu")]
Preset_ = Annotated[str, option("{default,paper}")]
Port_ = Annotated[int, option("PORT")]
Host_ = Annotated[str, option("ADDRESS")]


@dataclass
class Train:
    """Train a scene, evaluate it on its test views, and keep everything in a run folder."""

    scene: Scene_
    """Folder of a COLMAP, nerfstudio or Blender scene, or `demo` for the built-in one (docs/scenes.md)."""
    run: Annotated[Path | None, option("RUN", "runs/SCENE")] = None
    """Folder to write to."""
    max_surfels: Annotated[int | None, option("P", "400000; demo 3000")] = None
    """Budget of surfels, never exceeded."""
    iterations: Annotated[int | None, option("N", "30000; demo 1200")] = None
    """Training steps, one photo each; schedules stretch with them."""
    downscale: Annotated[int, option("N")] = 1
    """Reduce photos by this factor, by area."""
    images: Annotated[str, option("FOLDER")] = "images"
    """Folder of the photos below SCENE, such as images_4."""
    masks: Annotated[str, option("{FOLDER,alpha,none}")] = "masks"
    """Folder of the masks below SCENE, if it is there; `alpha` takes the photos' own transparency."""
    mask_mode: Annotated[str | None, option("{ignore,background}", "ignore")] = None
    """What masks leave out: learn nothing there, or learn that nothing is there."""
    background: Annotated[
        str | None, option("{white,black,R,G,B,random}", "white for Blender scenes, else photos count as opaque")
    ] = None
    """Colour behind transparent photos, and behind renderings; R,G,B go up to 1, `random` is another each step."""
    points: Annotated[str | None, option("FILE.ply", "the scene's own points")] = None
    """Points to start from."""
    format: Annotated[str | None, option("{colmap,nerfstudio,blender}", "the one that is there")] = None
    """Kind of the scene, for a folder that holds more than one."""
    max_hits: Annotated[int | None, option("K", "2")] = None
    """K: ray-surfel hits that are textured in each pixel, 0 to 8; 0 trains without a texture."""
    preset: Preset_ = "default"
    """Settings to start from: nexwarp's own, or those of the publication (docs/paper.md)."""
    settings: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(name="set", metavar="KEY=VALUE", help_behavior_hint="(repeatable)"),
    ] = ()
    """Change any setting of docs/options.md, such as texture.max_resolution=1024; VALUE is JSON or a bare word."""
    seed: Annotated[int | None, option("N", "0")] = None
    """Random seed."""
    deterministic: bool = False
    """Give the same bits in every run also on CUDA; slower. A CPU always does."""
    device: Device_ = None
    """Where to train."""
    resume: bool = False
    """Continue the run in --run, however it ended: with its settings, whatever else is given must agree with them."""
    checkpoint_every: Annotated[int | None, option("N", "a tenth of the run")] = None
    """Iterations between checkpoints, of which the last two are kept."""
    overwrite: bool = False
    """Replace the run in --run."""
    view: bool = False
    """Show the training in the browser (extra `viewer`); afterwards the result, until Ctrl-C."""
    host: Host_ = "127.0.0.1"
    """Where --view listens; 0.0.0.0 lets other machines look."""
    port: Port_ = 8080
    """Port for --view; 0 takes any free one."""
    tensorboard: bool = False
    """Also log into RUN/tensorboard, for `tensorboard --logdir runs` (extra `tensorboard`)."""

    def __call__(self, console: Console) -> None:
        """Train."""
        source = self._source()
        run = self.run or Path("runs") / source.name
        resume = prepare_run(run, source, resume=self.resume, overwrite=self.overwrite)
        if self.checkpoint_every is not None and self.checkpoint_every < 1:
            raise SettingError(f"--checkpoint-every: expected at least 1, got {self.checkpoint_every}")
        if resume:
            source = self._resumed_source(source, run)
        device = pick_device(self.device)
        config = self._config(run, resume)
        if self.tensorboard:
            check_tensorboard()
        if self.view:
            from nexwarp.viewer import check_server

            check_server(self.host, self.port)
        if self.downscale < 1:
            raise SettingError(f"--downscale: expected at least 1, got {self.downscale}")
        console.print(f"{source.name} on {_name(device)}, preset {config.preset}")
        with display.loading(console) as progress:
            scene = source.load(progress)
        if scene.background is not None and not resume:
            if "background" in parse_settings(self.settings):
                raise SettingError("--set: background: expected --background instead: the photos are put on it, too")
            config = dataclasses.replace(config, background=scene.background)
        size = scene.train[0].camera
        console.print(
            f"{len(scene.train)} training and {len(scene.test)} test views of {size.width}x{size.height}, "
            f"{len(scene.points):,} points"
        )
        if device.type == "cpu":
            keep_freed_memory()
        trainer = Trainer(scene, config, device)
        kept = sum((run / name).is_dir() for name in CHECKPOINTS) if resume else 0
        # While one is written, the last two are there too.
        check_room(run, max(4 - kept, 1) * trainer.checkpoint_size())
        if resume:
            tidy_run(run)
        if resume and has_checkpoint(run):
            trainer.restore(run, partial(_warn, console))
            console.print(f"resumed at iteration {trainer.iteration:,}")
        elif self.resume:
            console.print(f"{run}: no checkpoint yet, so training starts anew", soft_wrap=True)
        with self._viewer(trainer, run, source.name, console) as viewer:
            if not resume:
                create_run(run, source, config, device.type)
            _train(trainer, run, console, viewer, tensorboard=self.tensorboard, every=self.checkpoint_every)
            try:
                model = _finish(trainer, scene, run, device, console)
            except OSError as error:
                raise StorageError(f"{error}; the training is done and kept: --resume finishes the run") from error
            except (MemoryError, RuntimeError) as error:
                if isinstance(error, NexwarpError) or (needed := needed_memory(error)) is None:
                    raise
                raise OutOfMemoryError(
                    f"out of memory: it needed {needed}; the training is done and kept: --resume finishes the run"
                ) from error
            if viewer is not None:
                viewer.finish(f"{trainer.iteration:,} iterations done", lambda: _shown(model, config))
                _show(viewer, console)

    def _viewer(self, trainer: Trainer, run: Path, title: str, console: Console) -> Any:
        """A context with the viewer of a training, or with None."""
        if not self.view:
            return nullcontext()
        from nexwarp.viewer import Viewer

        sets = {"train": trainer.scene.train, "test": trainer.scene.test}
        viewer = Viewer(
            lambda: (trainer.surfels, trainer.texture if trainer.config.max_hits else None, trainer.render_options()),
            {group: {view.name: view.camera for view in views} for group, views in sets.items()},
            near=trainer.scene.train[0].camera.near,
            title=title,
            host=self.host,
            port=self.port,
            photos={f"{group}/{v.name}": partial(getattr, v, "image") for group, views in sets.items() for v in views},
            total=trainer.config.iterations,
            save_path=partial(keep_camera_path, run),
        )
        console.print(f"viewer: {viewer.url}")
        return viewer

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
                raise SettingError(f"{flag}: expected {expected} as in the run to resume, got {given}")
        return dataclasses.replace(old, path=source.path)

    def _config(self, run: Path, resume: bool = False) -> Config:
        """Settings from preset and flags, or, when resuming, from the run, which given flags must agree with."""
        given = {"iterations": self.iterations, "max_surfels": self.max_surfels, "max_hits": self.max_hits}
        given |= {"seed": self.seed, "mask_mode": self.mask_mode, "deterministic": self.deterministic or None}
        given = {name: value for name, value in given.items() if value is not None}
        _check_max_hits(self.max_hits)
        settings = self._settings(given)
        if resume:
            config = read_run(run)[1]
            for name, value in given.items():
                if getattr(config, name) != value:
                    flag = f"--{name.replace('_', '-')}"
                    raise SettingError(f"{flag}: expected {getattr(config, name)} as in the run to resume, got {value}")
            changed = _with_settings(config, settings)
            for name in settings:
                old, new = setting(config, name), setting(changed, name)
                if name == "cuda_graphs":  # shapes nothing
                    config = dataclasses.replace(config, cuda_graphs=new)
                elif old != new:
                    raise SettingError(f"--set: {name}: expected {old} as in the run to resume, got {new}")
            return config
        base = preset(self.preset)
        if self.scene == DEMO:
            base = with_settings(base, DEMO_SETTINGS)
        return _with_settings(dataclasses.replace(base, **given), settings)

    def _settings(self, given: dict[str, Any]) -> dict[str, Any]:
        """What --set asks for; a setting has one flag alone."""
        try:
            settings = parse_settings(self.settings)
        except ValueError as error:
            raise SettingError(f"--set: {error}") from None
        for name in settings:
            if name == "preset" or name in given:
                flag = f"--{name.replace('_', '-')}"
                raise SettingError(f"--set: {name}: expected {flag} alone, got {name} with --set")
        return settings


@dataclass
class Eval:
    """Evaluate a run on the test views of its scene."""

    run: Run_
    """Run folder."""
    scene: Annotated[str | None, option("SCENE", "where it was trained from")] = None
    """Folder of the scene, if it moved."""
    metrics: Annotated[tuple[str, ...], option("{psnr,ssim,flip,lpips} ...", "psnr ssim")] = ("psnr", "ssim")
    """Figures to give; flip and lpips need the extras `flip` and `lpips`."""
    device: Device_ = None
    """Where to compute."""

    def __call__(self, console: Console) -> None:
        """Evaluate."""
        device = pick_device(self.device)
        source, config, _ = read_run(self.run)
        model = load(self.run).to(device)
        if self.scene is not None:
            source = dataclasses.replace(source, path=self.scene)
        with display.loading(console) as progress:
            scene = source.load(progress)
        options = {"mask_mode": config.mask_mode, "metrics": self.metrics}
        rows = _figures(_evaluate(model, scene, self.run, console, options), self.metrics)
        console.print(display.results_table(rows, f"{source.name}: {len(scene.test)} test views"))


@dataclass
class Render:
    """Render a run, without its photos, into its renders/: still views, a camera path, a video of it, all passes.

    Without options: the test views and an ellipse of 120 frames. With --path or --video: that path alone. With --set:
    those views alone. Together: both. docs/outputs.md describes paths and files.
    """

    run: Run_
    """Run folder."""
    path: Annotated[str | None, option("{ellipse,spiral,interpolate,FILE.json}", "ellipse")] = None
    """Camera path; FILE.json is nerfstudio's camera path or a transforms.json."""
    video: Annotated[Path | None, option("FILE", "none")] = None
    """Also write the path as a video: .mp4, .mov, .mkv (H.264) or .webm (VP9); needs the extra `video`."""
    frames: Annotated[int | None, option("N", "120, or what FILE.json says")] = None
    """Frames of the path; 0 for no path."""
    fps: Annotated[float | None, option("N", "30, or what FILE.json says")] = None
    """Frames a second of the video."""
    set: Annotated[str | None, option("{test,train,all}", "test where no path is asked for")] = None
    """Still views to render."""
    buffers: bool = False
    """Also write all passes of each still view, or where there is none of each frame, as one OpenEXR file."""
    size: Annotated[str | None, option("WIDTHxHEIGHT", "that of the photos")] = None
    """Pixels, such as 1920x1080; what is seen from top to bottom stays."""
    scale: Annotated[float, option("FACTOR")] = 1.0
    """Factor on the size, instead of --size."""
    exposure: Annotated[str, option("{photos,mean}")] = "photos"
    """Brightness and white balance: those of the photos around each camera, which change along a path; or their mean,
    one for all pictures."""
    device: Device_ = None
    """Where to compute."""

    def __call__(self, console: Console) -> None:
        """Render."""
        # The default, both, is for someone who wants to see what there is.
        both = self.set is None and self.path is None and self.video is None
        order = RenderOrder(
            path=(self.path or "ellipse") if both or self.path or self.video else None,
            video=self.video,
            frames=self.frames,
            fps=self.fps,
            views="test" if both else self.set,
            buffers=self.buffers,
            size=self.size,
            scale=self.scale,
            exposure=self.exposure,
        )
        device = pick_device(self.device)
        model = load(self.run).to(device)
        job = order.prepare(self.run)
        with display.counting(console, "rendering", len(job)) as done:
            job.render(model, done)
        console.print(f"{len(job)} pictures in {self.run / 'renders'}", soft_wrap=True)
        if self.video is not None:
            console.print(f"{job.seconds:.2f} s of video in {self.video}", soft_wrap=True)


@dataclass
class Export:
    """Export a run for other programs. docs/outputs.md describes the files.

    ply: surfels.ply, the surfels with all their properties, and splats.ply, their plain appearance (without texture) as
    Gaussians, which the viewers of 3D Gaussian splatting open.

    cameras: transforms.json, all cameras as nerfstudio takes them, and camera_path.json, the same as a path by name.
    """

    run: Run_
    """Run folder."""
    format: Annotated[str, option("{ply,cameras}")] = "ply"
    """What to write."""
    out: Annotated[Path | None, option("FOLDER", "RUN/export")] = None
    """Folder to write to."""
    max_extent: Annotated[float, option("X")] = MAX_EXTENT
    """Surfels larger than this share of their distance from the nearest camera become several Gaussians in
    splats.ply; inf splits none."""

    def __call__(self, console: Console) -> None:
        """Export."""
        for file in export_run(self.run, self.format, self.out or self.run / "export", self.max_extent):
            console.print(str(file), soft_wrap=True)


@dataclass
class View:
    """Show a run in the browser: every pass, from anywhere, and camera paths for render (extra `viewer`)."""

    run: Run_
    """Run folder."""
    host: Host_ = "127.0.0.1"
    """Where to listen; 0.0.0.0 lets other machines look."""
    port: Port_ = 8080
    """Port to listen on; 0 takes any free one."""
    device: Device_ = None
    """Where to compute."""

    def __call__(self, console: Console) -> None:
        """Listen until Ctrl-C."""
        from nexwarp.viewer import Viewer

        source, config, _ = read_run(self.run)
        model = load(self.run).to(pick_device(self.device))
        with Viewer(
            lambda: _shown(model, config),
            load_cameras(self.run / CAMERAS_FILE),
            near=float(model.meta.get("near", 0.01)),
            title=source.name,
            host=self.host,
            port=self.port,
            save_path=partial(keep_camera_path, self.run),
        ) as viewer:
            _show(viewer, console)


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
                "texture": "not used"
                if model.meta["max_hits"] == 0
                else f"{texture['levels']} levels of {texture['table_size']:,}, "
                f"{texture['min_resolution']:.3g} to {texture['max_resolution']:.3g} cells per unit",
                "exposures": _exposures(model),
                "model file": f"{(self.run / MODEL_FILE).stat().st_size / 1e6:.1f} MB",
            }
        else:
            rows["model"] = "none yet: the training has not finished"
        if metrics := read_metrics(self.run):
            rows |= _figures(metrics, [name for name in ("psnr", "ssim") if name in metrics])
        console.print(display.results_table(rows, str(self.run)))


@dataclass
class Warmup:
    """Compile ahead of time what train, eval and render need, into Warp's kernel cache."""

    preset: Preset_ = "default"
    """As will be given to train."""
    max_hits: Annotated[int | None, option("K", "2")] = None
    """As will be given to train."""
    device: Device_ = None
    """Where to compute."""

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


@dataclass
class Sfm:
    """Find the cameras of bare photos, and write a scene to train on: undistorted photos and a COLMAP model."""

    photos: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of the photos (JPEG, PNG, TIFF, BMP); subfolders count."""
    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Folder to write: images/, sparse/0/ and sfm.json, the report."""
    settings: tyro.conf.OmitArgPrefixes[SfmOptions] = dataclasses.field(default_factory=SfmOptions)
    overwrite: bool = False
    """Replace SCENE if nexwarp sfm made it."""

    def __call__(self, console: Console) -> None:
        """Reconstruct."""
        with display.stages(console) as observe:
            report = reconstruct(self.photos, self.scene, self.settings, overwrite=self.overwrite, observe=observe)
        console.print(display.results_table(report.rows(), str(self.scene)))
        for line in report.lines():
            console.print(line, soft_wrap=True, markup=False, highlight=False)
        console.print(f"next: nexwarp train {self.scene}", soft_wrap=True, markup=False, highlight=False)


COMMANDS: dict[str, Any] = {
    "train": Train,
    "eval": Eval,
    "render": Render,
    "export": Export,
    "view": View,
    "info": Info,
    "sfm": Sfm,
    "warmup": Warmup,
}


def _exposures(model: Model) -> str:
    """How far the photos that a model was learned from differ."""
    if model.surfels.exposures is None:
        return "one for all photos"
    exposures = model.surfels.exposures
    gains, edge = exposures.log_gains.exp(), exposures.falloff[:2].sum().exp()
    told = f"{gains.min():.2f} to {gains.max():.2f} times the photos' mean"
    return f"{told}; light at the edge: {edge:.0%}"


def _name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"


def _with_settings(config: Config, settings: dict[str, Any]) -> Config:
    try:
        return with_settings(config, settings)
    except ValueError as error:
        raise SettingError(f"--set: {error}") from None


def _check_max_hits(max_hits: int | None) -> None:
    if max_hits is not None and not 0 <= max_hits <= MAX_HITS:
        raise SettingError(f"--max-hits: expected 0 to {MAX_HITS}, got {max_hits}")


def _show(viewer: "Viewer", console: Console) -> None:
    """Show a model that no longer changes."""
    console.print(f"viewer: {viewer.url} (Ctrl-C ends it)")
    with suppress(KeyboardInterrupt):
        viewer.show()


def _train(
    trainer: Trainer,
    run: Path,
    console: Console,
    viewer: "Viewer | None" = None,
    *,
    tensorboard: bool = False,
    every: int | None = None,
) -> None:
    """Run the loop with its display and log; keep checkpoints on the way and when a signal asks to stop."""
    total = trainer.config.iterations
    every = every or max(total // CHECKPOINTS_A_RUN, 1)
    shown = display.TrainingDisplay(console, total, trainer.iteration, trainer.device)
    with shown, TrainingLog(run, trainer, tensorboard=tensorboard) as log, deferred_stop() as asked:

        def observe(step: Any) -> None:
            shown(step)
            with _rescued(trainer, run):
                log(step)
            if viewer is not None:
                viewer.between_steps(step.iteration, partial(_describe, step), lambda: asked() is not None)
            if step.iteration % every == 0 or step.iteration == total or asked() is not None:
                with _rescued(trainer, run):
                    trainer.save(run)
            if (number := asked()) is not None:
                raise Stopped(number)

        def warn(text: str) -> None:
            _warn(console, text)
            log.rewind()

        try:
            trainer.run(observe, warn)
        except DivergedError as error:
            # The trainer is in its last good state.
            report = {"message": str(error), **error.report}
            kept = f"the model of iteration {trainer.iteration:,} and a report, {DIVERGED_FILE}, are in {run}"
            try:
                write_json(run / DIVERGED_FILE, report)
                save_model(run, trainer.model())
            except OSError as problem:
                kept = f"the model of iteration {trainer.iteration:,} could not be saved ({problem})"
            raise DivergedError(f"{error}; {kept}", report) from None


@contextmanager
def _rescued(trainer: Trainer, run: Path) -> Iterator[None]:
    """Where the disk takes no more in a block, keep at least the model, which is smaller than a checkpoint."""
    try:
        yield
    except OSError as error:
        try:
            save_model(run, trainer.model())
            model = "the model as it is now is saved"
        except OSError:
            model = "the model cannot be saved either"
        rest = "the last checkpoint is kept, --resume continues from it" if has_checkpoint(run) else "no checkpoint yet"
        raise StorageError(f"{error}; training stops at iteration {trainer.iteration:,}: {model}, {rest}") from error


def _warn(console: Console, text: str) -> None:
    console.print(f"warning: {text}", soft_wrap=True, markup=False, highlight=False)


def _describe(step: Any) -> str:
    return f"loss {step.loss():.4f}, {step.psnr():.2f} dB on this view, {step.surfels:,} surfels"


def _shown(model: Model, config: Config) -> tuple[Any, ...]:
    """A finished model, as the viewer takes it."""
    return model.surfels, model.texture if config.max_hits else None, model.render_options


def _finish(trainer: Trainer, scene: Scene, run: Path, device: torch.device, console: Console) -> Model:
    """Write the model, evaluate what was written, and return that."""
    with display.stages(console) as observe:
        finished = trainer.finish(observe)
    file = save_model(run, finished)
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
        rows = _figures(_evaluate(model, scene, run, console, {"mask_mode": trainer.config.mask_mode}, facts))
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
    return model


def _figures(results: dict[str, Any], metrics: Sequence[str] = ("psnr", "ssim")) -> dict[str, str]:
    """Rows of a table: the metrics of the test views."""
    shown = {name: "not available" if results[name] is None else f"{results[name]:.4f}" for name in metrics}
    if "psnr" in shown:
        shown["psnr"] = f"{results['psnr']:.2f} dB"
    return {f"test {name.upper()}": value for name, value in shown.items()}


def _evaluate(
    model: Model,
    scene: Scene,
    run: Path,
    console: Console,
    options: dict[str, Any],
    facts: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Evaluate a model on its test views and write metrics.json, keeping the facts that an older one holds."""
    if not scene.test:
        raise SceneError(f"{scene.path}: expected test views, found none")
    with display.counting(console, "evaluating", len(scene.test)) as done:
        results = evaluate(
            model.surfels,
            model.texture,
            scene.test,
            options=model.render_options,
            renders=run / "renders",
            progress=done,
            **options,
        )
    metrics = {**(read_metrics(run) if facts is None else facts), **results}
    write_json(run / METRICS_FILE, metrics)
    return metrics


def _parse(arguments: list[str]) -> Any:
    """The command that the arguments ask for; exits with 2 where they are none, after one line on stderr."""
    boxed = io.StringIO()
    try:
        with redirect_stderr(boxed):
            return tyro.extras.subcommand_cli_from_dict(
                COMMANDS,
                prog="nexwarp",
                description="Nexels: neurally-textured surfels. Each command has a --help of its own; with --debug, "
                "each shows the full trace of an error.",
                args=arguments,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if stop.code:
            help_of = f"nexwarp {arguments[0]}" if arguments and arguments[0] in COMMANDS else "nexwarp"
            _complain(f"error: {_unboxed(boxed.getvalue())}; see {help_of} --help", None)
        raise


def _unboxed(text: str) -> str:
    """What tyro says in a box of several paragraphs, in one sentence."""
    lines = [line.strip("│╭╮╰╯|+ ") for line in text.splitlines()]
    # After the title; terminals without such characters get lines of "-".
    parts = [part for part in re.split(r"\n[─-]*\n", "\n".join(["", *lines[1:]])) if part]
    fault = " ".join(parts[0].split()).removesuffix(".")
    value = re.fullmatch(
        r"Error parsing (\S+): (?:no type matching \S*(INT|FLOAT)\b|invalid literal for (int)|"
        r"could not convert string to (float)).*?'(.*)'.*",
        fault,
    )
    if value is not None:
        option, *kinds, given = value.groups()
        kind = "an integer" if "int" in [(k or "").lower() for k in kinds] else "a number"
        return f"{option}: expected {kind}, got {given!r}"
    meant = next((part.split("\n")[1] for part in parts if part.startswith("Perhaps you meant:")), None)
    return fault if meant is None else f"{fault}; perhaps you meant {meant}"


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code.

    0: done. 2: bad input, a full disk, a training that diverged: one line on stderr. 3: an error of nexwarp itself,
    likewise. 128 and the signal's number: ended by Ctrl-C (130), SIGTERM (143) or SIGHUP (129).
    """
    import warp as wp

    # Warp's notes on a missing CUDA driver or on kernels it compiles are no news to a person at a terminal.
    wp.config.log_level = wp.LOG_ERROR
    given = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in given
    command = _parse([argument for argument in given if argument != "--debug"])
    console = Console()
    try:
        with stopped_by_signals():
            command(console)
    except KeyboardInterrupt as stop:
        number = getattr(stop, "number", signal.SIGINT)
        hint = "; continue with --resume" if isinstance(command, Train) else ""
        _complain(f"{'interrupted' if number == signal.SIGINT else 'terminated'}{hint}", None)
        return 128 + number
    except Exception as error:
        trace = error if debug else None
        if (needed := needed_memory(error)) is not None and not isinstance(error, NexwarpError):
            _complain(
                f"error: out of memory: it needed {needed}; ask for less at a time, such as a smaller size", trace
            )
            return 2
        if isinstance(error, (NexwarpError, ValueError, OSError)):
            _complain(f"error: {error}", trace)
            return 2
        hint = "" if debug else "; --debug shows where"
        _complain(f"internal error: {type(error).__name__}: {error}{hint}", trace)
        return 3
    return 0


def _complain(text: str, trace: Exception | None) -> None:
    """One line on stderr, and the trace of an error above it if there is one to show."""
    if trace is not None:
        traceback.print_exception(trace)
    line = " ".join(f"nexwarp: {text}".split())
    Console(stderr=True, soft_wrap=True, highlight=False).print(line, markup=False)


if __name__ == "__main__":
    sys.exit(main())
