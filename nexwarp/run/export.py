"""Export of run folders to the formats of other programs."""

import math
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Annotated, NamedTuple, TypeAlias, cast

import numpy as np
import torch

from nexwarp.cameras.camera import Camera, resized
from nexwarp.cameras.cameras_file import CAMERAS_FILE
from nexwarp.cameras.nerfstudio import save_camera_path, save_transforms
from nexwarp.cameras.similarity import IDENTITY
from nexwarp.data import Scene, View
from nexwarp.data.images import image_size
from nexwarp.data.option import Flag_, option
from nexwarp.data.scene import SceneSource, parse_color
from nexwarp.data.transforms import lens_keys
from nexwarp.errors import DivergedError, OutOfMemoryError, RunError, SettingError, check_package, require
from nexwarp.export.bake import Progress
from nexwarp.export.baked_scene import GLB, load_baked
from nexwarp.export.fit import Views
from nexwarp.export.glb import ALPHAS, bake_cards, save_glb
from nexwarp.export.mesh import Mesh, extract_mesh, save_mesh
from nexwarp.export.splats import (
    MAX_EXTENT,
    SPLAT_DEGREE,
    gaussians,
    save_splats_glb,
    save_splats_ply,
    save_splats_spz,
    save_surfels_ply,
    softened,
)
from nexwarp.export.usd import save_usdz
from nexwarp.export.web.export import Page, export_web, read_notes
from nexwarp.io.files import one_line
from nexwarp.io.json_files import JsonObject, write_json
from nexwarp.model.compact import NOISE, NOISES
from nexwarp.model.edit import REGIONS, moved_poses, moved_surfels
from nexwarp.model.model import Model
from nexwarp.model.model_file import save_model
from nexwarp.model.texture import NeuralTexture
from nexwarp.run.edit import MIDDLE, edited, subject_crop
from nexwarp.run.evaluate import METRICS, compared, weights_file
from nexwarp.run.folder import EXPORT_FOLDER, EXPORTS, METRICS_FILE, ORIGIN_FILE, TRAIN, OpenedModel, read_metrics
from nexwarp.train.api import train
from nexwarp.train.recipe import DEFAULT, MASK_MODES, MIN_SURFELS, with_settings
from nexwarp.train.report import StepReport

# Packages that formats need, and their extras.
PACKAGES = {"glb": ("trimesh", "glb"), "spz": ("gaussforge", "splats"), "usd": ("pxr", "usd")}
CARDS = ("glb", "usd")  # formats for other programs, whose scenes have objects
BAKED = ("web", *CARDS)  # formats whose texture is baked
SPLATS = ("ply", "spz", "gltf-splats")
FITTED = (*BAKED, *SPLATS)  # formats that are fitted to photos
STAGED = ("mesh", *FITTED)  # formats that take several stages, which are shown
READ = ("web", "glb")  # formats whose files `load_baked` reads
# Options of one format.
OPTIONS = {
    "mesh": ("voxel", "far"),
    "usd": ("collision",),
    "web": ("title", "caption", "background", "annotations", "url"),
}
Device: TypeAlias = torch.device | str
Figures = dict[str, dict[str, float]]  # metrics on test views, of what was baked and of the model
GREY_LEVEL = 1 / 255
ONE_COLOR: dict[str, object] = {"sh_degree": 0, "smooth_sh": 0.0}  # from all directions, as cards have
STEADY: dict[str, object] = {"densify.fraction": 0.0, "densify.relocate": 0.0}


class Form(NamedTuple):
    """How training goes on for something that other renderers draw."""

    share: float  # of the run's iterations
    growth: int  # at most so many times the surfels of the run
    settings: dict[str, object]  # that differ from the run's


FORMS = {
    "blended cards": Form(1 / 4, 1, ONE_COLOR | STEADY),
    # Where a renderer tests depth and does not blend, nearly opaque surfels with hard sides lose least.
    "cut-outs": Form(1.0, 1, ONE_COLOR | {"least_gamma": 3.0, "losses.binary": 0.3}),
    # More of them make up for the texture.
    "Gaussians": Form(1 / 2, 4, {"max_hits": 0, "least_gamma": 1.0, "rates.gammas": 0.0, "footprints": False}),
}
COLLISION_VOXELS = 48  # along the scene's longest side
FAR_AROUND = 10.0  # so many times the subject, what lies around an object is left out
UNDISTORTED = "undistorted"  # folder of names of views that no file shows


@dataclass(frozen=True)
class ExportOrder:
    """What `nexwarp export` writes."""

    format: Annotated[str, option("NAME")] = "ply"
    """ply, mesh, compact, cameras, web, glb, usd, spz or gltf-splats."""
    out: Annotated[Path | None, option("FOLDER", "RUN/export")] = None
    """Output folder; with --format web also NAME.html, for one file with everything."""
    quality: Annotated[str, option("{quantised,full}")] = "quantised"
    """Of --format web: quantised files are a fifth to a half as large."""
    alpha: Annotated[str, option("{mask,blend}")] = "mask"
    """Of glb, usd: mask cuts surfels out, which all programs draw; blend is closer to photos, in those that sort."""
    finetune: Annotated[bool, option(None, "to the training photos, where they are")] = True
    """Train no more: fit what is baked to the model's renderings alone, and write the run's own surfels as splats."""
    crop: Annotated[
        bool, option(None, "glb and usd keep what photos all around look at, if the scene is ten times as large")
    ] = True
    """Keep all surfels."""
    title: Annotated[str, option("TEXT", "the scene's name")] = ""
    """Of web: the heading."""
    caption: Annotated[str, option("TEXT", "")] = ""
    """Of web: a text below it."""
    background: Annotated[str | None, option("COLOUR", "the run's")] = None
    """Of web: white, black or R,G,B behind the scene."""
    annotations: Annotated[Path | None, option("FILE.json", "")] = None
    """Of web: texts at points, a list of {"point": [x, y, z], "text": "..."} in the coordinates of exports."""
    url: Annotated[str, option("URL", "")] = ""
    """Of web: address that the page will have; links to it then show a picture."""
    noise: Annotated[float | None, option("X", "8 % of the test views' error")] = None
    """Of compact: noise that its pictures may have, of 1; files with more are smaller."""
    max_extent: Annotated[float, option("X")] = MAX_EXTENT
    """Of splats: split surfels larger than this share of their distance to the nearest camera; inf splits none."""
    collision: Flag_ = False
    """Of usd: add a coarse mesh for physics, which is not shown."""
    voxel: Annotated[float | None, option("LENGTH", "1.5 pixels of the photos at median depth")] = None
    """Resolution of the mesh in world units."""
    far: Annotated[float | None, option("DEPTH", "3 scene scales")] = None
    """Largest distance of the mesh from each camera in world units."""

    def check(self) -> None:
        """Raise SettingError unless the options fit together."""
        least, most = NOISES
        noise = least if self.noise is None else self.noise
        require(self.max_extent > 0, f"--max-extent: expected more than 0, got {self.max_extent:g}")
        require(least <= noise <= most, f"--noise: expected {least:g} to {most:g}, got {noise:g}")
        require(self.format in EXPORTS, f"--format: expected one of {', '.join(EXPORTS)}, got {self.format!r}")
        require(self.alpha in ALPHAS, f"--alpha: expected {' or '.join(ALPHAS)}, got {self.alpha!r}")
        for kind, names in OPTIONS.items():
            asked = [f"--{name}" for name in names if (x := getattr(self, name)) is not None and x not in ("", False)]
            if asked and self.format != kind:
                raise SettingError(f"{asked[0]}: expected together with --format {kind}, got --format {self.format}")
        is_address = re.fullmatch(r"(https?://[^\s/]+\S*)?", self.url) is not None
        require(is_address, f"--url: expected an address that begins with https://, got {self.url!r:.60}")
        parse_color(self.background)
        if self.annotations is not None:
            read_notes(self.annotations)
        if self.format in PACKAGES:
            check_package(f"--format {self.format}", *PACKAGES[self.format])


def export_run(
    opened: OpenedModel,
    order: ExportOrder,
    device: Device = "cpu",
    observe: Progress = lambda *_: None,
    report: Callable[[str], object] = lambda _: None,
) -> Sequence[Path]:
    """Export a run or a model, and return the files that were written; docs/outputs.md describes them.

    `device` renders and trains; `observe` is called with the name of each of their stages, how many views, blocks or
    steps of it are done, and of how many; `report` with lines for the user, such as how close a baked file comes to the
    test photos.
    """
    order.check()
    folder = order.out or opened.folder / EXPORT_FOLDER
    if order.crop and order.format in CARDS:
        opened = _cropped(opened, report)
    finetunes = order.finetune and opened.source is not None and order.format in FITTED
    if finetunes and order.format != "web" and _takes_hours(opened, device):
        report("the run's own surfels are exported: without its GPU, training them further would take hours")
    kept = order.format in SPLATS and (_is_cropped(opened) or _takes_hours(opened, device))
    scene = _photos(opened, device, observe) if finetunes and not kept else None
    files = [*_export(opened, order, folder, scene, device, observe)]
    beside = folder.parent if folder.suffix == ".html" else folder
    if scene is not None and scene.test and order.format in READ:
        figures, size = _quality(opened, files, scene.test, device), sum(file.stat().st_size for file in files)
        report(_line(figures, len(scene.test), size, _is_cropped(opened)))
        known = read_metrics(beside).get("exports")
        files.append(beside / METRICS_FILE)
        entry = cast(JsonObject, {**figures, "cropped": _is_cropped(opened)})
        write_json(files[-1], {"exports": (known if isinstance(known, dict) else {}) | {files[0].name: entry}})
    # Compact models and cameras say themselves where their frame lies in the world.
    if order.format not in ("compact", "cameras") and any(opened.model.origin or ()) and opened.frame.is_identity:
        files.append(beside / ORIGIN_FILE)
        meaning = "world position = origin + exported position"
        write_json(files[-1], {"origin": opened.model.origin, "meaning": meaning})
    return files


def _cropped(opened: OpenedModel, report: Callable[[str], object]) -> OpenedModel:
    """Return a run, of an object without what lies far around it unless it is cropped already; say what is left."""
    if not opened.cameras.get(TRAIN) or _is_cropped(opened) or (crop := subject_crop(opened)) is None:
        return opened
    rest = edited(opened, crop)
    whole, size = (np.ptp(x.frame.points(x.model.surfels.means.detach().cpu().numpy()), axis=0) for x in (opened, rest))
    if whole.max() < FAR_AROUND * size.max():
        return opened
    count = f"{opened.kept.sum() - rest.kept.sum():,} of {opened.kept.sum():,}"
    spans = " x ".join(f"{x:.3g}" for x in size)
    report(f"{count} surfels around the subject are left out (--no-crop keeps them); the others span {spans}")
    return rest


def _is_cropped(opened: OpenedModel) -> bool:
    """Whether a run is cropped."""
    return any(edit.name in REGIONS for edit in opened.edits)


def _takes_hours(opened: OpenedModel, device: Device) -> bool:
    """Whether further training takes hours: on a CPU, of a run of a GPU."""
    return opened.device == "cuda" and torch.device(device).type == "cpu"


def _export(
    opened: OpenedModel, order: ExportOrder, folder: Path, scene: Scene | None, device: Device, observe: Progress
) -> Sequence[Path]:
    """Write the files of a format, and return them."""
    files = [folder / name for name in EXPORTS[order.format]]
    if order.format in BAKED:
        return _export_baked(opened, order, files[0], scene, device, observe)
    if order.format == "compact":
        save_model(files[0], opened.model, compact=_noise(opened) if order.noise is None else order.noise)
    elif order.format == "cameras":
        _export_cameras(opened, *files)
    elif order.format == "mesh":
        voxel, far = (None if x is None else x / opened.frame.scale for x in (order.voxel, order.far))
        save_mesh(files[0], _mesh(opened, device, observe, voxel, far))
    else:
        model = opened.model if scene is None else _trained_on(opened, scene, device, "Gaussians", observe)
        _export_splats(opened, model, order, files)
    return files


def _export_baked(
    opened: OpenedModel, order: ExportOrder, file: Path, scene: Scene | None, device: Device, observe: Progress
) -> Sequence[Path]:
    """Write surfels with a baked texture, as a page or as cards, and return the files."""
    views, motion = opened.views, opened.frame
    if order.format in CARDS and not views:
        raise RunError(f"{opened.path}: --format {order.format}: expected the run's {CAMERAS_FILE}, found none")
    # What is baked learns from no test view, not even from its pose.
    seen: Views = scene.train if scene is not None else [*opened.cameras.get(TRAIN, {}).values()]
    aim = opened.model.to(device)
    if order.format == "web":
        page, out = _page(opened, order), order.out or file
        return export_web(aim, views, out, seen, quality=order.quality, page=page, progress=observe)
    form = "cut-outs" if order.alpha == "mask" else "blended cards"
    model = aim if scene is None else _trained_on(opened, scene, device, form, observe)
    cards = bake_cards(model, seen or [*views.values()], order.alpha, aim=aim, progress=observe)
    means, quats = moved_poses(cards.shape.means, cards.shape.quats, motion)
    shape = cards.shape._replace(means=means, quats=quats, scales=cards.shape.scales * motion.scale)
    cards, cameras = replace(cards, shape=shape), [motion.camera(camera) for camera in views.values()]
    if order.format == "glb":
        save_glb(file, cards, cameras)
    else:
        collision = _collision(opened, device, observe) if order.collision else None
        soft = opened.model if scene is None else _trained_on(opened, scene, device, "Gaussians", observe)
        degree = min(soft.options.sh_degree, SPLAT_DEGREE)
        save_usdz(file, cards, moved_surfels(soft.surfels, motion), degree, cameras, collision)
    return [file]


def _export_splats(opened: OpenedModel, model: Model, order: ExportOrder, files: Sequence[Path]) -> None:
    """Write a model's surfels as Gaussians; PLY also those of the run, with all their properties."""
    surfels = moved_surfels(model.surfels, opened.frame)
    cameras = [opened.frame.camera(camera) for camera in opened.views.values()]
    degree = min(model.options.sh_degree, SPLAT_DEGREE)
    splats = gaussians(surfels, degree, cameras, order.max_extent)
    if order.format == "gltf-splats":
        save_splats_glb(files[0], splats, cameras)
    elif order.format == "spz":
        save_splats_spz(files[0], splats)
    else:
        save_surfels_ply(files[0], moved_surfels(opened.model.surfels, opened.frame))
        save_splats_ply(files[1], splats)


def _page(opened: OpenedModel, order: ExportOrder) -> Page:
    """Return what a page says, its notes moved from the coordinates of exports to those of the model."""
    frame = opened.frame
    origin = np.array(opened.model.origin if opened.model.origin and frame.is_identity else (0.0, 0.0, 0.0))
    back = frame.inverse()
    notes = () if order.annotations is None else read_notes(order.annotations)
    moved = tuple(replace(note, point=tuple(back.points(np.array(note.point) - origin).tolist())) for note in notes)
    metres = None if frame.scale == 1.0 else frame.scale
    color = parse_color(order.background)
    return Page(order.title or opened.title or "nexwarp", order.caption, color, moved, order.url, metres)


def _mesh(
    opened: OpenedModel, device: Device, observe: Progress, voxel: float | None, far: float | None = None
) -> Mesh:
    """Return a mesh of a run's surface in the exported coordinates; lengths are in those of the training."""
    model = opened.model.to(device)
    return extract_mesh(model, opened.trained_cameras, voxel=voxel, far=far, observe=observe).moved(opened.frame)


def _collision(opened: OpenedModel, device: Device, observe: Progress) -> Mesh:
    """Return a coarse mesh of a run's surface, in the exported coordinates."""
    low, high = np.quantile(opened.model.surfels.means.detach().cpu().numpy(), MIDDLE, axis=0)
    return _mesh(opened, device, observe, float((high - low).max()) / COLLISION_VOXELS)


def _trained_on(opened: OpenedModel, scene: Scene, device: Device, form: str, observe: Progress) -> Model:
    """Train a run on for one of `FORMS`.

    Returns the model unchanged where it is cropped, as the photos then have no loss around its edge, where training
    takes hours, and where cards are made of a texture that cannot be baked. Warns and returns it unchanged where
    training fails.
    """
    before, config = opened.model, opened.config or DEFAULT
    unbaked = form != "Gaussians" and type(before.texture) is not NeuralTexture
    if unbaked or _is_cropped(opened) or _takes_hours(opened, device):
        return before.to(device)
    share, growth, changes = FORMS[form]
    iterations = max(round(share * config.iterations), 1)
    settings: dict[str, object] = {
        "exposures": before.exposures is not None,
        "max_surfels": max(growth * len(before.surfels), MIN_SURFELS),
        "background": before.options.background,
        "iterations": iterations,
        "steps_a_photo": None,
        "teachers": 0,
        "refine_poses": False,
        "mask_mode": MASK_MODES[0],
    }
    for name in ("scales", "shN"):  # no large steps again
        rate = getattr(config.rates, name)
        settings[f"rates.{name}"] = rate if isinstance(rate, float) else math.sqrt(math.prod(rate))
    config = with_settings(config, settings | changes)
    init = before
    if form == "Gaussians":
        init = Model(softened(before.surfels), None, options=before.options, meta=before.meta)

    def report(step: StepReport) -> None:
        observe(f"training {form}", step.iteration, iterations)

    try:
        model = train(scene, config, device=device, init=init, callbacks=[report])
    except (ValueError, DivergedError, OutOfMemoryError) as error:
        why = f"the model is not trained for {form} ({one_line(error)})"
        warnings.warn(f"{why}; --no-finetune leaves that out", stacklevel=2)
        return before.to(device)
    model.exposures = None if before.exposures is None else before.exposures.to(device)
    return model


def _photos(opened: OpenedModel, device: Device, observe: Progress) -> Scene | None:
    """Read the scene of a run, its training views with the run's poses; None where that is impossible.

    Masks leave out what a crop has changed.
    """
    assert opened.source is not None
    model = opened.model  # before the photos, so that a damaged one is told at once
    try:
        scene = opened.source.load(lambda done, total: observe("reading photos", done, total))
    except (OSError, ValueError, MemoryError) as error:
        warnings.warn(f"the photos cannot be read ({one_line(error)}), so nothing is fitted to them", stacklevel=2)
        return None
    mode, groups = (opened.config or DEFAULT).mask_mode, []
    for views in (scene.train, scene.test):
        shown = [(view, *compared(model, view, mode)) for view in views]
        groups.append([replace(view, image=image, mask=mask) for view, image, mask in shown])
    cameras = opened.cameras.get(TRAIN, {})
    groups[0] = [replace(view, camera=cameras.get(view.name, view.camera)) for view in groups[0]]
    if _is_cropped(opened):
        models = [each.bare().to(device) for each in (opened.trained, model)]
        groups = [[_masked(view, *models) for view in group] for group in groups]
    test = [view for view in groups[1] if view.mask is None or view.mask.any()]
    return replace(scene, train=groups[0], test=test)


def _masked(view: View, whole: Model, part: Model) -> View:
    """Return a view that leaves out the pixels where two models differ by a grey level or more."""
    before, after = (model.render_image(view.camera.to(model.device)).cpu() for model in (whole, part))
    same = ((after - before).abs() < GREY_LEVEL).all(dim=2)
    return replace(view, mask=same if view.mask is None else same & view.mask)


@torch.no_grad()
def _quality(opened: OpenedModel, files: Sequence[Path], views: Sequence[View], device: Device) -> Figures:
    """Return metrics of a baked file and of the model on test views; LPIPS where its weights are at hand."""
    model = opened.model.to(device)
    file = next(file for file in files if file.suffix in (".html", GLB))
    scene = load_baked(file).to(device)
    motion = opened.frame if file.suffix == GLB else IDENTITY
    exposures = model.exposures if scene.exposures is None and model.options.exposure == "photos" else None

    def shown(camera: Camera) -> torch.Tensor:
        if scene.exposures is not None:
            return scene.render(motion.camera(camera), background=model.options.background)
        image = scene.render_at_mean(motion.camera(camera), model.options.background)
        return image if exposures is None else image * exposures.factors(camera.to(device))

    metrics = ("psnr", "ssim", "lpips") if weights_file().is_file() else ("psnr", "ssim")
    figures: Figures = {}
    for name, render in (("baked", shown), ("neural", model.render_image)):
        pictures = [(render(view.camera).cpu(), view.image, view.mask) for view in views]
        judged = {metric: [METRICS[metric](*each) for each in pictures] for metric in metrics}
        figures[name] = {metric: fmean(x for x in values if x is not None) for metric, values in judged.items()}
    overdraw = fmean(scene.overdraw(motion.camera(view.camera)) for view in views)
    figures["drawn"] = {"triangles": 2 * len(scene.boxes), "overdraw": overdraw}
    return figures


def _line(figures: Figures, views: int, size: int, cropped: bool) -> str:
    """Return what a person reads of them."""
    psnr, lpips = (
        ", ".join(f"{each[metric]:.{digits}f}{unit} {name}" for name, each in figures.items() if metric in each)
        for metric, digits, unit in (("psnr", 2, " dB"), ("lpips", 3, ""))
    )
    where = " where nothing was cropped" if cropped else ""
    drawn = f"{figures['drawn']['triangles']:,} triangles, a pixel in {figures['drawn']['overdraw']:.1f} quads"
    line = f"test PSNR{where}: {psnr}, {views} views; {size / 1e6:.1f} MB; {drawn}"
    return line + (f"; LPIPS: {lpips}" if lpips else "")


def _noise(opened: OpenedModel) -> float:
    """Return the noise of a compact file that costs 0.03 dB on a run's test views; without them the usual one."""
    psnr = read_metrics(opened.folder).get("psnr")
    return NOISE if not isinstance(psnr, (int, float)) else min(max(0.08 * 10 ** (-psnr / 20), NOISE / 4), NOISE * 4)


def _export_cameras(opened: OpenedModel, transforms: Path, camera_path: Path) -> None:
    """Write the cameras of a run for nerfstudio, with the lenses and sizes of the photos as they lie in their files."""
    names, lenses = _originals(opened)
    move = opened.frame.camera
    named = {group: {names[name]: move(camera) for name, camera in cs.items()} for group, cs in opened.cameras.items()}
    cameras = dict(sorted({name: c for members in named.values() for name, c in members.items()}.items()))
    if not cameras:
        raise RunError(f"{opened.folder / CAMERAS_FILE}: expected at least one camera, found none")
    split = {group: sorted(named.get(group, {})) for group in ("train", "test")}
    save_transforms(transforms, cameras, **split, lenses=lenses)
    first = next(iter(cameras.values()))
    save_camera_path(camera_path, [resized(camera, first.width, first.height) for camera in cameras.values()])


def _originals(opened: OpenedModel) -> tuple[dict[str, str], dict[str, JsonObject]]:
    """Return the files of a run's views in the scene's folder, and the keys of lenses that nerfstudio knows by file."""
    source, photos = opened.source or SceneSource(""), None
    try:
        if opened.source is not None and opened.views:
            photos = {photo.name: photo for photo in source.photos()}
    except (OSError, ValueError) as error:
        taken = "the intrinsics are those of the photos as they were trained on, undistorted and reduced"
        warnings.warn(f"{source.path}: the scene cannot be read ({one_line(error)}), so {taken}", stacklevel=2)
    if photos is None:
        return {name: f"{source.images}/{name}" for name in opened.views}, {}
    folder = source.folder
    names, lenses = {}, {}
    for name in opened.views:
        photo = photos.get(name)
        keys = None if photo is None else lens_keys(photo.lens, *image_size(photo.file))
        names[name] = f"{UNDISTORTED}/{name}"
        if photo is not None and keys is not None:
            names[name] = photo.file.relative_to(folder).as_posix()
            lenses[names[name]] = keys
    return names, lenses
