"""The cameras of a run as JSON, so that it can be rendered without its photos."""

import os
from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import torch

from nexwarp.cameras.camera import LARGEST_DISTANCE, MAX_CAMERAS, Camera
from nexwarp.errors import FormatError, MissingError, check_range, check_version
from nexwarp.io.files import one_line
from nexwarp.io.json_files import READ_ERRORS, read_json, write_json

CAMERAS_FILE = "cameras.json"
CAMERAS_VERSION = 1  # of the file; one without `format_version` has version 1
SETS = ("train", "test")
WORLD = (0.0, 0.0, 0.0)


def save_cameras(
    path: Path, cameras: Mapping[str, Mapping[str, Camera]], before: Mapping[str, Mapping[str, Camera]] | None = None
) -> None:
    """Write cameras as JSON: set ("train", "test") -> name -> camera, and the `origin` of their frame if it has one.

    `before` are the same cameras before their poses were refined; those that differ are written, too.
    """
    origins = {camera.origin or WORLD for members in cameras.values() for camera in members.values()} - {WORLD}
    data: dict[str, object] = {"origin": list(*origins)} if origins else {}
    for group, members in cameras.items():
        entries = {}
        for name, camera in members.items():
            entry = camera_entry(camera)
            given = camera if before is None else before[group][name]
            if not torch.equal(given.viewmat.cpu(), camera.viewmat.cpu()):
                entry["given_viewmat"] = given.viewmat.tolist()
            entries[name] = entry
        data[group] = entries
    write_json(path, data)


def load_cameras(path: str | os.PathLike[str]) -> dict[str, dict[str, Camera]]:
    """Read the cameras of a run; its photos are not needed.

    Args:
        path: a run folder, or its `cameras.json`.

    Returns:
        Set ("train", "test") -> name of the photo -> camera, float32 on the CPU, in the model's frame; `Camera.origin`
        says where that lies in the world, where it is not the world frame itself.

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
        origin = origin_of(data)
        return {
            group: {_file_name(name): camera_of(entry, origin) for name, entry in members.items()}
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


def origin_of(data: Mapping[str, object]) -> tuple[float, float, float] | None:
    """Read the key `origin` of a model's or a file's frame, three finite numbers; None where there is none."""
    values = data.get("origin")
    if values is None:
        return None
    if (
        not isinstance(values, list)
        or len(values) != 3
        or not all(type(value) in (int, float) and abs(value) <= LARGEST_DISTANCE for value in values)
    ):
        raise ValueError(f"origin: expected three numbers, got {one_line(values, 60)}")
    x, y, z = map(float, values)
    return x, y, z


def camera_entry(camera: Camera) -> dict[str, object]:
    """Return a camera, but for the origin of its frame, as JSON values."""
    entry = {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "width": camera.width}
    return entry | {"height": camera.height, "near": camera.near}


def camera_of(entry: dict[str, Any], origin: tuple[float, float, float] | None) -> Camera:
    """Return the camera of `camera_entry`, in a frame with an origin."""
    viewmat, K = torch.tensor(entry["viewmat"]), torch.tensor(entry["K"])
    return Camera(viewmat, K, entry["width"], entry["height"], near=entry["near"], origin=origin)
