"""The camera of a frame in a scene's JSON: its lens, its pose, and the transform of the world frame."""

import re
from pathlib import Path

import numpy as np

from nexwarp.cameras.nerfstudio import intrinsics_of, matrix_of, merged, number_of
from nexwarp.data.capture import short
from nexwarp.data.images import image_size
from nexwarp.data.lens import BROWN, PANORAMA, Lens
from nexwarp.io.json_files import JsonObject

ROTATION_TOLERANCE = 1e-3  # that of Camera
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in the order of COLMAP's FULL_OPENCV
FISHEYE = ("k1", "k2", "k3", "k4")
FISHEYES = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
DISTORTION_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")  # in the order of nerfstudio's list
# Keys of lenses and shutters; what is not read of them would change the picture.
OPTICAL = re.compile(
    r"[kpsb]\d*|tau_?[xy\d]*|xi|skew|(radial|tangential|principal|focal|transform_matrix_)\w*"
    r"|\w*(distort|shutter|fisheye|ftheta|latlong|equirect|intrinsic|fov|lens_)\w*|lens_?(mode|model|type|params?)",
    re.IGNORECASE,
)
LENS_KEYS = {*RADIAL_TANGENTIAL, "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y"}
LENS_KEYS |= {"camera_model", "is_fisheye", "is_equirectangular", "equirectangular", "distortion_params"}


def frame_lens(where: str, frame: JsonObject, shared: JsonObject, file: Path) -> Lens:
    """Read the lens of a frame, whose keys go before `shared`, those of the JSON file.

    The size of the image `file` is used if `w` or `h` is missing. ValueError: a size, camera model, coefficient or
    focal length is missing or invalid, or a key of a lens or shutter is not known.
    """
    keys = merged(frame, shared)
    columns: float
    rows: float
    if "w" in keys and "h" in keys:
        columns, rows = number_of(where, keys, "w"), number_of(where, keys, "h")
    else:
        columns, rows = image_size(file)
    if any(side != int(side) or side < 1 for side in (columns, rows)):
        raise ValueError(f"{where}: w, h: expected whole numbers of pixels, got {columns:g}x{rows:g}")
    width, height = int(columns), int(rows)
    model, coefficients = _distortion(where, _with_list(where, frame, shared))
    try:
        if model == PANORAMA:
            return Lens(model, (float(width), float(height)), width, height)
        return Lens(model, (*intrinsics_of(where, frame, shared, width, height), *coefficients), width, height)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(where) else f"{where}: {text}") from None


def lens_keys(lens: Lens, width: int, height: int) -> JsonObject | None:
    """Return the keys from which `frame_lens` reads a lens, at a photo's size in pixels; None if there are none."""
    one_focal = lens.model.startswith(("SIMPLE", "RADIAL"))
    fx, fy, cx, cy, *coefficients = (lens.params[0], *lens.params) if one_focal else lens.params
    models: dict[str, tuple[str, tuple[str, ...]]] = {
        **dict.fromkeys(("PINHOLE", "SIMPLE_PINHOLE"), ("PINHOLE", ())),
        **dict.fromkeys(("SIMPLE_RADIAL", "RADIAL", "OPENCV", "BROWN"), ("OPENCV", RADIAL_TANGENTIAL)),
        "FULL_OPENCV": ("FULL_OPENCV", RADIAL_TANGENTIAL),
        **dict.fromkeys(FISHEYES, ("OPENCV_FISHEYE", FISHEYE)),
    }
    if lens.model not in models:
        return None
    model, names = models[lens.model]
    across, along = width / lens.width, height / lens.height
    keys: JsonObject = {"camera_model": model, "fl_x": fx * across, "fl_y": fy * along, "cx": cx * across}
    return {**keys, "cy": cy * along, "w": width, "h": height, **dict(zip(names, coefficients, strict=False))}


def _with_list(where: str, frame: JsonObject, shared: JsonObject) -> JsonObject:
    """The keys of a frame and its file, with nerfstudio's list of coefficients under their names."""
    levels = []
    for keys in (frame, shared):
        coefficients = keys.get("distortion_params")
        if coefficients is None:
            levels.append(keys)
            continue
        if not isinstance(coefficients, list) or len(coefficients) > len(DISTORTION_PARAMS):
            expected = f"a list of {', '.join(DISTORTION_PARAMS)}"
            raise ValueError(f"{where}: distortion_params: expected {expected}, got {short(coefficients)}")
        if any(keys.get(key) for key in RADIAL_TANGENTIAL):
            raise ValueError(f"{where}: distortion_params: expected them or k1, k2 and so on, got both")
        levels.append({**keys, **dict(zip(DISTORTION_PARAMS, coefficients, strict=False))})
    return merged(*levels)


def _distortion(where: str, keys: JsonObject) -> tuple[str, list[float]]:
    """The camera model of a frame, and its coefficients in the order of `Lens`.

    The model is the simplest one with the coefficients that are not 0. `k4` is the factor of r^8, as nerfstudio has it
    from Metashape and RealityCapture; beside k5 and k6, or in a FULL_OPENCV camera, it is OpenCV's, of a denominator.
    """
    flags = {
        "OPENCV_FISHEYE": bool(keys.get("is_fisheye")),
        PANORAMA: bool(keys.get("is_equirectangular") or keys.get("equirectangular")),
    }
    model = keys.get("camera_model", next((name for name, flag in flags.items() if flag), "OPENCV"))
    if model not in (*PERSPECTIVE, *flags):
        raise ValueError(
            f"{where}: camera_model: expected one of {', '.join(PERSPECTIVE)}, OPENCV_FISHEYE, EQUIRECTANGULAR, "
            f"got {short(model)}"
        )
    contrary = [name for name, flag in flags.items() if flag and name != model]
    if contrary:
        raise ValueError(f"{where}: camera_model, is_fisheye: expected one lens, got {model} and {contrary[0]}")
    known = {PANORAMA: (), "OPENCV_FISHEYE": FISHEYE}.get(model, RADIAL_TANGENTIAL)
    for key, value in keys.items():
        if key not in known and (key in RADIAL_TANGENTIAL or (key not in LENS_KEYS and OPTICAL.fullmatch(key))):
            if any(value) if isinstance(value, list) else value:
                raise ValueError(f"{where}: {key}: expected no such key of a {model} camera, got {short(value)}")
    coefficients = [number_of(where, keys, name) if name in keys else 0.0 for name in known]
    if known != RADIAL_TANGENTIAL:
        return model, coefficients
    if model == "FULL_OPENCV" or "k5" in keys or "k6" in keys:
        return ("FULL_OPENCV", coefficients) if any(coefficients) else ("PINHOLE", [])
    if coefficients[5]:
        return BROWN, coefficients[:6]
    if coefficients[4]:
        return "FULL_OPENCV", coefficients
    return ("OPENCV", coefficients[:4]) if any(coefficients) else ("PINHOLE", [])


def _check_rotation(where: str, key: str, rotation: np.ndarray, what: str) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not error <= ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ValueError(f"{where}: {key}: expected {what}, got a singular, sheared, scaled or mirroring one")


def frame_viewmat(where: str, frame: JsonObject, to_original: np.ndarray) -> np.ndarray:
    """Return the world-to-camera matrix (4, 4) float64, with OpenCV axes, of a frame's `transform_matrix`.

    That is camera to world with OpenGL axes in the file's world frame; `to_original` is of `inverse_applied`.
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
    """Invert `applied_transform` and `applied_scale`: (4, 4) float64 from the file's world frame to the original."""
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
