"""Scenes in JSON: nerfstudio's transforms.json and Blender's transforms_train/val/test.json.

Both hold camera-to-world matrices with OpenGL's camera axes (x right, y up, z backward). `applied_transform` and
`applied_scale` of a file map the original world frame to the file's; they are inverted for cameras and points.
"""

import dataclasses
import warnings
from pathlib import Path, PurePosixPath

import numpy as np

from nexwarp.cameras.camera import MAX_CAMERAS
from nexwarp.data.capture import (
    Capture,
    Cloud,
    Photo,
    check_points,
    distinct_photos,
    inside_folder,
    report_missing,
    safe_name,
    short,
)
from nexwarp.data.frame_camera import frame_lens, frame_viewmat, inverse_applied
from nexwarp.data.images import read_image
from nexwarp.data.ply import read_ply
from nexwarp.io.json_files import Json, JsonObject, read_object

NERFSTUDIO_FILE = "transforms.json"
BLENDER_FILES = {split: f"transforms_{split}.json" for split in ("train", "test", "val")}
BLENDER_POINTS = "points3d.ply"
EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG")
WHITE = (1.0, 1.0, 1.0)
AGREEMENT = 2.0  # ratio of colour errors from which points count as being in the original world
JUDGED_PHOTOS, JUDGED_POINTS = 5, 5000


def read_nerfstudio(path: Path, images: str, follow_links: bool = False, skip_missing: bool = False) -> Capture:
    """Read `transforms.json` of a scene.

    Args:
        path: folder of the scene.
        images: folder of the photos that replaces "images" in the file.
        follow_links: see `load_scene`.
        skip_missing: see `load_scene`.

    Raises:
        FileNotFoundError: a photo, a mask or the points that the file names do not exist.
        ValueError: the file has invalid content; the message names the place.
    """
    file = path / NERFSTUDIO_FILE
    data, missing = _read_data(file, images, skip_missing)
    frames = _frames(file, data, images, follow_links)
    cloud = _points(file, data, frames, follow_links)
    photos, test = _split(file, data, _sorted(file, data, frames, cloud), missing)
    return Capture(file, photos, cloud, test)


def read_blender(path: Path, images: str, follow_links: bool = False, skip_missing: bool = False) -> Capture:
    """Read transforms_train.json and transforms_test.json of a Blender scene; without the latter, transforms_val.json.

    Points are those of `ply_file_path`, or those of `points3d.ply` beside the JSON file if it exists.

    Args:
        path: folder of the scene.
        images: folder of the photos that replaces "images" in the files.
        follow_links: see `load_scene`.
        skip_missing: see `load_scene`.

    Raises:
        FileNotFoundError: transforms_train.json or a photo that a file names does not exist.
        ValueError: a file has invalid content; the message names the place.
    """
    train = path / BLENDER_FILES["train"]
    if not train.is_file():
        raise FileNotFoundError(f"{path}: expected {train.name} of a Blender scene, found none")
    data, _ = _read_data(train, images, skip_missing)
    frames = _frames(train, data, images, follow_links)
    cloud = _points(train, data, frames, follow_links, BLENDER_POINTS)
    photos = _sorted(train, data, frames, cloud)
    for split in ("test", "val"):
        other = path / BLENDER_FILES[split]
        if other.is_file():
            other_data, _ = _read_data(other, images, skip_missing)
            held_out = _frames(other, other_data, images, follow_links)
            names = {photo.name for photo in photos}
            again = [photo.name for photo in held_out if photo.name in names]
            if again:
                raise ValueError(f"{other}: {again[0]} is in {train.name} too, expected other photos to judge by")
            merged = sorted(photos + held_out, key=lambda photo: photo.name)
            test = frozenset(photo.name for photo in held_out)
            return Capture(train, merged, cloud, test, WHITE)
    return Capture(train, photos, cloud, None, WHITE)


def _read_data(file: Path, images: str, skip_missing: bool) -> tuple[JsonObject, tuple[str, ...]]:
    """Return the file's content with those frames only whose photos exist, and the names of the missing photos."""
    data = read_object(file, finite=True)
    frames: list[Json] = []
    missing: list[str] = []
    found: set[str] = set()
    for index, frame in enumerate(_frame_list(file, data)):
        where = f"{file}: frame {index}"
        if not isinstance(frame, dict):
            raise ValueError(f"{where}: expected a JSON object, got {short(frame)}")
        named = _file_name(where, "file_path", frame.get("file_path"))
        if _find(f"{where} ({named})", file.parent, named, images) is None:
            missing.append(named)
        elif named in found:  # before the other frames are looked at, which are many in a file that repeats one
            raise ValueError(f"{file}: expected each photo once, got {_view_name(named)} twice")
        else:
            frames.append(frame)
            found.add(named)
    report_missing(file, missing, len(missing) + len(frames), skip_missing)
    return {**data, "frames": frames}, tuple(missing)


def _frame_list(file: Path, data: JsonObject) -> list[Json]:
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{file}: frames: expected a list of at least one frame, got {short(frames)}")
    if len(frames) > MAX_CAMERAS:
        raise ValueError(f"{file}: frames: expected at most {MAX_CAMERAS:,} frames, got {len(frames):,}")
    return frames


def _frames(file: Path, data: JsonObject, images: str, follow_links: bool) -> list[Photo]:
    """The photos in the order of the file."""
    to_original = inverse_applied(file, data)
    frames: Json = data["frames"]
    assert isinstance(frames, list)  # as `_read_data` returns it

    def photo(index: int, frame: Json) -> Photo:
        assert isinstance(frame, dict)
        return _photo(f"{file}: frame {index}", file.parent, data, frame, images, to_original, follow_links)

    return distinct_photos(file, (photo(index, frame) for index, frame in enumerate(frames)))


def _photo(
    where: str,
    folder: Path,
    data: JsonObject,
    frame: JsonObject,
    images: str,
    to_original: np.ndarray,
    follow_links: bool,
) -> Photo:
    named = _file_name(where, "file_path", frame.get("file_path"))
    where = f"{where} ({named})"
    file = _find(where, folder, named, images)
    assert file is not None  # `_read_data` keeps no other frames
    inside = folder / images if PurePosixPath(named).is_relative_to("images") else folder
    inside_folder(f"{where}: file_path", file, inside, follow_links)
    name = _view_name(str(PurePosixPath(named).with_name(file.name)))
    mask = None
    if frame.get("mask_path") is not None:
        mask = folder / _file_name(where, "mask_path", frame["mask_path"])
        if not mask.is_file():
            raise FileNotFoundError(f"{where}: mask not found: {mask}")
        inside_folder(f"{where}: mask_path", mask, folder, follow_links)
    lens = frame_lens(where, {**data, **frame}, file)
    return Photo(name, file, frame_viewmat(where, frame.get("transform_matrix"), to_original), lens, mask)


def _file_name(where: str, key: str, value: Json) -> str:
    """Check a path relative to the scene's folder and return it with "/" as separator."""
    if not isinstance(value, str) or not value:
        raise ValueError(f"{where}: {key}: expected the name of a file, got {short(value)}")
    return safe_name(f"{where}: {key}:", value.replace("\\", "/"), "scene's folder")


def _view_name(named: str) -> str:
    return named[7:] if named.startswith("images/") else named


def _find(where: str, folder: Path, named: str, images: str) -> Path | None:
    """Find an image file, in the folder `images` and with an extension if the name has none; None if there is none."""
    if images != "images":
        if not named.startswith("images/"):
            raise ValueError(f"images: {where} is in no folder images, so {images!r} cannot stand in for it")
        named = f"{images}/{named[7:]}"
    path = folder / named
    if path.is_file():
        return path
    candidates = (path.with_name(path.name + extension) for extension in EXTENSIONS)
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _split(
    file: Path, data: JsonObject, photos: list[Photo], absent: tuple[str, ...]
) -> tuple[list[Photo], frozenset[str] | None]:
    """Return the photos in use and the names of the test photos; None if the file has no split."""
    lists: dict[str, set[str]] = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = data.get(key)
        if names is None:
            continue
        if not isinstance(names, list):
            raise ValueError(f"{file}: {key}: expected a list of file names, got {short(names)}")
        lists[key] = {_view_name(_file_name(str(file), key, name)) for name in names}
        known = {photo.name for photo in photos} | {_view_name(name) for name in absent}
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


def _points(
    file: Path, data: JsonObject, frames: list[Photo], follow_links: bool, beside: str | None = None
) -> Cloud | None:
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
    cloud = read_ply(inside_folder(f"{file}: {key}", path, file.parent, follow_links))
    to_original = inverse_applied(file, data)
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
