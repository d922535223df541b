"""The cameras of a run as JSON, so that it can be rendered without its photos."""

import os
from collections.abc import Mapping
from pathlib import Path

import torch

from nexwarp.camera import Camera
from nexwarp.errors import FormatError, MissingError
from nexwarp.io.files import one_line
from nexwarp.io.json_files import READ_ERRORS, read_json, write_json

CAMERAS_FILE = "cameras.json"


def save_cameras(path: Path, cameras: Mapping[str, Mapping[str, Camera]]) -> None:
    """Write cameras as JSON: set ("train", "test") -> name -> camera.

    Raises:
        OSError: `path` cannot be written.
    """
    data = {
        group: {
            name: {
                "viewmat": camera.viewmat.tolist(),
                "K": camera.K.tolist(),
                "width": camera.width,
                "height": camera.height,
                "near": camera.near,
            }
            for name, camera in members.items()
        }
        for group, members in cameras.items()
    }
    write_json(path, data)


def load_cameras(path: str | os.PathLike[str]) -> dict[str, dict[str, Camera]]:
    """Read the cameras of a run; its photos are not needed.

    Args:
        path: a run folder, or its `cameras.json`.

    Returns:
        Set ("train", "test") -> name of the photo -> camera, float32 on the CPU.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is damaged or holds something else.
    """
    path = Path(path)
    if path.is_dir():
        path = path / CAMERAS_FILE
    try:
        data = read_json(path)
        return {
            group: {
                name: Camera(torch.tensor(c["viewmat"]), torch.tensor(c["K"]), c["width"], c["height"], near=c["near"])
                for name, c in members.items()
            }
            for group, members in data.items()
        }
    except FileNotFoundError:
        raise MissingError(f"{path}: expected the run's cameras, found no such file") from None
    except (*READ_ERRORS, RuntimeError, OverflowError) as error:
        raise FormatError(f"{path}: expected named cameras as JSON ({one_line(error)})") from None
