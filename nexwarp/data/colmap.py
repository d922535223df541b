"""COLMAP models, read through pycolmap into plain numpy arrays; nothing of pycolmap leaves this file."""

from pathlib import Path
from typing import Any

import numpy as np

from nexwarp.data.capture import Capture, Cloud, Photo, leaves_folder
from nexwarp.data.colmap_files import check_binary_model
from nexwarp.data.lens import Lens, pycolmap_module

PARTS = ("cameras", "images", "points3D")
FORMATS = ("bin", "txt")
FOLDERS = ("sparse/0", "sparse", ".")
# What pycolmap 4.2 raises on damaged files: for a missing rig IndexError, for absurd counts MemoryError.
READ_ERRORS = (RuntimeError, ValueError, IndexError, KeyError, OSError, MemoryError, OverflowError)


def has_model(path: Path) -> bool:
    """Whether a COLMAP model, or a part of one, lies where `find_model` looks."""
    return any((path / folder / f"{part}.{end}").is_file() for folder in FOLDERS for part in PARTS for end in FORMATS)


def find_model(path: Path) -> tuple[Path, str]:
    """Return the folder of a scene's COLMAP model and its format, "bin" (preferred) or "txt".

    Looks in sparse/0, in sparse and in `path` itself, in this order.

    Raises:
        FileNotFoundError: there is no complete model; of a partial one, the message says what lacks.
    """
    partial = None
    for folder in (path / name for name in FOLDERS):
        for suffix in FORMATS:
            missing = [f"{part}.{suffix}" for part in PARTS if not (folder / f"{part}.{suffix}").is_file()]
            if not missing:
                return folder, suffix
            if len(missing) < len(PARTS) and partial is None:
                partial = f"{path}: incomplete COLMAP model in {folder}: {' and '.join(missing)} not found"
    raise FileNotFoundError(
        partial
        or f"{path}: no COLMAP model found, expected cameras, images and points3D (.bin or .txt) "
        "in sparse/0, in sparse or in the folder itself"
    )


def read_model(path: Path, images: Path) -> Capture:
    """Read the COLMAP model of the scene at `path`, whose photos lie in `images`.

    Raises:
        FileNotFoundError: there is no model.
        ValueError: the model is damaged, has no registered image, a camera that is not usable, an image name that
            leaves the images folder, or points that are not finite.
    """
    folder, suffix = find_model(path)
    if suffix == "bin":
        check_binary_model(folder)
    reconstruction = pycolmap_module().Reconstruction()
    read = reconstruction.read_binary if suffix == "bin" else reconstruction.read_text
    try:
        read(str(folder))
    except READ_ERRORS as error:
        detail = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{folder}: not a readable COLMAP model ({suffix}), damaged or truncated: {detail}") from error
    if suffix == "bin":
        _check_cameras_size(folder / "cameras.bin", reconstruction.cameras.values())
    registered = [reconstruction.image(index) for index in reconstruction.reg_image_ids()]
    if not registered:
        raise ValueError(f"{folder}: the COLMAP model has no registered images")
    cloud, seen = _points(reconstruction, folder), _seen(reconstruction)
    photos = [_photo(image, folder, images, seen.get(image.image_id, {})) for image in registered]
    return Capture(folder, sorted(photos, key=lambda photo: photo.name), cloud)


def _check_cameras_size(path: Path, cameras: Any) -> None:
    """Raise when cameras.bin ends early: pycolmap says nothing and leaves the last parameters unset."""
    expected = 8 + sum(24 + 8 * len(camera.params) for camera in cameras)
    if path.stat().st_size < expected:
        raise ValueError(f"{path}: truncated, expected {expected} bytes, got {path.stat().st_size}")


def _photo(image: Any, folder: Path, images: Path, seen: dict[int, np.ndarray]) -> Photo:
    try:
        name, camera = image.name, image.camera
    except UnicodeDecodeError as error:
        raise ValueError(f"{folder}: expected image names in UTF-8, got {error.object[:60]!r}") from None
    if leaves_folder(name):
        raise ValueError(f"{folder}: image name {name!r} leaves the images folder, expected a relative path below it")
    viewmat = np.eye(4)
    viewmat[:3] = image.cam_from_world().matrix()
    try:
        lens = Lens(camera.model.name, tuple(map(float, camera.params)), int(camera.width), int(camera.height))
    except ValueError as error:
        raise ValueError(f"{folder}: {name}: the COLMAP camera of this image is not usable: {error}") from error
    points = np.array(list(seen.values()), dtype=np.float32).reshape(-1, 3)
    return Photo(name, images / name, viewmat, lens, points=points)


def _seen(reconstruction: Any) -> dict[int, dict[int, np.ndarray]]:
    """Image id -> id -> position of the points that were triangulated from it, by ascending id."""
    seen: dict[int, dict[int, np.ndarray]] = {}
    for index, point in sorted(reconstruction.points3D.items()):
        for element in point.track.elements:
            seen.setdefault(element.image_id, {})[index] = point.xyz
    return seen


def _points(reconstruction: Any, folder: Path) -> Cloud | None:
    """The model's points by id, so that binary and text models load alike."""
    points = sorted(reconstruction.points3D.items())
    if not points:
        return None
    positions = np.array([point.xyz for _, point in points], dtype=np.float64)
    bad = ~np.isfinite(positions).all(axis=1)
    if bad.any():
        index = int(np.flatnonzero(bad)[0])
        where = tuple(positions[index].tolist())
        raise ValueError(f"{folder}: expected finite 3D points, got {where} (point id {points[index][0]})")
    return Cloud(
        positions,
        np.array([point.color for _, point in points], dtype=np.uint8),
        np.array([point.track.length() for _, point in points], dtype=np.int32),
        np.array([point.error for _, point in points], dtype=np.float32),
    )
