"""`nexwarp process`, `eval`, `render`, `edit`, `export`, `view` and `info`."""

import dataclasses
import math
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
import tyro
from rich.console import Console

from nexwarp.cli import display
from nexwarp.cli.options import Device_, Host_, Port_, Run_, pick_device
from nexwarp.data.option import Flag_, option
from nexwarp.data.scene import DEMO, SceneSource, scene_kinds
from nexwarp.data.sfm import SfmOptions, process
from nexwarp.data.sfm.photos import FILMS, OTHERS, SUFFIXES
from nexwarp.data.sfm.process import FRAMES, REPORT_FILE, source_identity
from nexwarp.errors import FormatError, MissingError, RunError, SceneError
from nexwarp.io.json_files import READ_ERRORS, Json, finite, read_object, write_json
from nexwarp.model.edit import write_edits
from nexwarp.model.texture import NeuralTexture
from nexwarp.run.edit import EditOrder, added, crop_command, described, measured
from nexwarp.run.evaluate import check_metrics, evaluate
from nexwarp.run.export import STAGED, ExportOrder, export_run
from nexwarp.run.fit_poses import fit_poses
from nexwarp.run.folder import (
    METRICS_FILE,
    PHOTOS_FILE,
    RENDERS_FOLDER,
    OpenedModel,
    keep_camera_path,
    locked_run,
    near_depth,
    open_model,
    read_metrics,
)
from nexwarp.run.render import RenderOrder
from nexwarp.train.recipe import DEFAULT

if TYPE_CHECKING:
    from nexwarp.viewer import Viewer


@dataclass
class Process:
    """Make a scene of a video or of photos: choose sharp frames, then estimate the cameras by structure from motion.

    Blurred and repeated frames of a video are left out. `process` and `sfm` are two names of one command.
    """

    source: Annotated[Path, tyro.conf.Positional, option("VIDEO|PHOTOS")]
    """A video (extra `video`), or a folder of photos (JPEG, PNG, TIFF, BMP, WebP, AVIF, HEIC) with its subfolders; also
    of 360 degrees."""
    scene: Annotated[Path, tyro.conf.Positional, option("SCENE")]
    """New folder: images/ (undistorted), sparse/0/ (a COLMAP model) and the report sfm.json."""
    frames: Annotated[int, option("N")] = FRAMES
    """Number of equal parts of a video, of which each gives its sharpest frame."""
    settings: tyro.conf.OmitArgPrefixes[SfmOptions] = dataclasses.field(default_factory=SfmOptions)

    def __call__(self, console: Console) -> None:
        """Make the scene."""
        self.make(console)
        console.print(f"next: nexwarp train {shlex.quote(str(self.scene))}")

    def make(self, console: Console) -> None:
        """Make the scene, and print the report."""
        with display.stages(console) as observe:
            report = process(self.source, self.scene, self.frames, self.settings, observe=observe)
        console.print(display.results_table(report.rows(), str(self.scene)))
        for line in report.lines():
            console.print(line)


def needs_cameras(source: SceneSource) -> bool:
    """Whether a source is a video, by its suffix, or a folder that has photos in it and no scene."""
    path = Path(source.path)
    if not path.is_dir():
        return path.suffix.lower() in FILMS
    if source.path == DEMO or source.format or source.images != SceneSource.images or scene_kinds(path):
        return False
    return any(file.suffix.lower() in (*SUFFIXES, *OTHERS) for file in path.iterdir())


def scene_folder_of(source: Path) -> Path:
    """Return the folder of the scene that `nexwarp train` makes of a video or of photos."""
    return Path("scenes") / (source.absolute().name if source.is_dir() else source.stem)


def make_scene(source: Path, console: Console) -> None:
    """Make the scene of a video or photos, unless that was done before; RunError if its folder has something else."""
    if not source.exists():
        raise FileNotFoundError(f"{source}: no such file, expected a video")
    scene, kind = scene_folder_of(source), "folder" if source.is_dir() else "video"
    if (scene / REPORT_FILE).is_file():
        try:
            made_of = read_object(scene / REPORT_FILE).get(kind)
        except READ_ERRORS:
            made_of = None
        if made_of == source_identity(source):
            console.print(f"{source}: the scene {scene} was made of it before")
            return
    if scene.exists():
        raise RunError(
            f"{scene}: expected no folder of that name, or a scene made of {source} as it is; "
            f"make a scene with nexwarp process {source} SCENE, and train that"
        )
    what = "photos" if source.is_dir() else "a video"
    console.print(f"{source}: {what} without cameras, so {scene} is made first")
    Process(source, scene).make(console)


@dataclass
class Eval:
    """Evaluate a run on the test views of its scene, or a model on those of --scene."""

    run: Run_
    scene: Annotated[str | None, option("SCENE", "the folder of the training")] = None
    """Folder of the scene, if it has moved; required for a model alone."""
    metrics: Annotated[tuple[str, ...], option("{psnr,ssim,flip,lpips} ...", "psnr ssim")] = ("psnr", "ssim")
    """Metrics to compute; flip needs the extra `flip`, lpips a file of weights (docs/quality.md)."""
    refine_poses: Flag_ = False
    """Fit each test pose to its photo before it is judged, the model fixed; metrics.json says so."""
    device: Device_ = None
    """Device to render on."""

    def __call__(self, console: Console) -> None:
        """Evaluate."""
        device = pick_device(self.device)
        check_metrics(self.metrics, device)
        opened = open_model(self.run)  # before a lock is written to a foreign folder
        source = opened.source
        if self.scene is not None:
            source = dataclasses.replace(source or SceneSource(""), path=self.scene)
        if source is None:
            lacks = "expected the photos to compare with, got a model alone; give --scene SCENE"
            raise MissingError(f"{self.run}: {lacks}")
        with locked_run(opened.folder), display.stages(console) as observe:
            opened = open_model(self.run)  # another process may have changed it
            model = opened.trained.to(device)
            scene = source.load(partial(observe, "reading photos"))
            if not scene.test:
                raise SceneError(f"{scene.path}: expected test views, found none")
            views = scene.test
            facts = read_metrics(opened.folder)
            facts.pop("test_poses", None)  # of an earlier evaluation
            if self.refine_poses:
                views, moves = fit_poses(model, views, progress=partial(observe, "fitting test poses"))
                facts["test_poses"] = {**moves}
            results = evaluate(
                model,
                views,
                renders=opened.folder / RENDERS_FOLDER,
                mask_mode=(opened.config or DEFAULT).mask_mode,
                metrics=self.metrics,
                progress=partial(observe, "evaluating"),
            )
            write_json(opened.folder / METRICS_FILE, finite(facts | results))
        rows = figures(results, self.metrics)
        fitted = ", poses fitted to their photos" if self.refine_poses else ""
        console.print(display.results_table(rows, f"{source.name}: {len(scene.test)} test views{fitted}"))


def figures(results: Mapping[str, Json], metrics: Sequence[str] = ("psnr", "ssim")) -> dict[str, str]:
    """Return test metrics as rows of a table."""
    rows = {}
    for name in metrics:
        value = results[name]
        if name == "psnr":
            text = f"{math.inf if value is None else value:.2f} dB"
        else:
            text = "not available" if value is None else f"{value:.4f}"
        rows[f"test {name.upper()}"] = text
    return rows


@dataclass
class Render:
    """Render a run to RUN/renders: still views, a camera path, a video of the path, and buffers. Needs no photos.

    Without options: the test views, and a path of 120 frames. --path or --video renders the path, --set the still
    views; combine them for both. docs/outputs.md describes paths and files.
    """

    run: Run_
    pictures: tyro.conf.OmitArgPrefixes[RenderOrder] = dataclasses.field(default_factory=RenderOrder)
    device: Device_ = None
    """Device to render on."""

    def __call__(self, console: Console) -> None:
        """Render."""
        device, opened = pick_device(self.device), open_model(self.run)
        job, model = self.pictures.prepare(opened), opened.model.to(device)
        if self.pictures.path is None and job.path is not None:
            surround = "surround" if job.path == "ellipse" else "do not surround"
            console.print(f"--path {job.path}, as the cameras {surround} what they look at")
        with display.stages(console) as observe:
            job.render(model, partial(observe, "rendering"))
        console.print(f"{len(job.stills) + len(job.frames)} pictures in {opened.folder / RENDERS_FOLDER}")
        if self.pictures.video is not None:
            console.print(f"{job.seconds:.2f} s of video in {self.pictures.video}")


@dataclass
class Export:
    """Export a run to the formats of other programs. docs/outputs.md describes the files.

    ply: surfels.ply, all properties of the surfels, and splats.ply, for viewers of 3D Gaussian splatting. spz: the
    same Gaussians at a tenth of the size (extra `splats`). gltf-splats: the same for programs that read glTF. mesh:
    triangles with colours. compact: the model in a fifth of its size. cameras: for nerfstudio. web: a web page that
    shows the scene in any browser. glb: for Blender and three.js (extra `glb`). usd: for Omniverse and other programs
    that read USD (extra `usd`).
    """

    run: Run_
    files: tyro.conf.OmitArgPrefixes[ExportOrder] = dataclasses.field(default_factory=ExportOrder)
    device: Device_ = None
    """Device that renders and trains, for all formats but compact and cameras."""

    def __call__(self, console: Console) -> None:
        """Export."""
        device, opened, lines = pick_device(self.device), open_model(self.run), list[str]()
        if self.files.format in STAGED:
            with display.stages(console) as observe:
                files = export_run(opened, self.files, device, observe, lines.append)
        else:
            with console.status("exporting"):
                files = export_run(opened, self.files, device)
        for line in (*map(str, files), *lines):
            console.print(line)


@dataclass
class Edit:
    """Crop, clean, level and scale a run: what render, export and view then show. The trained model never changes.

    One operation at a time; without one, the list of those in effect. They are in RUN/edit.json; train --resume and
    eval use the model without them. docs/edit.md describes them.
    """

    run: Run_
    order: tyro.conf.OmitArgPrefixes[EditOrder] = dataclasses.field(default_factory=EditOrder)
    device: Device_ = None
    """Device for --remove-floaters, which renders."""

    def __call__(self, console: Console) -> None:
        """Edit, and print the list."""
        self.order.check()
        device = pick_device(self.device)
        opened = open_model(self.run)
        if not opened.file.is_file():
            raise MissingError(f"{opened.file}: expected a trained model, found none")
        if self.order != EditOrder():
            with locked_run(opened.folder):
                opened = open_model(self.run)  # another process may have changed it
                opened = self._change(opened, device, console)
        for number, edit in enumerate(opened.edits, 1):
            console.print(f"{number}. {edit}")
        for line in described(opened):
            console.print(line)

    def _change(self, opened: OpenedModel, device: torch.device, console: Console) -> OpenedModel:
        """Write what the order asks for; return the run as it is then."""
        if self.order.undo:
            if not opened.edits:
                raise RunError(f"{opened.folder}: --undo: expected an edit to take back, found none")
            console.print(f"taken back: {opened.edits[-1]}")
            write_edits(opened.folder, opened.edits[:-1])
            return open_model(self.run)
        with display.stages(console) as observe:
            edit = self.order.edit(opened, device, observe)
        if self.order.remove_floaters:
            count = 0 if edit is None else len(edit.numbers) - 1
            console.print(f"{count:,} of {opened.kept.sum():,} surfels are floaters")
        return opened if edit is None else added(opened, edit)


@dataclass
class Info:
    """Print a summary of a run or a model."""

    run: Run_

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
    model, exposures = opened.model, opened.model.exposures
    texture = "not used"
    if isinstance(model.texture, NeuralTexture) and model.options.max_hits:
        config = model.texture.config
        cells = f"{config['min_resolution']:.3g} to {config['max_resolution']:.3g} cells per unit"
        texture = f"{config['levels']} levels of {config['table_size']:,}, {cells}"
    light = "one for all photos"
    if exposures is not None:
        gains = exposures.log_gains.exp()
        edge = exposures.falloff[:2].sum().exp()
        light = f"{gains.min():.2f} to {gains.max():.2f} times the photos' mean; light at the edge: {edge:.0%}"
    budget = "" if opened.config is None else f" (budget {opened.config.max_surfels:,})"
    return {
        "surfels": f"{len(model.surfels):,}{budget}",
        "K": str(model.options.max_hits),
        "texture": texture,
        "exposures": light,
        **({"edits": ", ".join(map(str, opened.edits))} if opened.edits else {}),
        "model file": f"{opened.file.stat().st_size / 1e6:.1f} MB",
    }


@dataclass
class ViewCommand:
    """Show a run or a model in the browser, with all buffers and an editor of camera paths (extra `viewer`)."""

    run: Run_
    host: Host_ = "127.0.0.1"
    """Address to listen on; 0.0.0.0 allows other machines, with the token of the URL that is printed."""
    port: Port_ = 8080
    """Port to listen on; 0 picks a free one."""
    device: Device_ = None
    """Device to render on."""

    def __call__(self, console: Console) -> None:
        """Serve the viewer until Ctrl-C."""
        from nexwarp.run.photo_table import load_photo_table
        from nexwarp.viewer import Viewer, ViewerOptions

        opened = open_model(self.run)
        try:
            figures_of_photos = load_photo_table(opened.folder / PHOTOS_FILE)
        except FormatError as error:
            display.warn(console, f"{error}; the viewer lists no photos")
            figures_of_photos = {}
        model = opened.model.to(pick_device(self.device))
        options = ViewerOptions(
            near_depth(model),
            opened.title,
            self.host,
            self.port,
            save_path=partial(
                keep_camera_path, opened.folder, opened=self.run, origin=model.origin, frame=opened.frame
            ),
            crop_command=partial(crop_command, opened),
            measured=partial(measured, opened),
            figures=figures_of_photos,
        )
        with Viewer(lambda: model, opened.cameras, options) as viewer:
            show_until_interrupted(viewer, console)


def show_until_interrupted(viewer: "Viewer", console: Console) -> None:
    """Serve the viewer of a finished model until Ctrl-C."""
    console.print(f"viewer: {viewer.url} (Ctrl-C ends it)")
    with suppress(KeyboardInterrupt):
        viewer.show()
