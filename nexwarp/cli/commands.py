"""`nexwarp render`, `export`, `info`, `warmup` and `sfm`."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, cast

import tyro
from rich.console import Console

from nexwarp.cli import display
from nexwarp.cli.device import pick_device
from nexwarp.cli.display import describe_exposures, device_name
from nexwarp.cli.eval import figures
from nexwarp.cli.options import Device_, Preset_, Run_, check_max_hits, option
from nexwarp.data.sfm import SfmOptions, reconstruct
from nexwarp.errors import SettingError
from nexwarp.export.surfels_ply import MAX_EXTENT
from nexwarp.model.detail import check_detail
from nexwarp.run import warmup
from nexwarp.run.contents import EXPORT_FOLDER, RENDERS_FOLDER
from nexwarp.run.export import export_mesh, export_run
from nexwarp.run.folder import read_metrics
from nexwarp.run.opened import OpenedModel, open_model
from nexwarp.run.optics import Kind, Optics
from nexwarp.run.render_job import RenderOrder
from nexwarp.train.recipe import preset


@dataclass
class Render:
    """Render a run to RUN/renders: still views, a camera path, a video of the path, and buffers. Needs no photos.

    Without options, it renders the test views and an ellipse of 120 frames. With --path or --video, it renders the path
    only; with --set, the still views only; with both, both. docs/outputs.md describes paths and files.
    """

    run: Run_
    """Run folder, or a model's folder or .safetensors file."""
    path: Annotated[str | None, option("{ellipse,spiral,interpolate,FILE.json}", "ellipse")] = None
    """Camera path; FILE.json is a nerfstudio camera path or a transforms.json."""
    video: Annotated[Path | None, option("FILE", "none")] = None
    """Also write the path as a video: .mp4, .mov, .mkv (H.264) or .webm (VP9). Needs the extra `video`."""
    frames: Annotated[int | None, option("N", "120, or that of FILE.json")] = None
    """Number of frames of the path; 0 renders no path."""
    fps: Annotated[float | None, option("N", "30, or that of FILE.json")] = None
    """Frames per second of the video."""
    set: Annotated[str | None, option("{test,train,all}", "test without --path and --video, else none")] = None
    """Still views to render."""
    buffers: bool = False
    """Also write an OpenEXR file of all buffers (depths, normals, weights and more) for each still view; without still
    views, for each frame of the path."""
    size: Annotated[str | None, option("WIDTHxHEIGHT", "that of the photos")] = None
    """Image size in pixels, such as 1920x1080; keeps the vertical field of view."""
    scale: Annotated[float, option("FACTOR")] = 1.0
    """Factor on the size of the photos, instead of --size."""
    camera: Annotated[str, option("{pinhole,panorama,fisheye,orthographic}")] = "pinhole"
    """Projection. A panorama is equirectangular; pictures other than pinhole ones go to RUN/renders/CAMERA."""
    fov: Annotated[float, option("DEGREES")] = 180.0
    """Angle that the smaller side of a fisheye image shows."""
    aperture: Annotated[float, option("DIAMETER")] = 0.0
    """Diameter of the lens in world units, for depth of field; 0 is a pinhole."""
    focus: Annotated[float | None, option("DEPTH", "median depth of each picture")] = None
    """Depth of the plane in focus in world units, with --aperture."""
    shutter: Annotated[float, option("SHARE")] = 0.0
    """Share of a frame's time in which the shutter is open, for motion blur along a path; 0 to 1."""
    samples: Annotated[int | None, option("N", "16")] = None
    """Renderings that are averaged for each picture, with --aperture or --shutter."""
    detail: Annotated[float, option("SHARE")] = 1.0
    """Share of the surfels to render with, above 0 to 1: those that make up most of the training pictures; the texture
    is coarser below 0.5 (docs/detail.md)."""
    exposure: Annotated[str | None, option("{photos,mean}", "that of the model, photos after a training")] = None
    """Exposure and white balance: `photos` predicts them from the photos near each camera, so they vary along a path;
    `mean` takes the mean of all photos for every image."""
    order: Annotated[str | None, option("{depth,distance}", "that of the model, depth after a training")] = None
    """Order in which surfels are blended: by their z-depth, the default of training, or by their distance from the
    camera, so that pictures from one place agree where they overlap, and with panoramas (docs/cameras.md)."""
    device: Device_ = None
    """Device to render on."""

    def __call__(self, console: Console) -> None:
        """Render."""
        # Without any selection, show everything that the run can show.
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
            order=self.order,
            optics=Optics(cast(Kind, self.camera), self.fov, self.aperture, self.focus, self.shutter, self.samples),
        )
        device = pick_device(self.device)
        check_detail("--detail", self.detail)
        opened = open_model(self.run)
        model = opened.model_at(self.detail, device)
        job = order.prepare(opened)
        with display.counting(console, "rendering", len(job)) as done:
            job.render(model, done)
        console.print(f"{len(job)} pictures in {opened.folder / RENDERS_FOLDER}", soft_wrap=True)
        if self.video is not None:
            console.print(f"{job.seconds:.2f} s of video in {self.video}", soft_wrap=True)


@dataclass
class Export:
    """Export a run to the formats of other programs. docs/outputs.md describes the files.

    --format ply writes surfels.ply, the surfels with all their properties, and splats.ply, which viewers of 3D Gaussian
    splatting open: the surfels as Gaussians, without the texture.

    --format mesh writes mesh.ply: a triangle mesh with colours, from the depths of the training views.

    --format compact writes compact.safetensors, the model in less than half of its size: `nexwarp.load` reads it.

    --format cameras writes all cameras for nerfstudio: as transforms.json, and as a camera path in the order of their
    names, camera_path.json.

    --format web writes a web page that shows the scene in any browser, without an installation: as it is with WebGPU,
    with its texture baked into an image elsewhere.

    --format glb writes scene.glb for Blender, three.js and others (extra `glb`): the surfels as textured quads.

    --format spz writes splats.spz, the Gaussians of splats.ply at a tenth of the size (extra `splats`).
    """

    run: Run_
    """Run folder, or a model's folder or .safetensors file."""
    format: Annotated[str, option("{ply,mesh,compact,cameras,web,glb,spz}")] = "ply"
    """Files to write."""
    out: Annotated[Path | None, option("FOLDER", "RUN/export")] = None
    """Output folder. Of --format web, NAME.html writes one file with everything, which is also the default:
    RUN/export/scene.html."""
    quality: Annotated[str, option("{quantised,full}")] = "quantised"
    """Of --format web: quantised files are a fifth to a half as large."""
    max_extent: Annotated[float, option("X")] = MAX_EXTENT
    """In splats.ply and splats.spz, surfels larger than this fraction of their distance to the nearest camera become
    several Gaussians; inf splits none."""
    voxel: Annotated[float | None, option("LENGTH", "1.5 pixels of the photos at their median depth")] = None
    """Resolution of the mesh in world units."""
    far: Annotated[float | None, option("DEPTH", "3 scene scales")] = None
    """The mesh leaves out what is farther from each camera than this, in world units."""
    device: Device_ = None
    """Device to render on for the mesh, and to bake the texture on, for web and glb."""

    def __call__(self, console: Console) -> None:
        """Export."""
        device = pick_device(self.device)
        opened = open_model(self.run)
        if self.format == "mesh":
            folder = self.out or opened.folder / EXPORT_FOLDER
            with display.stages(console) as observe:
                files = export_mesh(opened, folder, device, voxel=self.voxel, far=self.far, observe=observe)
        elif self.voxel is not None or self.far is not None:
            raise SettingError(f"--voxel, --far: expected together with --format mesh, got --format {self.format}")
        else:
            with console.status("exporting"):
                files = export_run(opened, self.format, self.out, self.max_extent, self.quality, device)
        for file in files:
            console.print(str(file), soft_wrap=True)


@dataclass
class Info:
    """Print a summary of a run or a model."""

    run: Run_
    """Run folder, or a model's folder or .safetensors file."""

    def __call__(self, console: Console) -> None:
        """Print the summary."""
        opened = open_model(self.run)
        rows: dict[str, str] = {}
        if opened.source is not None and opened.config is not None:
            config = opened.config
            rows |= {"scene": opened.source.path, "preset": config.preset, "iterations": f"{config.iterations:,}"}
        if opened.file.is_file():
            rows |= _describe_model(opened)
        else:
            rows["model"] = "none yet: the training has not finished"
        if metrics := read_metrics(opened.folder):
            rows |= figures(metrics, [name for name in ("psnr", "ssim") if name in metrics])
        console.print(display.results_table(rows, str(self.run)))


def _describe_model(opened: OpenedModel) -> dict[str, str]:
    """Summarise a model as rows of a table."""
    model = opened.model
    texture = None if model.texture is None else model.texture.config
    budget = "" if opened.config is None else f" (budget {opened.config.max_surfels:,})"
    return {
        "surfels": f"{len(model.surfels):,}{budget}",
        "K": str(model.options.max_hits),
        "texture": "not used"
        if texture is None or model.options.max_hits == 0
        else f"{texture['levels']} levels of {texture['table_size']:,}, "
        f"{texture['min_resolution']:.3g} to {texture['max_resolution']:.3g} cells per unit",
        "exposures": describe_exposures(model),
        "model file": f"{opened.file.stat().st_size / 1e6:.1f} MB",
    }


@dataclass
class Warmup:
    """Compile the kernels of train, eval and render ahead of time, into Warp's kernel cache."""

    preset: Preset_ = "default"
    """The --preset of the training to come."""
    max_hits: Annotated[int | None, option("K", "2")] = None
    """The --max-hits of the training to come."""
    device: Device_ = None
    """Device to compile for."""

    def __call__(self, console: Console) -> None:
        """Compile."""
        start = time.perf_counter()
        check_max_hits(self.max_hits)
        device = pick_device(self.device)
        config = preset(self.preset)
        if self.max_hits is not None:
            config = dataclasses.replace(config, max_hits=self.max_hits)
        before = warmup.cached_binaries()
        with display.counting(console, "compiling", warmup.ITERATIONS) as done:
            warmup.rehearse(config, device, done)
        compiled = len(warmup.cached_binaries() - before)
        console.print(
            f"kernels ready on {device_name(device)}, preset {config.preset}: {compiled} compiled, "
            f"{time.perf_counter() - start:.1f} s",
            soft_wrap=True,
        )


@dataclass
class Sfm:
    """Estimate the cameras of photos by structure from motion, and write a scene: undistorted photos, COLMAP model."""

    photos: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of the photos (JPEG, PNG, TIFF, BMP), searched with its subfolders."""
    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Output folder: images/, sparse/0/ and the report sfm.json."""
    settings: tyro.conf.OmitArgPrefixes[SfmOptions] = dataclasses.field(default_factory=SfmOptions)
    overwrite: bool = False
    """Replace SCENE if nexwarp sfm created it."""

    def __call__(self, console: Console) -> None:
        """Reconstruct."""
        with display.stages(console) as observe:
            report = reconstruct(self.photos, self.scene, self.settings, overwrite=self.overwrite, observe=observe)
        console.print(display.results_table(report.rows(), str(self.scene)))
        for line in report.lines():
            console.print(line, soft_wrap=True, markup=False, highlight=False)
        console.print(f"next: nexwarp train {self.scene}", soft_wrap=True, markup=False, highlight=False)
