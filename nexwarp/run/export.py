"""Export of run folders to the formats of other programs."""

from collections.abc import Sequence
from pathlib import Path

import torch

from nexwarp.camera import resized
from nexwarp.cameras.cameras_file import CAMERAS_FILE, load_cameras
from nexwarp.cameras.nerfstudio import save_camera_path, save_transforms
from nexwarp.errors import RunError, SettingError
from nexwarp.model.model_file import load
from nexwarp.model.surfels_ply import MAX_EXTENT, save_splats_ply, save_surfels_ply
from nexwarp.run.contents import CAMERA_PATH_FILE, MESH_FILE, SPLATS_FILE, SURFELS_FILE, TRAIN, TRANSFORMS_FILE
from nexwarp.run.folder import read_run
from nexwarp.run.mesh import Progress, extract_mesh, save_mesh

FORMATS = ("ply", "mesh", "cameras")


def export_run(
    run: Path,
    kind: str,
    folder: Path,
    max_extent: float = MAX_EXTENT,
    *,
    voxel: float | None = None,
    far: float | None = None,
    device: torch.device | str = "cpu",
    observe: Progress = lambda *_: None,
) -> Sequence[Path]:
    """Export a run to a folder; docs/outputs.md describes the files.

    Args:
        run: run folder.
        kind: "ply" (surfels.ply, splats.ply), "mesh" (mesh.ply) or "cameras" (transforms.json, camera_path.json).
        folder: output folder, created if it does not exist.
        max_extent: largest Gaussian in splats.ply, see `nexwarp.model.surfels_ply.save_splats_ply`.
        voxel: resolution of the mesh, see `nexwarp.run.mesh.extract_mesh`.
        far: farthest depth of the mesh, likewise.
        device: where to render for the mesh.
        observe: progress of the mesh.

    Returns:
        The files that were written.

    Raises:
        ValueError, OSError: the message names the option or file.
    """
    if not max_extent > 0:
        raise SettingError(f"--max-extent: expected more than 0, got {max_extent:g}")
    if kind not in FORMATS:
        raise SettingError(f"--format: expected {', '.join(FORMATS[:-1])} or {FORMATS[-1]}, got {kind!r}")
    if kind != "mesh" and (voxel is not None or far is not None):
        raise SettingError(f"--voxel, --far: expected together with --format mesh, got --format {kind}")
    source, _, _ = read_run(run)
    if kind == "mesh":
        trained = load_cameras(run / CAMERAS_FILE).get(TRAIN, {})
        if not trained:
            raise RunError(f"{run / CAMERAS_FILE}: expected training cameras, found none")
        model = load(run).to(device)
        save_mesh(folder / MESH_FILE, extract_mesh(model, [*trained.values()], voxel=voxel, far=far, observe=observe))
        return [folder / MESH_FILE]
    if kind == "ply":
        model = load(run)
        files = [folder / SURFELS_FILE, folder / SPLATS_FILE]
        save_surfels_ply(files[0], model.surfels)
        # A training that stopped early leaves a model, but no cameras file.
        groups = load_cameras(run / CAMERAS_FILE).values() if (run / CAMERAS_FILE).is_file() else ()
        all_cameras = [camera for members in groups for camera in members.values()]
        degree = model.options.sh_degree
        save_splats_ply(files[1], model.surfels, degree, cameras=all_cameras, max_extent=max_extent)
        return files
    sets = load_cameras(run / CAMERAS_FILE)
    # File paths are relative to the scene's folder, where nerfstudio expects the transforms.json.
    named = {
        group: {f"{source.images}/{name}": camera for name, camera in members.items()}
        for group, members in sets.items()
    }
    cameras = dict(sorted({name: c for members in named.values() for name, c in members.items()}.items()))
    if not cameras:
        raise RunError(f"{run / CAMERAS_FILE}: expected at least one camera, found none")
    files = [folder / TRANSFORMS_FILE, folder / CAMERA_PATH_FILE]
    save_transforms(files[0], cameras, train=sorted(named.get("train", {})), test=sorted(named.get("test", {})))
    first = next(iter(cameras.values()))
    save_camera_path(files[1], [resized(camera, first.width, first.height) for camera in cameras.values()])
    return files
