"""Scenes in JSON: nerfstudio's transforms.json and Blender's transforms_train/val/test.json.

Both hold camera-to-world matrices with OpenGL's camera axes (x right, y up, z backward). `applied_transform` and
`applied_scale` of a file map the original world frame to the file's; they are inverted for cameras and points.
"""

import dataclasses
import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from nexwarp.cameras.camera import ROTATION_TOLERANCE
from nexwarp.cameras.nerfstudio import intrinsics_of, list_of, matrix_of, merged, number_of
from nexwarp.data.capture import (
    Capture,
    Cloud,
    Photo,
    check_points,
    find_file,
    inside_folder,
    plain_name,
    report_missing,
    report_unused,
    safe_name,
    short,
)
from nexwarp.data.images import image_size, read_image
from nexwarp.data.lens import BROWN, PANORAMA, Lens
from nexwarp.data.ply import read_ply
from nexwarp.io.files import one_line
from nexwarp.io.json_files import Json, JsonObject, read_object

NERFSTUDIO_FILE = "transforms.json"
BLENDER_FILES = {split: f"transforms_{split}.json" for split in ("train", "test", "val")}
BLENDER_POINTS = "points3d.ply"
EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG")
WHITE = (1.0, 1.0, 1.0)
FILE_KEYS = {"frames", "test_frames", "applied_transform", "applied_scale", "ply_file_path"}
FILE_KEYS |= {"train_filenames", "val_filenames", "test_filenames"}
FRAME_KEYS = {"file_path", "transform_matrix", "mask_path", "depth_file_path"}
# Of other programs' own scaling and bookkeeping: without them the scene is the same.
HARMLESS = {"aabb", "aabb_scale", "scale", "offset", "up", "sharpness", "rotation", "colmap_im_id"}
AGREEMENT = 2.0  # ratio of colour errors from which points count as being in the original world
JUDGED_PHOTOS, JUDGED_POINTS = 5, 5000
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in the order of COLMAP's FULL_OPENCV
FISHEYE = ("k1", "k2", "k3", "k4")
FISHEYES = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
# Keys of lenses and shutters; what is not read of them would change the picture.
OPTICAL = re.compile(
    r"[kpsb]\d*|tau_?[xy\d]*|xi|skew|(radial|tangential|principal|focal|transform_matrix_)\w*"
    r"|\w*(distort|shutter|fisheye|ftheta|latlong|equirect|intrinsic|fov|lens_)\w*|lens_?(mode|model|type|params?)",
    re.IGNORECASE,
)
LENS_KEYS = {*RADIAL_TANGENTIAL, "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y"}
LENS_KEYS |= {"camera_model", "is_fisheye", "is_equirectangular", "equirectangular"}


@dataclass(frozen=True)
class _Frames:
    """The content of a JSON file."""

    file: Path
    data: JsonObject
    photos: list[Photo]  # that exist, sorted by name
    missing: list[str]  # names of the photos that do not exist
    to_original: np.ndarray  # (4, 4) float64 similarity from the file's world frame to the original one
    follow_links: bool  # whether files may lie behind links that leave the scene's folder


def read_nerfstudio(path: Path, images: str, follow_links: bool = False, skip_missing: bool = False) -> Capture:
    """Read `transforms.json` of the scene in `path`; `images` replaces "images" in the file."""
    frames = _read_frames(path / NERFSTUDIO_FILE, images, follow_links, skip_missing)
    report_unused(frames.file, path / images, frames.photos)
    return Capture.of(frames.file, _split(frames), _points(frames))


def read_blender(path: Path, images: str, follow_links: bool = False, skip_missing: bool = False) -> Capture:
    """Read transforms_train.json and transforms_test.json of a Blender scene; without the latter, transforms_val.json.

    Points are those of `ply_file_path`, or those of `points3d.ply` beside the JSON file if it exists.
    """
    train_file = path / BLENDER_FILES["train"]
    if not train_file.is_file():
        raise FileNotFoundError(f"{path}: expected {train_file.name} of a Blender scene, found none")
    train = _read_frames(train_file, images, follow_links, skip_missing)
    cloud = _points(train, BLENDER_POINTS)
    others = (path / BLENDER_FILES[part] for part in ("test", "val"))
    file = next((other for other in others if other.is_file()), None)
    photos = train.photos
    if file is not None:
        held_out = _read_frames(file, images, follow_links, skip_missing).photos
        again = {photo.name for photo in photos} & {photo.name for photo in held_out}
        if again:
            raise ValueError(f"{file}: {min(again)} is in {train_file.name} too, expected other photos to judge by")
        photos = [dataclasses.replace(photo, test=bool(photo.test)) for photo in photos]
        photos += [dataclasses.replace(photo, test=True) for photo in held_out]
    return Capture.of(train_file, photos, cloud, background=WHITE)


def _read_frames(file: Path, images: str, follow_links: bool, skip_missing: bool) -> _Frames:
    data = read_object(file, finite=True)
    entries = {f"frame {index}": entry for index, entry in enumerate(list_of(file, data, "frames"))}
    has_tests = data.get("test_frames") is not None  # of ScanNet++
    if has_tests:
        entries |= {f"test frame {index}": entry for index, entry in enumerate(list_of(file, data, "test_frames"))}
    _name_unread(file, data, entries.values())
    frames = _Frames(file, data, [], [], _inverse_applied(file, data), follow_links)
    for place, entry in entries.items():
        named = _file_name(f"{file}: {place}", "file_path", entry.get("file_path"), file.parent)
        where = f"{file}: {place} ({named})"
        photo_file = _find(where, file.parent, named, images)
        if photo_file is None:
            frames.missing.append(named)
            continue
        name = str(PurePosixPath(named).with_name(photo_file.name)).removeprefix("images/")
        folder = file.parent / images if PurePosixPath(named).is_relative_to("images") else file.parent
        inside_folder(f"{where}: file_path", photo_file, folder, follow_links)
        test = place.startswith("test") if has_tests else None
        mask, depth = (_named_file(where, frames, entry, key) for key in ("mask_path", "depth_file_path"))
        viewmat, lens = _frame_viewmat(where, entry, frames.to_original), _frame_lens(where, entry, data, photo_file)
        frames.photos.append(Photo(name, photo_file, viewmat, lens, test, mask, depth))
    report_missing(file, frames.missing, len(entries), skip_missing)
    if not any(photo.test for photo in frames.photos):  # all of `test_frames` are missing
        frames.photos[:] = [dataclasses.replace(photo, test=None) for photo in frames.photos]
    frames.photos.sort(key=lambda photo: photo.name)
    return frames


def _name_unread(file: Path, data: JsonObject, entries: Iterable[JsonObject]) -> None:
    """Warn of keys that have no meaning here."""
    unread = {key for key, value in data.items() if value is not None} - FILE_KEYS
    unread |= {key for entry in entries for key, value in entry.items() if value is not None} - FRAME_KEYS
    unread -= LENS_KEYS | HARMLESS
    unread = {key for key in unread if not OPTICAL.fullmatch(key)}  # refused where they say anything
    if unread:
        names = one_line(", ".join(sorted(unread)), 400)
        warnings.warn(f"{file}: keys that are not read: {names}", stacklevel=2)


def _named_file(where: str, frames: _Frames, entry: JsonObject, key: str) -> Path | None:
    """The file that a key names, in the scene's folder; None without the key."""
    if entry.get(key) is None:
        return None
    folder = frames.file.parent
    path = find_file(folder, _file_name(where, key, entry[key], folder))
    if not path.is_file():
        raise FileNotFoundError(f"{where}: {key}: file not found: {path}")
    return inside_folder(f"{where}: {key}", path, folder, frames.follow_links)


def _file_name(where: str, key: str, value: Json, folder: Path) -> str:
    """Check a path in the scene's folder and return it relative to that, with "/" as separator."""
    if not isinstance(value, str) or not value:
        raise ValueError(f"{where}: {key}: expected the name of a file, got {short(value)}")
    return safe_name(f"{where}: {key}:", value, "scene's folder", folder)


def _find(where: str, folder: Path, named: str, images: str) -> Path | None:
    """Find an image file, in the folder `images` and with an extension if the name has none; None if there is none."""
    if images != "images":
        if "/" in named and not named.startswith("images/"):
            raise ValueError(f"images: {where} is in no folder images, so {images!r} cannot stand in for it")
        named = f"{images}/{named.removeprefix('images/')}"
    # ScanNet++ names photos without their folder.
    names = [base + extension for base in (named, f"{images}/{named}") for extension in ("", *EXTENSIONS)]
    files = (find_file(folder, name) for name in names)
    return next((file for file in files if file.is_file()), None)


def _split(frames: _Frames) -> list[Photo]:
    """Return the photos in use, split by the file's lists of names if it has any."""

    def forms(name: str) -> set[str]:
        plain = plain_name(name.removeprefix("images/"))
        return {plain, str(PurePosixPath(plain).with_suffix(""))}

    names_of = {photo.name: forms(photo.name) for photo in frames.photos}
    known = set[str]().union(*names_of.values(), *map(forms, frames.missing))
    lists: dict[str, set[str]] = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = frames.data.get(key)
        if names is None:
            continue
        if not isinstance(names, list):
            raise ValueError(f"{frames.file}: {key}: expected a list of file names, got {short(names)}")
        paths = (_file_name(str(frames.file), key, name, frames.file.parent) for name in names)
        lists[key] = {plain_name(path.removeprefix("images/")) for path in paths}
        unknown = sorted(lists[key] - known)
        if unknown:
            raise ValueError(f"{frames.file}: {key}: expected photos of the frames, got {unknown[0]}")
    if not lists:
        return frames.photos
    held_out = lists.get("test_filenames") or lists.get("val_filenames") or set()
    tests = {photo.name for photo in frames.photos if photo.test or names_of[photo.name] & held_out}
    train = {name for name, forms in names_of.items() if forms & lists.get("train_filenames", forms)}
    if train & tests and "train_filenames" in lists:
        both = f"{len(train & tests)} photos are listed for training and testing; they are used for testing only"
        warnings.warn(f"{frames.file}: {both}", stacklevel=2)
    if not train - tests:
        raise ValueError(
            f"{frames.file}: train_filenames: expected at least one photo that is not for testing, got none"
        )
    used = (photo for photo in frames.photos if photo.name in train | tests)
    return [dataclasses.replace(photo, test=photo.name in tests) for photo in used]


def _points(frames: _Frames, beside: str | None = None) -> Cloud | None:
    """Read the points that the file names, or those of the file `beside` it if it exists, in the original world."""
    folder = frames.file.parent
    path = _named_file(str(frames.file), frames, frames.data, "ply_file_path")
    if path is None and beside is not None and (folder / beside).is_file():
        path = inside_folder(f"{frames.file}: points", folder / beside, folder, frames.follow_links)
    if path is None:
        return None
    cloud = read_ply(path)
    moved = cloud.positions @ frames.to_original[:3, :3].T + frames.to_original[:3, 3]
    check_points(path, moved, "points in the original world", lambda index: f"vertex {index}")
    # Some releases of nerfstudio transformed only the cameras and left the points in the original world.
    if not np.allclose(frames.to_original, np.eye(4)):
        error_moved, error_unmoved = (_color_error(x, cloud.colors, frames.photos) for x in (moved, cloud.positions))
        if error_moved > AGREEMENT * error_unmoved:
            warnings.warn(
                f"{path}: its points fit the photos only without applied_transform; left as they are", stacklevel=2
            )
            return cloud
    return dataclasses.replace(cloud, positions=moved)


def _color_error(points: np.ndarray, colors: np.ndarray, photos: list[Photo]) -> float:
    """Median difference, of 255, between colours of points and of the pixels that they project to in some photos."""
    sample = np.linspace(0, len(points) - 1, min(len(points), JUDGED_POINTS)).astype(int)
    errors = [np.zeros((0, 3))]
    for photo in photos[:: -(-len(photos) // JUDGED_PHOTOS)]:
        image, places = read_image(photo.file).numpy(), photo.project(points[sample])
        shown = np.isfinite(places).all(axis=1)
        column, row = (places[shown] * image.shape[1::-1]).astype(int).T
        errors.append(np.abs(image[row, column].astype(float) - colors[sample][shown]))
    error = np.concatenate(errors)
    return float(np.median(error)) if len(error) else 255.0


# The camera of a frame


def _frame_lens(where: str, frame: JsonObject, shared: JsonObject, file: Path) -> Lens:
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
    model, coefficients = _distortion(where, keys)
    params: tuple[float, ...] = (width, height)
    if model != PANORAMA:
        params = (*intrinsics_of(where, frame, shared, width, height), *coefficients)
    try:
        return Lens(model, params, width, height)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def lens_keys(lens: Lens, width: int, height: int) -> JsonObject | None:
    """Return the keys from which `_frame_lens` reads a lens, at a photo's size in pixels; None if there are none."""
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


def _frame_viewmat(where: str, frame: JsonObject, to_original: np.ndarray) -> np.ndarray:
    """Return the world-to-camera matrix (4, 4) float64, with OpenCV axes, of a frame's `transform_matrix`.

    That is camera to world with OpenGL axes in the file's world frame; `to_original` is of `_inverse_applied`.
    """
    pose = matrix_of(where, frame, "transform_matrix").numpy()
    _check_rotation(where, "transform_matrix", pose[:3, :3], "a rotation and a position")
    linear = to_original[:3, :3]
    rotation = linear / np.cbrt(np.linalg.det(linear)) @ pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ (linear @ pose[:3, 3] + to_original[:3, 3])
    return viewmat


def _inverse_applied(file: Path, data: JsonObject) -> np.ndarray:
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
