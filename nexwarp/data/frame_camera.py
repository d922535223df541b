"""The camera of a frame in a scene's JSON: its lens, its pose, and the transform of the world frame."""

import math
import re
from pathlib import Path

import numpy as np

from nexwarp.data.capture import LARGEST_COORDINATE, short
from nexwarp.data.images import image_size
from nexwarp.data.lens import PANORAMA, Lens
from nexwarp.io.json_files import Json, JsonObject

ROTATION_TOLERANCE = 1e-3  # that of Camera
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in the order of COLMAP's FULL_OPENCV
FISHEYE = ("k1", "k2", "k3", "k4")


def _number(where: str, keys: JsonObject, key: str) -> float | None:
    """A finite number; None if the key is missing or null."""
    value = keys.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{where}: {key}: expected a number, got {short(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{where}: {key}: expected a finite number, got {number}")
    return number


def frame_lens(where: str, keys: JsonObject, file: Path) -> Lens:
    """Read the lens of a frame.

    Args:
        where: place of the frame, for messages.
        keys: the file's keys, overridden by those of the frame.
        file: the image file, whose size is used if `w` or `h` is missing.

    Raises:
        ValueError: a size, camera model, coefficient or focal length is missing or invalid.
    """
    columns: float | None = _number(where, keys, "w")
    rows: float | None = _number(where, keys, "h")
    if columns is None or rows is None:
        columns, rows = image_size(file)
    if any(side != int(side) or side < 1 for side in (columns, rows)):
        raise ValueError(f"{where}: w, h: expected whole numbers of pixels, got {columns:g}x{rows:g}")
    width, height = int(columns), int(rows)
    model, known, coefficients = _distortion(where, keys)
    unknown = [key for key in keys if re.fullmatch(r"[kps]\d", key) and key not in known and keys[key]]
    if unknown:
        raise ValueError(f"{where}: lens coefficient {unknown[0]} is no part of camera model {model}")
    try:
        if model == PANORAMA:
            return Lens(model, (float(width), float(height)), width, height)
        return Lens(model, (*_focal(where, keys, width, height), *coefficients), width, height)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(where) else f"{where}: {text}") from None


def _distortion(where: str, keys: JsonObject) -> tuple[str, tuple[str, ...], list[float]]:
    """COLMAP's camera model of a frame, the keys of its coefficients, and their values in COLMAP's order.

    The model is the simplest one with the coefficients that are not 0.
    """
    model = keys.get("camera_model")
    if model is None:
        model = "OPENCV_FISHEYE" if keys.get("is_fisheye") else PANORAMA if keys.get("is_equirectangular") else "OPENCV"
    if model == PANORAMA:
        return PANORAMA, (), []
    if model == "OPENCV_FISHEYE":
        return "OPENCV_FISHEYE", FISHEYE, [_number(where, keys, key) or 0.0 for key in FISHEYE]
    if model not in PERSPECTIVE:
        raise ValueError(
            f"{where}: camera_model: expected one of {', '.join(PERSPECTIVE)}, OPENCV_FISHEYE, EQUIRECTANGULAR, "
            f"got {short(model)}"
        )
    coefficients = [_number(where, keys, key) or 0.0 for key in RADIAL_TANGENTIAL]
    if not any(coefficients):
        return "PINHOLE", RADIAL_TANGENTIAL, []
    if not any(coefficients[4:]):
        return "OPENCV", RADIAL_TANGENTIAL, coefficients[:4]
    return "FULL_OPENCV", RADIAL_TANGENTIAL, coefficients


def _focal(where: str, keys: JsonObject, width: int, height: int) -> tuple[float, float, float, float]:
    """Focal lengths, given or from fields of view, and principal point, by default the image's centre; pixels."""
    focal: list[float | None] = []
    for axis, side in (("x", width), ("y", height)):
        length, angle = _number(where, keys, f"fl_{axis}"), _number(where, keys, f"camera_angle_{axis}")
        if length is None and angle is not None:
            if not 0 < angle < math.pi:
                raise ValueError(f"{where}: camera_angle_{axis}: expected radians between 0 and pi, got {angle:g}")
            length = 0.5 * side / math.tan(0.5 * angle)
        focal.append(length)
    fx, fy = (given if given is not None else focal[1 - index] for index, given in enumerate(focal))
    if fx is None or fy is None:
        raise ValueError(f"{where}: expected a focal length (fl_x or camera_angle_x), found none")
    cx, cy = _number(where, keys, "cx"), _number(where, keys, "cy")
    return fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy


def _row(value: Json) -> list[float] | None:
    """A list of 4 numbers; None for anything else."""
    if not isinstance(value, list):
        return None
    numbers = [x for x in value if isinstance(x, (int, float)) and not isinstance(x, bool)]
    return numbers if len(numbers) == len(value) == 4 else None


def _matrix(where: str, key: str, value: Json) -> np.ndarray:
    """(4, 4) float64 from a list of 3 or 4 rows."""
    entries = value if isinstance(value, list) else []
    rows = [row for row in map(_row, entries) if row is not None]
    if len(entries) not in (3, 4) or len(rows) < len(entries):
        raise ValueError(f"{where}: {key}: expected 4 rows of 4 numbers, got {short(value)}")
    try:
        matrix = np.array([*rows[:3], rows[3] if len(rows) == 4 else [0, 0, 0, 1]], dtype=np.float64)
    except OverflowError:
        raise ValueError(f"{where}: {key}: expected finite numbers, got {short(value)}") from None
    if not (np.abs(matrix) <= LARGEST_COORDINATE).all():
        raise ValueError(
            f"{where}: {key}: expected finite numbers of at most {LARGEST_COORDINATE:g}, got {short(value)}"
        )
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE:
        raise ValueError(f"{where}: {key}: expected the last row 0, 0, 0, 1, got {short(rows[3])}")
    return matrix


def _check_rotation(where: str, key: str, rotation: np.ndarray, what: str) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not error <= ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ValueError(f"{where}: {key}: expected {what}, got a singular, sheared, scaled or mirroring one")


def frame_viewmat(where: str, value: Json, to_original: np.ndarray) -> np.ndarray:
    """Convert a frame's `transform_matrix` to a world-to-camera matrix with OpenCV axes in the original world frame.

    Args:
        where: place of the frame, for messages.
        value: camera-to-world matrix with OpenGL axes in the file's world frame, 3 or 4 rows.
        to_original: (4, 4) float64 similarity of `inverse_applied`.

    Returns:
        (4, 4) float64.

    Raises:
        ValueError: `value` is not a rigid motion.
    """
    pose = _matrix(where, "transform_matrix", value)
    _check_rotation(where, "transform_matrix", pose[:3, :3], "a rotation and a position")
    linear = to_original[:3, :3]
    rotation = linear / np.cbrt(np.linalg.det(linear)) @ pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ (linear @ pose[:3, 3] + to_original[:3, 3])
    return viewmat


def inverse_applied(file: Path, data: JsonObject) -> np.ndarray:
    """Invert `applied_transform` and `applied_scale`.

    Returns:
        (4, 4) float64 similarity from the file's world frame to the original one.

    Raises:
        ValueError: `applied_transform` is not a similarity, or `applied_scale` is not positive.
    """
    applied = np.eye(4)
    if data.get("applied_transform") is not None:
        applied = _matrix(str(file), "applied_transform", data["applied_transform"])
    scale = _number(str(file), data, "applied_scale")
    if scale is not None:
        if not scale > 0:
            raise ValueError(f"{file}: applied_scale: expected a number > 0, got {scale:g}")
        with np.errstate(over="ignore"):
            applied[:3] *= scale
    with np.errstate(over="ignore", invalid="ignore"):
        volume = np.linalg.det(applied[:3, :3])
        factor = np.cbrt(volume) if volume > 0 else 1.0
        linear = applied[:3, :3] / factor
    _check_rotation(str(file), "applied_transform", linear, "a rotation, a position and at most one scale")
    return np.linalg.inv(applied)
