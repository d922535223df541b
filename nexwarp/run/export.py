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
from nexwarp.run import contents
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
    out = folder or opened.folder / contents.EXPORT_FOLDER
    if kind == "mesh":
        return export_mesh(opened, out, device)
    if kind == "cameras":
        return _export_cameras(opened, out)
    if kind == "compact":
        return [save_model(out / contents.COMPACT_FILE, opened.model, compact=True)]
    cameras = _all_cameras(opened)
    if kind == "web":
        from nexwarp.export.web.export import export_web

        title = opened.title if opened.source is None else Path(opened.source.path).name or "nexwarp"
        page = folder or out / contents.WEB_FILE
        return export_web(opened.model.to(device), cameras, page, quality=quality, title=title)
    views = list(cameras.values())
    if kind == "glb":
        if not views:
            raise RunError(f"{opened.path}: --format glb: expected the run's {CAMERAS_FILE}, found none")
        check_package()
        save_glb(out / contents.GLB_FILE, bake(opened.model.to(device), views), views)
        return [out / contents.GLB_FILE]
    surfels, degree = opened.model.surfels, min(opened.model.options.sh_degree, SPLAT_DEGREE)
    if kind == "spz":
        save_splats_spz(out / contents.SPZ_FILE, surfels, degree, cameras=views, max_extent=max_extent)
        return [out / contents.SPZ_FILE]
    save_surfels_ply(out / contents.SURFELS_FILE, surfels)
    save_splats_ply(out / contents.SPLATS_FILE, surfels, degree, cameras=views, max_extent=max_extent)
    return [out / contents.SURFELS_FILE, out / contents.SPLATS_FILE]


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
    trained = opened.cameras.get(contents.TRAIN, {})
    if not trained:
        raise RunError(f"{opened.folder / CAMERAS_FILE}: expected training cameras, found none")
    mesh = extract_mesh(opened.model.to(device), [*trained.values()], voxel=voxel, far=far, observe=observe)
    save_mesh(folder / contents.MESH_FILE, mesh)
    return [folder / contents.MESH_FILE]


def _export_cameras(opened: OpenedModel, folder: Path) -> Sequence[Path]:
    """Write the cameras of a run for nerfstudio."""
    images = SceneSource.images if opened.source is None else opened.source.images
    # File paths are relative to the scene's folder, where nerfstudio expects the transforms.json.
    named = {
        group: {f"{images}/{name}": camera for name, camera in sorted(members.items())}
        for group, members in opened.cameras.items()
    }
    cameras = dict(sorted({name: camera for members in named.values() for name, camera in members.items()}.items()))
    if not cameras:
        raise RunError(f"{opened.folder / CAMERAS_FILE}: expected at least one camera, found none")
    files = [folder / contents.TRANSFORMS_FILE, folder / contents.CAMERA_PATH_FILE]
    save_transforms(files[0], cameras, train=list(named.get("train", {})), test=list(named.get("test", {})))
    first = next(iter(cameras.values()))
    save_camera_path(files[1], [resized(camera, first.width, first.height) for camera in cameras.values()])
    return files


def _all_cameras(opened: OpenedModel) -> dict[str, Camera]:
    """Return the cameras of a run by name; none of a training that stopped early, which leaves no cameras file."""
    if not (opened.folder / CAMERAS_FILE).is_file():
        return {}
    return {name: camera for members in opened.cameras.values() for name, camera in members.items()}
