"""`nexwarp render`, `export`, `info` and `warmup`."""

import dataclasses
import time
from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.console import Console

from nexwarp.cli import display
from nexwarp.cli.device import pick_device
from nexwarp.cli.display import describe_exposures, device_name
from nexwarp.cli.eval import figures
from nexwarp.cli.options import Device_, Preset_, Run_, check_max_hits, option
from nexwarp.model.texture import NeuralTexture
from nexwarp.run import warmup
from nexwarp.run.export import ExportOrder, export_run
from nexwarp.run.folder import RENDERS_FOLDER, read_metrics
from nexwarp.run.opened import OpenedModel, open_model
from nexwarp.run.render import RenderOrder
from nexwarp.train.recipe import preset


@dataclass
class Render:
    """Render a run to RUN/renders: still views, a camera path, a video of the path, and buffers. Needs no photos.

    Without options: the test views, and an ellipse of 120 frames. --path or --video renders the path, --set the still
    views; combine them for both. docs/outputs.md describes paths and files.
    """

    run: Run_
    """Run folder, or a model's folder or .safetensors file."""
    pictures: tyro.conf.OmitArgPrefixes[RenderOrder] = dataclasses.field(default_factory=RenderOrder)
    device: Device_ = None
    """Device to render on."""

    def __call__(self, console: Console) -> None:
        """Render."""
        device = pick_device(self.device)
        self.pictures.check()
        opened = open_model(self.run)
        model = opened.model.to(device)
        job = self.pictures.prepare(opened)
        with display.counting(console, "rendering", len(job)) as done:
            job.render(model, done)
        console.print(f"{len(job)} pictures in {opened.folder / RENDERS_FOLDER}", soft_wrap=True)
        if self.pictures.video is not None:
            console.print(f"{job.seconds:.2f} s of video in {self.pictures.video}", soft_wrap=True)


@dataclass
class Export:
    """Export a run to the formats of other programs. docs/outputs.md describes the files.

    ply: surfels.ply, all properties of the surfels, and splats.ply, for viewers of 3D Gaussian splatting. spz: the
    same Gaussians at a tenth of the size (extra `splats`). mesh: triangles with colours. compact: the model in less
    than half of its size. cameras: for nerfstudio. web: a web page that shows the scene in any browser. glb: for
    Blender and three.js (extra `glb`).
    """

    run: Run_
    """Run folder, or a model's folder or .safetensors file."""
    files: tyro.conf.OmitArgPrefixes[ExportOrder] = dataclasses.field(default_factory=ExportOrder)
    device: Device_ = None
    """Device for mesh, web and glb, which render."""

    def __call__(self, console: Console) -> None:
        """Export."""
        self.files.check()
        opened = open_model(self.run)
        device = pick_device(self.device)
        if self.files.format == "mesh":
            with display.stages(console) as observe:
                files = export_run(opened, self.files, device, observe)
        else:
            with console.status("exporting"):
                files = export_run(opened, self.files, device)
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
    texture = model.texture.config if isinstance(model.texture, NeuralTexture) else None
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
