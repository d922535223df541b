"""The camera of a frame in a scene's JSON: its lens, its pose, and the transform of the world frame."""

import re
from pathlib import Path

import numpy as np

from nexwarp.cameras.nerfstudio import intrinsics_of, matrix_of, number_of
from nexwarp.data.capture import short
from nexwarp.data.images import image_size
from nexwarp.data.lens import PANORAMA, Lens
from nexwarp.io.json_files import JsonObject

ROTATION_TOLERANCE = 1e-3  # that of Camera
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in the order of COLMAP's FULL_OPENCV
FISHEYE = ("k1", "k2", "k3", "k4")


def frame_lens(where: str, keys: JsonObject, file: Path) -> Lens:
    """Read the lens of a frame.

    Args:
        where: place of the frame, for messages.
        keys: the file's keys, overridden by those of the frame.
        file: the image file, whose size is used if `w` or `h` is missing.

    Raises:
        ValueError: a size, camera model, coefficient or focal length is missing or invalid.
    """
    keys = {key: value for key, value in keys.items() if value is not None}
    columns: float
    rows: float
    if "w" in keys and "h" in keys:
        columns, rows = number_of(where, keys, "w"), number_of(where, keys, "h")
    else:
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
        return Lens(model, (*intrinsics_of(where, keys, width, height), *coefficients), width, height)
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
        return "OPENCV_FISHEYE", FISHEYE, _coefficients(where, keys, FISHEYE)
    if model not in PERSPECTIVE:
        raise ValueError(
            f"{where}: camera_model: expected one of {', '.join(PERSPECTIVE)}, OPENCV_FISHEYE, EQUIRECTANGULAR, "
            f"got {short(model)}"
        )
    coefficients = _coefficients(where, keys, RADIAL_TANGENTIAL)
    if not any(coefficients):
        return "PINHOLE", RADIAL_TANGENTIAL, []
    if not any(coefficients[4:]):
        return "OPENCV", RADIAL_TANGENTIAL, coefficients[:4]
    return "FULL_OPENCV", RADIAL_TANGENTIAL, coefficients


def _coefficients(where: str, keys: JsonObject, names: tuple[str, ...]) -> list[float]:
    return [number_of(where, keys, name) if name in keys else 0.0 for name in names]


def _check_rotation(where: str, key: str, rotation: np.ndarray, what: str) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not error <= ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ValueError(f"{where}: {key}: expected {what}, got a singular, sheared, scaled or mirroring one")


def frame_viewmat(where: str, frame: JsonObject, to_original: np.ndarray) -> np.ndarray:
    """Convert a frame's `transform_matrix` to a world-to-camera matrix with OpenCV axes in the original world frame.

    Args:
        where: place of the frame, for messages.
        frame: with the camera-to-world matrix with OpenGL axes in the file's world frame.
        to_original: (4, 4) float64 similarity of `inverse_applied`.

    Returns:
        (4, 4) float64.

    Raises:
        ValueError: the matrix is not a rigid motion.
    """
    pose = matrix_of(where, frame, "transform_matrix").numpy()
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
        applied = matrix_of(str(file), data, "applied_transform").numpy()
    with np.errstate(over="ignore", invalid="ignore"):
        if data.get("applied_scale") is not None:
            applied[:3] *= number_of(file, data, "applied_scale", above=0.0)
        volume = np.linalg.det(applied[:3, :3])
        linear = applied[:3, :3] / (np.cbrt(volume) if volume > 0 else 1.0)
    _check_rotation(str(file), "applied_transform", linear, "a rotation, a position and at most one scale")
    return np.linalg.inv(applied)
