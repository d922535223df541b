"""`nexwarp render`, `export`, `info`, `warmup` and `sfm`."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from nexwarp.cli import display
from nexwarp.cli.device import pick_device
from nexwarp.cli.display import describe_exposures, device_name
from nexwarp.cli.eval import figures
from nexwarp.cli.options import Device_, Preset_, Run_, check_max_hits, option
from nexwarp.model.model_file import MODEL_FILE, load
from nexwarp.model.surfels_ply import MAX_EXTENT
from nexwarp.run import warmup
from nexwarp.run.export import export_run
from nexwarp.run.folder import (
    read_metrics,
    read_run,
)
from nexwarp.run.render_job import RenderOrder
from nexwarp.sfm import SfmOptions, reconstruct
from nexwarp.train.presets import preset


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
            texture = None if model.texture is None else model.texture.config
            rows |= {
                "surfels": f"{len(model.surfels):,} (budget {config.max_surfels:,})",
                "K": str(model.options.max_hits),
                "texture": "not used"
                if texture is None or model.options.max_hits == 0
                else f"{texture['levels']} levels of {texture['table_size']:,}, "
                f"{texture['min_resolution']:.3g} to {texture['max_resolution']:.3g} cells per unit",
                "exposures": describe_exposures(model),
                "model file": f"{(self.run / MODEL_FILE).stat().st_size / 1e6:.1f} MB",
            }
        else:
            rows["model"] = "none yet: the training has not finished"
        if metrics := read_metrics(self.run):
            rows |= figures(metrics, [name for name in ("psnr", "ssim") if name in metrics])
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
        check_max_hits(self.max_hits)
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
            f"{total} kernels ready on {device_name(device)}, preset {config.preset}: {new} compiled, "
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
