"""Export of run folders to the formats of other programs."""

import importlib.util
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from tyro.conf import arg

from nexwarp.cameras.camera import Camera, resized
from nexwarp.cameras.cameras_file import CAMERAS_FILE
from nexwarp.cameras.nerfstudio import save_camera_path, save_transforms
from nexwarp.data.images import image_size
from nexwarp.data.scene import DEMO, SceneSource, demo_folder
from nexwarp.data.transforms import lens_keys
from nexwarp.errors import RunError, SettingError
from nexwarp.export.bake import Progress, bake
from nexwarp.export.glb import ALPHAS, make_cards, save_glb
from nexwarp.export.mesh import extract_mesh, save_mesh
from nexwarp.export.splats import (
    MAX_EXTENT,
    SPLAT_DEGREE,
    save_splats_glb,
    save_splats_ply,
    save_splats_spz,
    save_surfels_ply,
)
from nexwarp.export.usd import save_usdz
from nexwarp.io.files import one_line
from nexwarp.io.json_files import JsonObject, write_json
from nexwarp.model.compact import NOISE, NOISES
from nexwarp.model.model_file import save_model
from nexwarp.run.folder import EXPORT_FOLDER, EXPORTS, ORIGIN_FILE, TRAIN, OpenedModel, read_metrics

# Packages that formats need, and their extras.
PACKAGES = {"glb": ("trimesh", "glb"), "spz": ("gaussforge", "splats"), "usd": ("pxr", "usd")}
SPLAT_WRITERS = {"ply": save_splats_ply, "spz": save_splats_spz, "gltf-splats": save_splats_glb}
RENDERED = ("mesh", "web", "glb", "usd")  # formats that are made of renderings, stage by stage
UNDISTORTED = "undistorted"  # folder of names of views that no file shows


@dataclass(frozen=True)
class ExportOrder:
    """What `nexwarp export` writes."""

    format: Annotated[str, arg(metavar="NAME")] = "ply"
    """ply, mesh, compact, cameras, web, glb, usd, spz or gltf-splats."""
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: RUN/export)")] = None
    """Output folder; with --format web also NAME.html, for one file with everything."""
    quality: Annotated[str, arg(metavar="{quantised,full}")] = "quantised"
    """Of --format web: quantised files are a fifth to a half as large."""
    alpha: Annotated[str, arg(metavar="{mask,blend}")] = "mask"
    """Of glb, usd: mask cuts surfels out, which all programs draw; blend is closer to photos, in those that sort."""
    noise: Annotated[float | None, arg(metavar="X", help_behavior_hint="(default: 8 % of the test views' error)")] = (
        None
    )
    """Of compact: noise that its pictures may have, of 1; files with more are smaller."""
    max_extent: Annotated[float, arg(metavar="X")] = MAX_EXTENT
    """Of splats: split surfels larger than this share of their distance to the nearest camera; inf splits none."""
    voxel: Annotated[
        float | None, arg(metavar="LENGTH", help_behavior_hint="(default: 1.5 pixels of the photos at median depth)")
    ] = None
    """Resolution of the mesh in world units."""
    far: Annotated[float | None, arg(metavar="DEPTH", help_behavior_hint="(default: 3 scene scales)")] = None
    """Largest distance of the mesh from each camera in world units."""

    def check(self) -> None:
        """Raise SettingError unless the options fit together."""
        if not self.max_extent > 0:
            raise SettingError(f"--max-extent: expected more than 0, got {self.max_extent:g}")
        if self.noise is not None and not NOISES[0] <= self.noise <= NOISES[1]:
            raise SettingError(f"--noise: expected {NOISES[0]:g} to {NOISES[1]:g}, got {self.noise:g}")
        if self.format not in EXPORTS:
            raise SettingError(f"--format: expected one of {', '.join(EXPORTS)}, got {self.format!r}")
        if self.alpha not in ALPHAS:
            raise SettingError(f"--alpha: expected {' or '.join(ALPHAS)}, got {self.alpha!r}")
        if self.format != "mesh" and (self.voxel is not None or self.far is not None):
            raise SettingError(f"--voxel, --far: expected together with --format mesh, got --format {self.format}")
        package, extra = PACKAGES.get(self.format, ("torch", ""))
        if importlib.util.find_spec(package) is None:
            need = f"--format {self.format}: needs the package {package}, found none"
            raise SettingError(f"{need}; pip install 'nexwarp[{extra}]'")


def export_run(
    opened: OpenedModel, order: ExportOrder, device: torch.device | str = "cpu", observe: Progress = lambda *_: None
) -> Sequence[Path]:
    """Export a run or a model, and return the files that were written; docs/outputs.md describes them.

    `device` renders what a mesh or a baked texture is made of; `observe` is called with the name of each of their
    stages, how many views, blocks or steps of it are done, and of how many.
    """
    order.check()
    folder = order.out or opened.folder / EXPORT_FOLDER
    files = [*_export(opened, order, folder, device, observe)]
    # Compact models and cameras say themselves where their frame lies in the world.
    if order.format not in ("compact", "cameras") and any(opened.model.origin or ()):
        files.append((folder.parent if folder.suffix == ".html" else folder) / ORIGIN_FILE)
        meaning = "world position = origin + exported position"
        write_json(files[-1], {"origin": opened.model.origin, "meaning": meaning})
    return files


def _export(
    opened: OpenedModel, order: ExportOrder, folder: Path, device: torch.device | str, observe: Progress
) -> Sequence[Path]:
    """Write the files of a format."""
    files = [folder / name for name in EXPORTS[order.format]]
    views: dict[str, Camera] = {}
    # A training that stopped early leaves no cameras file.
    if order.format not in ("compact", "mesh", "cameras") and (opened.folder / CAMERAS_FILE).is_file():
        views = {name: camera for members in opened.cameras.values() for name, camera in members.items()}
    if order.format == "web":
        from nexwarp.export.web.export import export_web

        model, page = opened.model.to(device), order.out or files[0]
        return export_web(model, views, page, quality=order.quality, title=opened.title or "nexwarp", progress=observe)
    if order.format == "cameras":
        _export_cameras(opened, *files)
    elif order.format == "mesh":
        trained = opened.cameras.get(TRAIN, {})
        if not trained:
            raise RunError(f"{opened.folder / CAMERAS_FILE}: expected training cameras, found none")
        model = opened.model.to(device)
        save_mesh(files[0], extract_mesh(model, [*trained.values()], voxel=order.voxel, far=order.far, observe=observe))
    elif order.format == "compact":
        save_model(files[0], opened.model, compact=_noise(opened) if order.noise is None else order.noise)
    else:
        _export_geometry(opened, order, files, list(views.values()), device, observe)
    return files


def _export_geometry(
    opened: OpenedModel,
    order: ExportOrder,
    files: Sequence[Path],
    cameras: list[Camera],
    device: torch.device | str,
    observe: Progress,
) -> None:
    """Write surfels as textured cards or as Gaussians."""
    surfels, degree = opened.model.surfels, min(opened.model.options.sh_degree, SPLAT_DEGREE)
    if order.format in ("glb", "usd"):
        if not cameras:
            raise RunError(f"{opened.path}: --format {order.format}: expected the run's {CAMERAS_FILE}, found none")
        cards = make_cards(bake(opened.model.to(device), cameras, progress=observe), order.alpha)
        if order.format == "glb":
            save_glb(files[0], cards, cameras)
        else:
            save_usdz(files[0], cards, surfels, degree, cameras)
        return
    if order.format == "ply":
        save_surfels_ply(files[0], surfels)
    SPLAT_WRITERS[order.format](files[-1], surfels, degree, cameras=cameras, max_extent=order.max_extent)


def _noise(opened: OpenedModel) -> float:
    """Return the noise of a compact file that costs 0.03 dB on a run's test views; without them the usual one."""
    psnr = read_metrics(opened.folder).get("psnr")
    return NOISE if not isinstance(psnr, (int, float)) else min(max(0.08 * 10 ** (-psnr / 20), NOISE / 4), NOISE * 4)


def _export_cameras(opened: OpenedModel, transforms: Path, camera_path: Path) -> None:
    """Write the cameras of a run for nerfstudio, with the lenses and sizes of the photos as they lie in their files."""
    names, lenses = _originals(opened)
    named = {group: {names[name]: camera for name, camera in cs.items()} for group, cs in opened.cameras.items()}
    cameras = dict(sorted({name: c for members in named.values() for name, c in members.items()}.items()))
    if not cameras:
        raise RunError(f"{opened.folder / CAMERAS_FILE}: expected at least one camera, found none")
    split = {group: sorted(named.get(group, {})) for group in ("train", "test")}
    save_transforms(transforms, cameras, **split, lenses=lenses)
    first = next(iter(cameras.values()))
    save_camera_path(camera_path, [resized(camera, first.width, first.height) for camera in cameras.values()])


def _originals(opened: OpenedModel) -> tuple[dict[str, str], dict[str, JsonObject]]:
    """Return the files of a run's views in the scene's folder, and the keys of lenses that nerfstudio knows by file."""
    views = [name for members in opened.cameras.values() for name in members]
    images = SceneSource.images if opened.source is None else opened.source.images
    if opened.source is None or not views:
        return {name: f"{images}/{name}" for name in views}, {}
    folder = demo_folder() if opened.source.path == DEMO else Path(opened.source.path)
    try:
        photos = {photo.name: photo for photo in opened.source.photos()}
    except (OSError, ValueError) as error:
        warnings.warn(
            f"{opened.source.path}: the scene cannot be read ({one_line(error)}), so the intrinsics are those of the "
            "photos as they were trained on, undistorted and reduced",
            stacklevel=2,
        )
        return {name: f"{images}/{name}" for name in views}, {}
    names, lenses = {}, {}
    for name in views:
        photo = photos.get(name)
        keys = None if photo is None else lens_keys(photo.lens, *image_size(photo.file))
        names[name] = f"{UNDISTORTED}/{name}"
        if photo is not None and keys is not None:
            names[name] = photo.file.relative_to(folder).as_posix()
            lenses[names[name]] = keys
    return names, lenses
