"""Cameras in nerfstudio's JSON: camera paths of its viewer, the `transforms.json` of a scene, and values of both.

Their matrices are camera to world with x right, y up, z backward (OpenGL); nexwarp's are world to camera with x right,
y down, z forward. The world frame is that of the file, in float64; cameras of a model with a frame of its own
(`Camera.origin`) are moved to and from it.
"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch

from nexwarp.cameras.camera import MAX_CAMERAS, Camera
from nexwarp.cameras.cameras_file import WORLD
from nexwarp.errors import FormatError, MissingError
from nexwarp.io.files import one_line, write_atomically
from nexwarp.io.json_files import Json, JsonObject, read_object

# From OpenGL's camera axes to OpenCV's; its own inverse.
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))

INTRINSICS = ("fl_x", "fl_y", "cx", "cy")
SINGULAR = 1e-9  # determinants up to this count as zero
EXACT = 1e-9  # relative difference up to which intrinsics count as centred and square
LAST_ROW = 1e-6  # tolerance of a pose's last row
MAX_SIDE = 2**16  # pixels
LARGEST = 1e15  # limit of numbers: their squares stay finite in single precision


@dataclass(frozen=True)
class CameraPath:
    """Cameras along a path, float32 on the CPU; frames a second, None where the file gives none."""

    cameras: list[Camera]
    fps: float | None


def save_transforms(
    path: str | os.PathLike[str],
    cameras: Mapping[str, Camera],
    *,
    train: Sequence[str] | None = None,
    test: Sequence[str] | None = None,
    lenses: Mapping[str, Mapping[str, Json]] | None = None,
) -> None:
    """Write cameras, by the names of their image files, as a `transforms.json`, atomically.

    Each frame has its own intrinsics, so that sizes may differ. `lenses` has for some names the keys of a distorted
    lens, with its `camera_model`, in place of the camera's intrinsics. `train` are the names for `train_filenames`,
    `test` those for `val_filenames` and `test_filenames`; if both are None, no split is written. ValueError: none.
    """
    if not cameras:
        raise ValueError("cameras: expected at least one, got none")
    frames: list[dict[str, object]] = []
    for name, camera in cameras.items():
        pose, size = _camera_to_world(camera).tolist(), {"w": camera.width, "h": camera.height}
        lens = (lenses or {}).get(name, {"camera_model": "PINHOLE", **_intrinsics(camera), **size})
        frames.append({"file_path": name, "transform_matrix": pose, **lens})
    models = [frame.pop("camera_model") for frame in frames]  # nerfstudio reads one for the file
    for frame, model in zip(frames, models, strict=True):
        frame |= {} if model == models[0] else {"camera_model": model}
    data: dict[str, object] = {"camera_model": models[0], "frames": frames}
    if train is not None or test is not None:
        held_out = list(test or [])
        data |= {"train_filenames": list(train or []), "val_filenames": held_out, "test_filenames": held_out}
    write_atomically(Path(path), (json.dumps(data, indent=2) + "\n").encode())


def save_camera_path(path: str | os.PathLike[str], cameras: Sequence[Camera], fps: float = 30.0) -> None:
    """Write a camera path in nerfstudio's format, for `ns-render camera-path` and `nexwarp render --path`, atomically.

    nerfstudio's entries hold a vertical field of view only; they imply square pixels and a centred principal point. For
    other cameras the focal lengths and principal point are added as `fl_x`, `fl_y`, `cx`, `cy`, which nexwarp reads and
    nerfstudio ignores. ValueError: no cameras, cameras of several sizes, `fps` (frames a second) not > 0.
    """
    if not cameras:
        raise ValueError("cameras: expected at least one, got none")
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        raise ValueError(f"cameras: expected one size, got {' and '.join(f'{w}x{h}' for w, h in sizes[:2])}")
    if not 0 < fps < math.inf:
        raise ValueError(f"fps: expected more than 0 frames a second, got {fps}")
    width, height = sizes[0]
    entries = []
    for camera in cameras:
        fov = math.degrees(2 * math.atan(height / (2 * camera.fy)))
        entry = {"camera_to_world": _camera_to_world(camera).flatten().tolist(), "fov": fov, "aspect": width / height}
        plain = (camera.fy, camera.fy, width / 2, height / 2)
        exact = _intrinsics(camera)
        if any(abs(a - b) > EXACT * b for a, b in zip(exact.values(), plain, strict=True)):
            entry |= exact
        entries.append(entry)
    data = {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": fps,
        "seconds": len(cameras) / fps,
        "is_cycle": False,
        "smoothness_value": 0.0,
        "default_fov": entries[0]["fov"],
        "keyframes": [],
        "camera_path": entries,
    }
    write_atomically(Path(path), (json.dumps(data, indent=2) + "\n").encode())


def load_camera_path(
    path: str | os.PathLike[str], near: float = 0.01, origin: tuple[float, float, float] = WORLD
) -> CameraPath:
    """Read a camera path of nerfstudio's viewer.

    The cameras are float32 on the CPU, with the near depth `near` in world units, in the frame whose origin has the
    world coordinates `origin`, such as `Model.origin`. ValueError names a key that is missing or has an invalid value.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingError(f"{path}: no such file, expected cameras as JSON")
    data = read_object(path)
    if "camera_path" not in data:
        keys = ", ".join(sorted(data)[:8]) or "none"
        raise FormatError(f"{path}: expected the key camera_path, found {one_line(keys)}")
    if data.get("camera_type", "perspective") != "perspective":
        raise FormatError(f"{path}: camera_type: expected perspective, got {data['camera_type']!r:.60}")
    width, height = (_size(path, data, key) for key in ("render_width", "render_height"))
    fps = number_of(path, data, "fps", above=0.0) if "fps" in data else None
    cameras = []
    for i, entry in enumerate(list_of(path, data, "camera_path")):
        where = f"{path}: camera_path[{i}]"
        pose = matrix_of(where, entry, "camera_to_world") @ FLIP
        pose[:3, 3] -= pose.new_tensor(origin)
        if all(key in entry for key in INTRINSICS):
            fx, fy, cx, cy = (number_of(where, entry, key) for key in INTRINSICS)
        else:
            fov = number_of(where, entry, "fov", above=0.0, below=180.0)
            fx = fy = height / (2 * math.tan(math.radians(fov) / 2))
            cx, cy = width / 2, height / 2
        K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        try:
            cameras.append(Camera(torch.linalg.inv(pose).float(), K, width, height, near, origin=origin))
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
    return CameraPath(cameras, fps)


def _camera_to_world(camera: Camera) -> torch.Tensor:
    """(4, 4) float64 on the CPU, to the world frame."""
    # Not transposed: a float32 rotation is orthonormal to 1e-7 only.
    pose = torch.linalg.inv(camera.viewmat.detach().double().cpu())
    pose[:3, 3] += pose.new_tensor(camera.origin or WORLD)
    return pose @ FLIP


def _intrinsics(camera: Camera) -> dict[str, float]:
    return dict(zip(INTRINSICS, (camera.fx, camera.fy, camera.cx, camera.cy), strict=True))


def intrinsics_of(
    where: str, frame: Mapping[str, Json], file: Mapping[str, Json], width: int, height: int
) -> tuple[float, ...]:
    """Read fx, fy, cx and cy in pixels; ValueError where one does not fit.

    A focal length or field of view of the frame goes before those of the file, `fl_x` before `camera_angle_x`; an axis
    without one has the other's focal length. The principal point is the frame's, the file's or the image's centre.
    """
    focal: list[float] = []
    for values in (frame, file):
        for axis, side in (("x", width), ("y", height)) if not focal else ():
            if values.get(f"fl_{axis}") is not None:
                focal.append(number_of(where, values, f"fl_{axis}"))
            elif values.get(f"camera_angle_{axis}") is not None:
                angle = number_of(where, values, f"camera_angle_{axis}", above=0.0, below=math.pi)
                focal.append(0.5 * side / math.tan(0.5 * angle))
    if not focal:
        raise ValueError(f"{where}: expected a focal length (fl_x or camera_angle_x), found none")
    values = merged(frame, file)
    centre = []
    for key, side_key, side in (("cx", "w", width), ("cy", "h", height)):
        if key in values and frame.get(key) is None and file.get(side_key, side) not in (None, side):
            raise ValueError(f"{where}: {key}: expected one of the frame's own, as its {side_key} is not the file's")
        centre.append(number_of(where, values, key) if key in values else side / 2)
    return focal[0], focal[-1], *centre


def merged(frame: Mapping[str, Json], file: Mapping[str, Json]) -> JsonObject:
    """The values of a frame, and those of its file that it does not have; null counts as none."""
    return {key: value for values in (file, frame) for key, value in values.items() if value is not None}


def list_of(path: Path, data: JsonObject, key: str) -> list[JsonObject]:
    """Read a list of JSON objects, at least one and at most `MAX_CAMERAS`."""
    entries = data.get(key)
    if not isinstance(entries, list) or not 0 < len(entries) <= MAX_CAMERAS:
        expected = f"a list of at least one camera, at most {MAX_CAMERAS:,}"
        raise FormatError(f"{path}: {key}: expected {expected}, got {one_line(entries, 60)}")
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise FormatError(f"{path}: {key}[{i}]: expected a JSON object, got {one_line(entry, 60)}")
    return cast(list[JsonObject], entries)


def number_of(
    where: str | Path, values: Mapping[str, Json], key: str, above: float = -math.inf, below: float = math.inf
) -> float:
    """Read a finite number; raise ValueError unless it lies between `above` and `below`, both excluded."""
    if key not in values:
        raise ValueError(f"{where}: expected the key {key}, found none")
    value = values[key]
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        if above < value < below and abs(value) <= LARGEST:
            return float(value)
    least = f" above {above:g}" if above > -math.inf else ""
    most = f" below {below:g}" if below < math.inf else ""
    raise ValueError(f"{where}: {key}: expected a number{least}{most}, got {value!r:.60}")


def _size(where: str | Path, values: Mapping[str, Json], key: str) -> int:
    size = number_of(where, values, key, above=0.0)
    if size > MAX_SIDE or size != int(size):
        expected = f"at most {MAX_SIDE}" if size > MAX_SIDE else "a whole number of"
        raise ValueError(f"{where}: {key}: expected {expected} pixels, got {size:g}")
    return int(size)


def matrix_of(where: str, values: Mapping[str, Json], key: str) -> torch.Tensor:
    """Read an invertible matrix (4, 4) float64 of three or four rows of four numbers, nested or flat."""
    if key not in values:
        raise ValueError(f"{where}: expected the key {key}, found none")
    try:
        matrix = torch.tensor(values[key], dtype=torch.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        matrix = torch.empty(0)
    if tuple(matrix.shape) not in ((16,), (12,), (4, 4), (3, 4)):
        raise ValueError(f"{where}: {key}: expected a 4x4 matrix of numbers, got {one_line(values[key], 60)}")
    last = matrix.new_tensor([0.0, 0.0, 0.0, 1.0])
    matrix = torch.cat([matrix.flatten(), last])[:16].reshape(4, 4)
    if not bool((matrix.abs() <= LARGEST).all()):
        raise ValueError(f"{where}: {key}: expected finite numbers of at most {LARGEST:g}, got {matrix.tolist()}")
    if (matrix[3] - last).abs().max() > LAST_ROW:
        raise ValueError(f"{where}: {key}: expected the last row 0, 0, 0, 1, got {matrix[3].tolist()}")
    if torch.linalg.det(matrix[:3, :3]).abs() <= SINGULAR:
        raise ValueError(f"{where}: {key}: expected an invertible pose, got the singular matrix {matrix.tolist()}")
    return matrix
