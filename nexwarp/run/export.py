"""Export of run folders to the formats of other programs."""

from collections.abc import Sequence
from pathlib import Path

from nexwarp.camera import resized
from nexwarp.cameras.cameras_file import CAMERAS_FILE
from nexwarp.cameras.nerfstudio import save_camera_path, save_transforms
from nexwarp.errors import RunError, SettingError
from nexwarp.model.surfels_ply import MAX_EXTENT, save_splats_ply, save_surfels_ply
from nexwarp.run.contents import CAMERA_PATH_FILE, SPLATS_FILE, SURFELS_FILE, TRANSFORMS_FILE
from nexwarp.run.folder import SceneSource
from nexwarp.run.opened import OpenedModel

FORMATS = ("ply", "cameras")


def export_run(opened: OpenedModel, kind: str, folder: Path, max_extent: float = MAX_EXTENT) -> Sequence[Path]:
    """Export a run or a model to a folder; docs/outputs.md describes the files.

    Args:
        opened: the run or model.
        kind: "ply" (surfels.ply, splats.ply) or "cameras" (transforms.json, camera_path.json).
        folder: output folder, created if it does not exist.
        max_extent: largest Gaussian in splats.ply, see `nexwarp.model.surfels_ply.save_splats_ply`.

    Returns:
        The files that were written.

    Raises:
        ValueError, OSError: the message names the option or file.
    """
    if not max_extent > 0:
        raise SettingError(f"--max-extent: expected more than 0, got {max_extent:g}")
    if kind not in FORMATS:
        raise SettingError(f"--format: expected {' or '.join(FORMATS)}, got {kind!r}")
    cameras_file = opened.folder / CAMERAS_FILE
    if kind == "ply":
        model = opened.model
        files = [folder / SURFELS_FILE, folder / SPLATS_FILE]
        save_surfels_ply(files[0], model.surfels)
        # A training that stopped early leaves a model, but no cameras file.
        groups = opened.cameras.values() if cameras_file.is_file() else ()
        all_cameras = [camera for members in groups for camera in members.values()]
        degree = model.options.sh_degree
        save_splats_ply(files[1], model.surfels, degree, cameras=all_cameras, max_extent=max_extent)
        return files
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
