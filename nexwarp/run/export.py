"""Export of run folders to the formats of other programs."""

from collections.abc import Sequence
from pathlib import Path

import torch

from nexwarp.cameras.camera import Camera, resized
from nexwarp.cameras.cameras_file import CAMERAS_FILE
from nexwarp.cameras.nerfstudio import save_camera_path, save_transforms
from nexwarp.errors import RunError, SettingError
from nexwarp.export.bake.fit import bake
from nexwarp.export.bake.glb import check_package, save_glb
from nexwarp.export.mesh import Progress, extract_mesh, save_mesh
from nexwarp.export.splats_spz import save_splats_spz
from nexwarp.export.surfels_ply import MAX_EXTENT, SPLAT_DEGREE, save_splats_ply, save_surfels_ply
from nexwarp.model.model_file import save_model
from nexwarp.run.contents import (
    CAMERA_PATH_FILE,
    COMPACT_FILE,
    EXPORT_FOLDER,
    GLB_FILE,
    MESH_FILE,
    SPLATS_FILE,
    SPZ_FILE,
    SURFELS_FILE,
    TRAIN,
    TRANSFORMS_FILE,
    WEB_FILE,
)
from nexwarp.run.folder import SceneSource
from nexwarp.run.opened import OpenedModel

FORMATS = ("ply", "mesh", "compact", "cameras", "web", "glb", "spz")


def export_run(
    opened: OpenedModel,
    kind: str,
    folder: Path | None = None,
    max_extent: float = MAX_EXTENT,
    quality: str = "quantised",
    device: torch.device | str = "cpu",
) -> Sequence[Path]:
    """Export a run or a model to a folder; docs/outputs.md describes the files.

    Args:
        opened: the run or model.
        kind: "ply" (surfels.ply, splats.ply), "mesh" (mesh.ply), "compact" (compact.safetensors), "cameras"
            (transforms.json, camera_path.json), "web" (a web page), "glb" (scene.glb) or "spz" (splats.spz).
        folder: output folder, created if it does not exist; None is the run's `export`. Of a web page, a name that ends
            in .html is one file with everything; None is `export/scene.html`.
        max_extent: largest Gaussian in splats.ply and splats.spz, see `nexwarp.export.surfels_ply.save_splats_ply`.
        quality: "quantised" or "full", of a web page.
        device: renders what the texture is baked from, of "web" and "glb".

    Returns:
        The files that were written.

    Raises:
        ValueError, OSError: the message names the option or file.
    """
    if not max_extent > 0:
        raise SettingError(f"--max-extent: expected more than 0, got {max_extent:g}")
    if kind not in FORMATS:
        raise SettingError(f"--format: expected one of {', '.join(FORMATS)}, got {kind!r}")
    if kind == "web":
        from nexwarp.export.web.export import export_web

        out = folder or opened.folder / EXPORT_FOLDER / WEB_FILE
        title, cameras = run_title(opened), _all_cameras(opened)
        return export_web(opened.model.to(device), cameras, out, quality=quality, title=title)
    folder = folder or opened.folder / EXPORT_FOLDER
    if kind == "mesh":
        return export_mesh(opened, folder, device)
    if kind == "cameras":
        return _export_cameras(opened, folder)
    if kind == "compact":
        return [save_model(folder / COMPACT_FILE, opened.model, compact=True)]
    if kind == "glb":
        return _export_glb(opened, folder, device)
    views = list(_all_cameras(opened).values())
    gaussians = (opened.model.surfels, min(opened.model.options.sh_degree, SPLAT_DEGREE))
    if kind == "spz":
        save_splats_spz(folder / SPZ_FILE, *gaussians, cameras=views, max_extent=max_extent)
        return [folder / SPZ_FILE]
    files = [folder / SURFELS_FILE, folder / SPLATS_FILE]
    save_surfels_ply(files[0], opened.model.surfels)
    save_splats_ply(files[1], *gaussians, cameras=views, max_extent=max_extent)
    return files


def export_mesh(
    opened: OpenedModel,
    folder: Path,
    device: torch.device | str = "cpu",
    *,
    voxel: float | None = None,
    far: float | None = None,
    observe: Progress = lambda *_: None,
) -> Sequence[Path]:
    """Write the mesh of a run, mesh.ply.

    Args:
        opened: the run, or a model with training cameras beside it.
        folder: output folder, created if it does not exist.
        device: where to render.
        voxel: resolution of the mesh, see `nexwarp.export.mesh.extract_mesh`.
        far: farthest depth of the mesh, likewise.
        observe: progress, likewise.

    Raises:
        ValueError, OSError: the message names the option or file.
    """
    trained = opened.cameras.get(TRAIN, {})
    if not trained:
        raise RunError(f"{opened.folder / CAMERAS_FILE}: expected training cameras, found none")
    mesh = extract_mesh(opened.model.to(device), [*trained.values()], voxel=voxel, far=far, observe=observe)
    save_mesh(folder / MESH_FILE, mesh)
    return [folder / MESH_FILE]


def _export_glb(opened: OpenedModel, folder: Path, device: torch.device | str) -> Sequence[Path]:
    """Write the baked surfels of a run as a glTF file."""
    cameras = list(_all_cameras(opened).values())
    if not cameras:
        raise RunError(f"{opened.path}: --format glb: expected the run's {CAMERAS_FILE}, found none")
    check_package()
    save_glb(folder / GLB_FILE, bake(opened.model.to(device), cameras), cameras)
    return [folder / GLB_FILE]


def _export_cameras(opened: OpenedModel, folder: Path) -> Sequence[Path]:
    """Write the cameras of a run for nerfstudio."""
    cameras_file = opened.folder / CAMERAS_FILE
    images = SceneSource.images if opened.source is None else opened.source.images
    # File paths are relative to the scene's folder, where nerfstudio expects the transforms.json.
    named = {
        group: {f"{images}/{name}": camera for name, camera in members.items()}
        for group, members in opened.cameras.items()
    }
    cameras = dict(sorted({name: c for members in named.values() for name, c in members.items()}.items()))
    if not cameras:
        raise RunError(f"{cameras_file}: expected at least one camera, found none")
    files = [folder / TRANSFORMS_FILE, folder / CAMERA_PATH_FILE]
    save_transforms(files[0], cameras, train=sorted(named.get("train", {})), test=sorted(named.get("test", {})))
    first = next(iter(cameras.values()))
    save_camera_path(files[1], [resized(camera, first.width, first.height) for camera in cameras.values()])
    return files


def _all_cameras(opened: OpenedModel) -> dict[str, Camera]:
    """Return the cameras of a run by name; none of a training that stopped early, which leaves no cameras file."""
    if not (opened.folder / CAMERAS_FILE).is_file():
        return {}
    return {name: camera for members in opened.cameras.values() for name, camera in members.items()}


def run_title(opened: OpenedModel) -> str:
    """Return the name of a run's scene, or of a model, as a title."""
    return opened.title if opened.source is None else Path(opened.source.path).name or "nexwarp"
