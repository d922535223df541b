"""Run folders: what a training leaves behind, and how it is found again.

A run holds `config.json` (scene and settings), `model.safetensors`, `cameras.json`, `metrics.json`, `metrics.jsonl`,
`renders/` and `checkpoint/`: docs/format.md.
"""

import dataclasses
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nexwarp.data import Scene, demo_folder, load_scene
from nexwarp.errors import FormatError, MissingError, RunError, SettingError, StorageError
from nexwarp.io.files import is_leftover, one_line, remove_leftovers, write_atomically, written_aside
from nexwarp.io.json_files import READ_ERRORS, read_json
from nexwarp.train.config import Config
from nexwarp.train.presets import config_from_dict

CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.json"
CAMERAS_FILE = "cameras.json"
DEMO = "demo"


@dataclass(frozen=True)
class SceneSource:
    """Where a run's photos come from."""

    path: str
    """A folder (COLMAP, nerfstudio or Blender), or "demo"."""
    images: str = "images"
    """Folder of the photos below it."""
    downscale: int = 1
    """Factor by which photos are reduced, by area."""
    masks: str = "masks"
    """Folder of the masks below it, "alpha" or "none"."""
    background: str | None = None
    """Colour that transparent photos are put on: white, black, R,G,B or random."""
    points: str | None = None
    """PLY file of the points to start from."""
    format: str | None = None
    """Kind of the scene, where its folder holds more than one."""

    @property
    def name(self) -> str:
        """Name of the scene, for folders and tables."""
        return DEMO if self.path == DEMO else Path(self.path).resolve().name

    def load(self, progress: Callable[[int, int], None] | None = None) -> Scene:
        """Load the scene, telling `progress` how many photos are read; the demo is made on first use."""
        options = dataclasses.asdict(self) | {"progress": progress}
        folder = options.pop("path")
        return load_scene(demo_folder() if folder == DEMO else folder, **options)


def prepare_run(run: Path, source: SceneSource, *, resume: bool, overwrite: bool) -> bool:
    """Refuse a run folder that must not be touched; change nothing.

    Returns:
        Whether there is a run to continue: a folder that was made, but got nothing before the process was killed, is
        none, though resuming may start there.

    Raises:
        ValueError: the folder exists and neither flag is given, or both are, or it is no run, or it holds the scene.
        FileNotFoundError: there is nothing to resume.
    """
    if resume and overwrite:
        raise SettingError("--resume, --overwrite: expected at most one of them, got both")
    if source.path != DEMO and Path(source.path).resolve().is_relative_to(run.resolve()):
        raise SettingError(f"--run: expected a folder that does not hold the scene, got {run}")
    exists = run.exists() and (not run.is_dir() or any(run.iterdir()))
    if resume:
        if (run / CONFIG_FILE).is_file():
            return True
        if not run.is_dir() or any(not is_leftover(file) for file in run.iterdir()):
            raise MissingError(f"{run}: expected a run to resume, found no {CONFIG_FILE} there")
    elif exists and not overwrite:
        raise RunError(
            f"{run}: expected a new run folder, but it exists; give --resume or --overwrite, or another --run"
        )
    elif exists and not (run / CONFIG_FILE).is_file():
        raise RunError(f"{run}: expected a run folder to overwrite, but it holds no {CONFIG_FILE}; not touching it")
    return False


def create_run(run: Path, source: SceneSource, config: Config, device: str) -> None:
    """Make an empty run folder (in place of an old one, see `prepare_run`) with its config.

    An old one goes only once the new config is on the disk, and loses its own config last: whenever that is
    interrupted, what is there is a run still.
    """
    scene = dataclasses.asdict(source)
    if source.path != DEMO:
        scene["path"] = str(Path(source.path).resolve())
    if source.points is not None:
        scene["points"] = str(Path(source.points).resolve())
    data = {"scene": scene, "device": device, "config": config.as_dict()}
    with written_aside(run / CONFIG_FILE, durable=True) as temporary:
        temporary.write_bytes((json.dumps(data, indent=2) + "\n").encode())
        for file in sorted(run.iterdir()):
            if file.is_dir() and not file.is_symlink():
                shutil.rmtree(file)
            elif file.name not in (temporary.name, CONFIG_FILE):
                file.unlink()


def tidy_run(run: Path) -> None:
    """Remove what killed processes left half-written in a run."""
    shutil.rmtree(run / "checkpoint.tmp", ignore_errors=True)
    remove_leftovers(run)


def check_room(run: Path, size: int) -> None:
    """Raise StorageError unless a run folder, there or not, can take files of that many bytes in all."""
    folder = next(f for f in (run, *run.absolute().parents) if f.is_dir())
    try:
        free = shutil.disk_usage(folder).free
    except OSError:  # of a file system that cannot tell
        return
    if free < size:
        raise StorageError(
            f"{run}: expected room for a model and its checkpoints, about {size / 2**20:,.0f} MiB, but the disk has "
            f"{free / 2**20:,.0f} MiB left; make room, give another --run, or lower --max-surfels"
        )


def read_run(run: Path) -> tuple[SceneSource, Config, dict[str, Any]]:
    """Read a run's config.

    Returns:
        The scene's source, the settings, and everything in the file.
    """
    path = run / CONFIG_FILE
    if not path.is_file():
        raise MissingError(f"{run}: expected a run folder, found no {CONFIG_FILE} there")
    try:
        data = read_json(path)
        scene = data["scene"]
        if type(scene["downscale"]) is not int or not isinstance(scene["path"], str):
            raise ValueError(f"scene: expected a path and an integer downscale, got {scene}")
        for name in ("images", "masks", "background", "points", "format"):
            if not isinstance(scene.get(name), (str, type(None))):
                raise ValueError(f"scene: {name}: expected text, got {scene[name]!r}")
        return SceneSource(**data["scene"]), config_from_dict(data["config"]), data
    except READ_ERRORS as error:
        raise FormatError(f"{path}: expected the settings of a nexwarp run ({one_line(error)})") from None


def read_metrics(run: Path) -> dict[str, Any]:
    """Read a run's metrics; nothing where there are none yet."""
    path = run / METRICS_FILE
    try:
        metrics = read_json(path) if path.is_file() else {}
        if not isinstance(metrics, dict):
            raise ValueError(f"expected an object, got {type(metrics).__name__}")
        for name in ("psnr", "ssim"):
            if not isinstance(metrics.get(name, 0.0), (int, float)):
                raise ValueError(f"{name}: expected a number, got {metrics[name]!r}")
        return metrics
    except READ_ERRORS as error:
        raise FormatError(f"{path}: expected the metrics of a nexwarp run ({one_line(error)})") from None


def keep_camera_path(run: Path, content: bytes) -> str:
    """Write a camera path (JSON) into a run under the next free name, and tell how to render it."""
    number = 1
    while (path := run / f"camera_path_{number}.json").exists():
        number += 1
    write_atomically(path, content)
    return f"nexwarp render {run} --path {path}"
