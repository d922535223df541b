"""Run folders: what a training leaves behind, and how it is found again.

A run holds `config.json` (scene and settings), `model.safetensors`, `cameras.json`, `metrics.json`, `renders/` and
`checkpoint/`.
"""

import ctypes
import dataclasses
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from nexwarp.checkpoint import write_atomically, write_json
from nexwarp.config import Config
from nexwarp.data import Scene, demo_folder, load_scene
from nexwarp.files import one_line
from nexwarp.json_files import read_json

CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.json"
CAMERAS_FILE = "cameras.json"
DEMO = "demo"
# Of glibc's mallopt.
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3


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


def prepare_run(run: Path, source: SceneSource, *, resume: bool, overwrite: bool) -> None:
    """Refuse a run folder that must not be touched; change nothing.

    Raises:
        ValueError: the folder exists and neither flag is given, or both are, or it is no run, or it holds the scene.
        FileNotFoundError: there is nothing to resume.
    """
    if resume and overwrite:
        raise ValueError("--resume, --overwrite: expected at most one of them, got both")
    if source.path != DEMO and Path(source.path).resolve().is_relative_to(run.resolve()):
        raise ValueError(f"--run: expected a folder that does not hold the scene, got {run}")
    exists = run.exists() and (not run.is_dir() or any(run.iterdir()))
    if resume:
        if not (run / CONFIG_FILE).is_file():
            raise FileNotFoundError(f"{run}: expected a run to resume, found no {CONFIG_FILE} there")
    elif exists and not overwrite:
        raise ValueError(
            f"{run}: expected a new run folder, but it exists; give --resume or --overwrite, or another --run"
        )
    elif exists and not (run / CONFIG_FILE).is_file():
        raise ValueError(f"{run}: expected a run folder to overwrite, but it holds no {CONFIG_FILE}; not touching it")


def create_run(run: Path, source: SceneSource, config: Config, device: str) -> None:
    """Make an empty run folder (in place of an old one, see `prepare_run`) with its config."""
    if run.exists():
        shutil.rmtree(run)
    run.mkdir(parents=True)
    scene = dataclasses.asdict(source)
    if source.path != DEMO:
        scene["path"] = str(Path(source.path).resolve())
    if source.points is not None:
        scene["points"] = str(Path(source.points).resolve())
    write_json(run / CONFIG_FILE, {"scene": scene, "device": device, "config": config.as_dict()})


def read_run(run: Path) -> tuple[SceneSource, Config, dict[str, Any]]:
    """Read a run's config.

    Returns:
        The scene's source, the settings, and everything in the file.
    """
    path = run / CONFIG_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{run}: expected a run folder, found no {CONFIG_FILE} there")
    try:
        data = read_json(path)
        scene = data["scene"]
        if type(scene["downscale"]) is not int or not isinstance(scene["path"], str):
            raise ValueError(f"scene: expected a path and an integer downscale, got {scene}")
        for name in ("images", "masks", "background", "points", "format"):
            if not isinstance(scene.get(name), (str, type(None))):
                raise ValueError(f"scene: {name}: expected text, got {scene[name]!r}")
        return SceneSource(**data["scene"]), Config.from_dict(data["config"]), data
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected the settings of a nexwarp run ({one_line(error)})") from None


def read_metrics(run: Path) -> dict[str, Any]:
    """Read a run's metrics; nothing where there are none yet."""
    path = run / METRICS_FILE
    try:
        return dict(read_json(path)) if path.is_file() else {}
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected the metrics of a nexwarp run ({one_line(error)})") from None


def keep_camera_path(run: Path, content: bytes) -> str:
    """Write a camera path (JSON) into a run under the next free name, and tell how to render it."""
    number = 1
    while (path := run / f"camera_path_{number}.json").exists():
        number += 1
    write_atomically(path, content)
    return f"nexwarp render {run} --path {path}"


def pick_device(name: str | None) -> torch.device:
    """Return the device asked for, or CUDA where there is one, else the CPU."""
    if name is None:
        return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")
    if name not in ("cuda", "cpu"):
        raise ValueError(f"--device: expected cuda or cpu, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device: cuda was asked for, but torch finds no CUDA device; use --device cpu")
    return torch.device("cuda", torch.cuda.current_device()) if name == "cuda" else torch.device("cpu")


def keep_freed_memory() -> None:
    """Let glibc keep what a CPU training frees: each step takes the same blocks again, page by page from the system.

    A tenth of a step's time. Does nothing where the C library is another one.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    for parameter, value in ((M_MMAP_THRESHOLD, 32 * 2**20), (M_TRIM_THRESHOLD, 2**31 - 1), (M_TOP_PAD, 64 * 2**20)):
        mallopt(parameter, value)
