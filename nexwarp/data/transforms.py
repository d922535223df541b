"""Scenes in JSON: nerfstudio's transforms.json and Blender's transforms_train/val/test.json.

Both hold camera-to-world matrices with OpenGL's camera axes (x right, y up, z backward). `applied_transform` and
`applied_scale` of a file map the original world frame to the file's; they are inverted for cameras and points.
"""

import dataclasses
import math
import re
import warnings
from pathlib import Path, PurePosixPath

import numpy as np

from nexwarp.data.capture import (
    LARGEST_COORDINATE,
    Capture,
    Cloud,
    Photo,
    check_points,
    check_unique,
    inside_folder,
    safe_name,
    short,
)
from nexwarp.data.images import image_size, read_image
from nexwarp.data.lens import PANORAMA, Lens
from nexwarp.data.ply import read_ply
from nexwarp.io.json_files import Json, JsonObject, read_object

NERFSTUDIO_FILE = "transforms.json"
BLENDER_FILES = {split: f"transforms_{split}.json" for split in ("train", "test", "val")}
BLENDER_POINTS = "points3d.ply"
EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG")
ROTATION_TOLERANCE = 1e-3  # that of Camera
WHITE = (1.0, 1.0, 1.0)
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in the order of COLMAP's FULL_OPENCV
FISHEYE = ("k1", "k2", "k3", "k4")
AGREEMENT = 2.0  # ratio of colour errors from which points count as being in the original world
JUDGED_PHOTOS, JUDGED_POINTS = 5, 5000


def read_nerfstudio(path: Path, images: str) -> Capture:
    """Read `transforms.json` of a scene.

    Args:
        path: folder of the scene.
        images: folder of the photos that replaces "images" in the file.

    Raises:
        FileNotFoundError: a photo, a mask or the points that the file names do not exist.
        ValueError: the file has invalid content; the message names the place.
    """
    file = path / NERFSTUDIO_FILE
    data = _read_data(file)
    frames = _frames(file, data, images)
    cloud = _points(file, data, frames)
    photos, test = _split(file, data, _sorted(file, data, frames, cloud))
    return Capture(file, photos, cloud, test)


def read_blender(path: Path, images: str) -> Capture:
    """Read transforms_train.json and transforms_test.json of a Blender scene; without the latter, transforms_val.json.

    Points are those of `ply_file_path`, or those of `points3d.ply` beside the JSON file if it exists.

    Args:
        path: folder of the scene.
        images: folder of the photos that replaces "images" in the files.

    Raises:
        FileNotFoundError: transforms_train.json or a photo that a file names does not exist.
        ValueError: a file has invalid content; the message names the place.
    """
    train = path / BLENDER_FILES["train"]
    if not train.is_file():
        raise FileNotFoundError(f"{path}: expected {train.name} of a Blender scene, found none")
    data = _read_data(train)
    frames = _frames(train, data, images)
    cloud = _points(train, data, frames, BLENDER_POINTS)
    photos = _sorted(train, data, frames, cloud)
    for split in ("test", "val"):
        other = path / BLENDER_FILES[split]
        if other.is_file():
            held_out = _frames(other, _read_data(other), images)
            names = {photo.name for photo in photos}
            again = [photo.name for photo in held_out if photo.name in names]
            if again:
                raise ValueError(f"{other}: {again[0]} is in {train.name} too, expected other photos to judge by")
            merged = sorted(photos + held_out, key=lambda photo: photo.name)
            return Capture(train, merged, cloud, frozenset(photo.name for photo in held_out), WHITE)
    return Capture(train, photos, cloud, None, WHITE)


def _read_data(file: Path) -> JsonObject:
    data = read_object(file, finite=True)
    _frame_list(file, data)
    return data


def _frame_list(file: Path, data: JsonObject) -> list[Json]:
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{file}: frames: expected a list of at least one frame, got {short(frames)}")
    return frames


def _frames(file: Path, data: JsonObject, images: str) -> list[Photo]:
    """The photos in the order of the file."""
    to_original = _inverse_applied(file, data)
    photos = []
    for index, frame in enumerate(_frame_list(file, data)):
        where = f"{file}: frame {index}"
        if not isinstance(frame, dict):
            raise ValueError(f"{where}: expected a JSON object, got {short(frame)}")
        photos.append(_photo(where, file.parent, data, frame, images, to_original))
    check_unique(file, photos)
    return photos


def _photo(
    where: str, folder: Path, data: JsonObject, frame: JsonObject, images: str, to_original: np.ndarray
) -> Photo:
    named = _file_name(where, "file_path", frame.get("file_path"))
    where = f"{where} ({named})"
    file = _find(where, folder, named, images)
    name = _view_name(str(PurePosixPath(named).with_name(file.name)))
    mask = None
    if frame.get("mask_path") is not None:
        mask = folder / _file_name(where, "mask_path", frame["mask_path"])
        if not mask.is_file():
            raise FileNotFoundError(f"{where}: mask not found: {mask}")
        inside_folder(f"{where}: mask_path", mask, folder)
    lens = _lens(where, {**data, **frame}, file)
    return Photo(name, file, _viewmat(where, frame.get("transform_matrix"), to_original), lens, mask)


def _file_name(where: str, key: str, value: Json) -> str:
    """Check a path relative to the scene's folder and return it with "/" as separator."""
    if not isinstance(value, str) or not value:
        raise ValueError(f"{where}: {key}: expected the name of a file, got {short(value)}")
    return safe_name(f"{where}: {key}:", value.replace("\\", "/"), "scene's folder")


def _view_name(named: str) -> str:
    return named[7:] if named.startswith("images/") else named


def _find(where: str, folder: Path, named: str, images: str) -> Path:
    """Find an image file, in the folder `images` and with an extension if the name has none."""
    if images != "images":
        if not named.startswith("images/"):
            raise ValueError(f"images: {where} is in no folder images, so {images!r} cannot stand in for it")
        named = f"{images}/{named[7:]}"
    path = folder / named
    top = folder / images if PurePosixPath(named).is_relative_to(images) else folder
    candidates = [path, *(path.with_name(path.name + extension) for extension in EXTENSIONS)]
    for candidate in candidates:
        if candidate.is_file():
            return inside_folder(f"{where}: file_path", candidate, top)
    raise FileNotFoundError(f"{where}: image not found: {path}")


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


def _lens(where: str, keys: JsonObject, file: Path) -> Lens:
    """The lens of a frame; `keys` are those of the file, replaced by those of the frame."""
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


def _viewmat(where: str, value: Json, to_original: np.ndarray) -> np.ndarray:
    """Convert an OpenGL camera-to-world matrix to a world-to-camera matrix with OpenCV axes, (4, 4) float64."""
    pose = _matrix(where, "transform_matrix", value)
    _check_rotation(where, "transform_matrix", pose[:3, :3], "a rotation and a position")
    linear = to_original[:3, :3]
    rotation = linear / np.cbrt(np.linalg.det(linear)) @ pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ (linear @ pose[:3, 3] + to_original[:3, 3])
    return viewmat


def _inverse_applied(file: Path, data: JsonObject) -> np.ndarray:
    """(4, 4) similarity from the file's world frame to the original one."""
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


def _split(file: Path, data: JsonObject, photos: list[Photo]) -> tuple[list[Photo], frozenset[str] | None]:
    """Return the photos in use and the names of the test photos; None if the file has no split."""
    lists: dict[str, set[str]] = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = data.get(key)
        if names is None:
            continue
        if not isinstance(names, list):
            raise ValueError(f"{file}: {key}: expected a list of file names, got {short(names)}")
        lists[key] = {_view_name(_file_name(str(file), key, name)) for name in names}
        known = {photo.name for photo in photos}
        known |= {str(PurePosixPath(name).with_suffix("")) for name in known}
        missing = sorted(lists[key] - known)
        if missing:
            raise ValueError(f"{file}: {key}: expected photos of the frames, got {missing[0]}")
    if not lists:
        return photos, None

    def listed(photo: Photo, names: set[str]) -> bool:
        return photo.name in names or str(PurePosixPath(photo.name).with_suffix("")) in names

    held_out = lists.get("test_filenames") or lists.get("val_filenames") or set()
    test = [photo for photo in photos if listed(photo, held_out)]
    candidates = [
        photo for photo in photos if "train_filenames" not in lists or listed(photo, lists["train_filenames"])
    ]
    both = [photo for photo in candidates if listed(photo, held_out)]
    if both and "train_filenames" in lists:
        warnings.warn(
            f"{file}: {len(both)} photos are listed for training and testing; they are used for testing only",
            stacklevel=2,
        )
    train = [photo for photo in candidates if not listed(photo, held_out)]
    if not train:
        raise ValueError(f"{file}: train_filenames: expected at least one photo that is not for testing, got none")
    return sorted(train + test, key=lambda photo: photo.name), frozenset(photo.name for photo in test)


def _points(file: Path, data: JsonObject, frames: list[Photo], beside: str | None = None) -> Cloud | None:
    """Read the points that the file names, or those of the file `beside` it if it exists, in the original world."""
    key = "ply_file_path"
    if data.get(key) is not None:
        path = file.parent / _file_name(str(file), key, data[key])
        if not path.is_file():
            raise FileNotFoundError(f"{file}: {key}: points not found: {path}")
    elif beside is not None and (file.parent / beside).is_file():
        key, path = "points", file.parent / beside
    else:
        return None
    cloud = read_ply(inside_folder(f"{file}: {key}", path, file.parent))
    to_original = _inverse_applied(file, data)
    moved = cloud.positions @ to_original[:3, :3].T + to_original[:3, 3]
    check_points(path, moved, "points in the original world", lambda index: f"vertex {index}")
    # Some releases of nerfstudio transformed only the cameras and left the points in the original world.
    if not np.allclose(to_original, np.eye(4)):
        error_moved, error_unmoved = (_color_error(x, cloud.colors, frames) for x in (moved, cloud.positions))
        if error_moved > AGREEMENT * error_unmoved:
            warnings.warn(
                f"{path}: its points fit the photos only without applied_transform; left as they are", stacklevel=2
            )
            moved = cloud.positions
    return dataclasses.replace(cloud, positions=moved)


def _sorted(file: Path, data: JsonObject, frames: list[Photo], cloud: Cloud | None) -> list[Photo]:
    """Sort the photos by name, after adding the observed points to those with a `colmap_im_id`."""
    if cloud is not None and cloud.observations is not None:
        image, point = cloud.observations.T
        positions = cloud.positions.astype(np.float32)
        for index, (photo, frame) in enumerate(zip(frames, _frame_list(file, data), strict=True)):
            number = frame.get("colmap_im_id") if isinstance(frame, dict) else None
            if number is None:
                continue
            if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < 2**32:
                raise ValueError(f"{file}: frame {index}: colmap_im_id: expected an image's id, got {short(number)}")
            first, last = np.searchsorted(image, [number, number + 1])
            frames[index] = dataclasses.replace(photo, points=positions[point[first:last]])
    return sorted(frames, key=lambda photo: photo.name)


def _color_error(points: np.ndarray, colors: np.ndarray, photos: list[Photo]) -> float:
    """Median difference, of 255, between colours of points and of the pixels that they project to in some photos."""
    sample = np.linspace(0, len(points) - 1, min(len(points), JUDGED_POINTS)).astype(int)
    errors = [np.zeros((0, 3))]
    for photo in photos[:: -(-len(photos) // JUDGED_PHOTOS)]:
        image = read_image(photo.file).numpy()
        rotation, shift = photo.viewmat[:3, :3], photo.viewmat[:3, 3]
        pixels = photo.lens.project(points[sample] @ rotation.T + shift) / [photo.lens.width, photo.lens.height]
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels < 1)).all(axis=1)
        column, row = (pixels[inside] * image.shape[1::-1]).astype(int).T
        errors.append(np.abs(image[row, column].astype(float) - colors[sample][inside]))
    error = np.concatenate(errors)
    return float(np.median(error)) if len(error) else 255.0
