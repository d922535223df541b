"""The cameras of a run as JSON, so that it can be rendered without its photos."""

from collections.abc import Mapping
from pathlib import Path

import torch

from nexwarp.camera import Camera
from nexwarp.errors import FormatError, MissingError
from nexwarp.io.files import one_line
from nexwarp.io.json_files import READ_ERRORS, read_json, write_json


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


def load_cameras(path: Path) -> dict[str, dict[str, Camera]]:
    """Read a file of `save_cameras`: set -> name -> camera, float32 on the CPU.

    Raises:
        MissingError: no such file. FormatError: the file is damaged or holds something else.
    """
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
