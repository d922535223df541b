"""Export of run folders to the formats of other programs."""

from collections.abc import Sequence
from pathlib import Path

from nexwarp.camera import resized
from nexwarp.cameras.cameras_file import CAMERAS_FILE, load_cameras
from nexwarp.cameras.nerfstudio import save_camera_path, save_transforms
from nexwarp.errors import RunError, SettingError
from nexwarp.model.model_file import load, save_model
from nexwarp.model.surfels_ply import MAX_EXTENT, save_splats_ply, save_surfels_ply
from nexwarp.run.contents import CAMERA_PATH_FILE, COMPACT_FILE, SPLATS_FILE, SURFELS_FILE, TRANSFORMS_FILE
from nexwarp.run.folder import read_run

FORMATS = ("ply", "compact", "cameras")


def export_run(run: Path, kind: str, folder: Path, max_extent: float = MAX_EXTENT) -> Sequence[Path]:
    """Export a run to a folder; docs/outputs.md describes the files.

    Args:
        run: run folder.
        kind: "ply" (surfels.ply, splats.ply), "compact" (compact.safetensors) or "cameras" (transforms.json,
            camera_path.json).
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
        raise SettingError(f"--format: expected one of {', '.join(FORMATS)}, got {kind!r}")
    source, _, _ = read_run(run)
    if kind == "compact":
        return [save_model(folder / COMPACT_FILE, load(run), compact=True)]
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
