"""Export of run folders to the formats of other programs."""

from collections.abc import Sequence
from pathlib import Path

from nexwarp.camera import Camera, resized
from nexwarp.cameras.cameras_file import CAMERAS_FILE, load_cameras
from nexwarp.cameras.nerfstudio import save_camera_path, save_transforms
from nexwarp.errors import RunError, SettingError
from nexwarp.model.model_file import load
from nexwarp.model.surfels_ply import MAX_EXTENT, save_splats_ply, save_surfels_ply
from nexwarp.run.contents import CAMERA_PATH_FILE, EXPORT_FOLDER, SPLATS_FILE, SURFELS_FILE, TRANSFORMS_FILE, WEB_FILE
from nexwarp.run.folder import SceneSource, read_run

FORMATS = ("ply", "cameras", "web")


def export_run(
    run: Path, kind: str, folder: Path | None = None, max_extent: float = MAX_EXTENT, quality: str = "quantised"
) -> Sequence[Path]:
    """Export a run to a folder; docs/outputs.md describes the files.

    Args:
        run: run folder.
        kind: "ply" (surfels.ply, splats.ply), "cameras" (transforms.json, camera_path.json) or "web" (a web page).
        folder: output folder, created if it does not exist; None is the run's `export`. Of a web page, a name that ends
            in .html is one file with everything; None is `export/scene.html`.
        max_extent: largest Gaussian in splats.ply, see `nexwarp.model.surfels_ply.save_splats_ply`.
        quality: "quantised" or "full", of a web page.

    Returns:
        The files that were written.

    Raises:
        ValueError, OSError: the message names the option or file.
    """
    if not max_extent > 0:
        raise SettingError(f"--max-extent: expected more than 0, got {max_extent:g}")
    if kind not in FORMATS:
        raise SettingError(f"--format: expected {' or '.join(FORMATS)}, got {kind!r}")
    source, _, _ = read_run(run)
    if kind == "web":
        from nexwarp.web.export import export_web

        return export_web(
            load(run),
            _all_cameras(run),
            folder or run / EXPORT_FOLDER / WEB_FILE,
            quality=quality,
            title=run_title(source),
        )
    folder = folder or run / EXPORT_FOLDER
    if kind == "ply":
        model = load(run)
        files = [folder / SURFELS_FILE, folder / SPLATS_FILE]
        save_surfels_ply(files[0], model.surfels)
        all_cameras = list(_all_cameras(run).values())
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


def _all_cameras(run: Path) -> dict[str, Camera]:
    """Return the cameras of a run by name; none of a training that stopped early, which leaves no cameras file."""
    if not (run / CAMERAS_FILE).is_file():
        return {}
    return {name: camera for members in load_cameras(run / CAMERAS_FILE).values() for name, camera in members.items()}


def run_title(source: SceneSource) -> str:
    """Return the name of a run's scene, as a title."""
    return Path(source.path).name or "nexwarp"
