"""The cameras of a run as JSON, so that it can be rendered without its photos."""

import os
from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import torch

from nexwarp.cameras.camera import MAX_CAMERAS, Camera
from nexwarp.errors import FormatError, MissingError, check_range, check_version
from nexwarp.io.files import one_line
from nexwarp.io.json_files import READ_ERRORS, read_json, write_json

CAMERAS_FILE = "cameras.json"
CAMERAS_VERSION = 1  # of the file; one without `format_version` has version 1
SETS = ("train", "test")


def save_cameras(
    path: Path,
    cameras: Mapping[str, Mapping[str, Camera]],
    before: Mapping[str, Mapping[str, Camera]] | None = None,
) -> None:
    """Write cameras as JSON: set ("train", "test") -> name -> camera.

    `before` are the same cameras before their poses were refined; those that differ are written, too.
    """
    data: dict[str, dict[str, dict[str, object]]] = {}
    for group, members in cameras.items():
        data[group] = {}
        for name, camera in members.items():
            entry = data[group][name] = {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist()}
            entry |= {"width": camera.width, "height": camera.height, "near": camera.near}
            if before is not None and not torch.equal(before[group][name].viewmat.cpu(), camera.viewmat.cpu()):
                entry["given_viewmat"] = before[group][name].viewmat.tolist()
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
        check_version(data.get("format_version", 1), CAMERAS_VERSION)
        groups = {group: data[group] for group in SETS if group in data}
        if data and not groups:
            raise ValueError(f"expected {' or '.join(SETS)}, found neither")
        check_range("number of cameras", sum(len(members) for members in groups.values()), 0, MAX_CAMERAS)
        return {
            group: {_file_name(name): _camera(entry) for name, entry in members.items()}
            for group, members in groups.items()
        }
    except FileNotFoundError:
        raise MissingError(f"{path}: expected the run's cameras, found no such file") from None
    except (*READ_ERRORS, RuntimeError, OverflowError) as error:
        raise FormatError(f"{path}: expected named cameras as JSON ({one_line(error)})") from None


def _file_name(name: str) -> str:
    """Check that a photo's name is a relative path: renderings are written to files of these names."""
    if not name or any(".." in path.parts or path.anchor for path in (PurePosixPath(name), PureWindowsPath(name))):
        raise ValueError(f"expected the name of a photo, got {name!r:.60}")
    return name


def _camera(entry: dict[str, Any]) -> Camera:
    viewmat, K = torch.tensor(entry["viewmat"]), torch.tensor(entry["K"])
    return Camera(viewmat, K, entry["width"], entry["height"], near=entry["near"])
