"""COLMAP models, read through pycolmap into plain numpy arrays; nothing of pycolmap leaves this file."""

from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from nexwarp.data.colmap_files import check_binary_model

PARTS = ("cameras", "images", "points3D")
FORMATS = ("bin", "txt")
# What pycolmap 4.2 raises on damaged files: for a missing rig IndexError, for absurd counts MemoryError.
READ_ERRORS = (RuntimeError, ValueError, IndexError, KeyError, OSError, MemoryError, OverflowError)


@dataclass(frozen=True)
class Photo:
    """One registered image of a model; the pixels are elsewhere.

    Attributes:
        name: path of the image below the images folder, as COLMAP wrote it ("/" between its parts).
        viewmat: (4, 4) float64, world to camera, OpenCV axes.
        K: (3, 3) float64, intrinsics in pixels of a width x height image, pixel centres at +0.5.
        width: width of the COLMAP camera in pixels.
        height: height of the COLMAP camera in pixels.
    """

    name: str
    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int


@dataclass(frozen=True)
class ColmapModel:
    """A sparse reconstruction.

    Attributes:
        folder: where the model's files lie.
        photos: the registered images, sorted by name.
        points: (P, 3) float64 positions in the world frame, by ascending COLMAP id.
        colors: (P, 3) uint8 sRGB.
        track_lengths: (P,) int32, how many images see a point.
        reprojection_errors: (P,) float32, mean over the track, in pixels of the COLMAP cameras; -1 when
            unknown.
    """

    folder: Path
    photos: list[Photo]
    points: np.ndarray
    colors: np.ndarray
    track_lengths: np.ndarray
    reprojection_errors: np.ndarray


def pycolmap_module() -> Any:
    """Import pycolmap, late (it costs start-up time) and after numpy and PIL.

    Version 4.2.1 corrupts the heap now and then when it is imported before them.
    """
    import PIL.Image  # noqa: F401
    import pycolmap

    return pycolmap


def find_model(path: Path) -> tuple[Path, str]:
    """Return the folder of a scene's COLMAP model and its format, "bin" (preferred) or "txt".

    Looks in sparse/0, in sparse and in `path` itself, in this order.

    Raises:
        FileNotFoundError: there is no complete model; of a partial one, the message says what lacks.
    """
    partial = None
    for folder in (path / "sparse" / "0", path / "sparse", path):
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


def read_model(path: Path) -> ColmapModel:
    """Read the COLMAP model of the scene at `path`.

    Raises:
        FileNotFoundError: there is no model.
        ValueError: the model is damaged, has no registered image, a camera that is no pinhole, an image name
            that leaves the images folder, no points, or points that are not finite.
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
    images = [reconstruction.image(index) for index in reconstruction.reg_image_ids()]
    if not images:
        raise ValueError(f"{folder}: the COLMAP model has no registered images")
    photos = sorted((_photo(image, folder) for image in images), key=lambda photo: photo.name)
    return ColmapModel(folder, photos, *_points(reconstruction, folder))


def _check_cameras_size(path: Path, cameras: Any) -> None:
    """Raise when cameras.bin ends early: pycolmap says nothing and leaves the last parameters unset."""
    expected = 8 + sum(24 + 8 * len(camera.params) for camera in cameras)
    if path.stat().st_size < expected:
        raise ValueError(f"{path}: truncated, expected {expected} bytes, got {path.stat().st_size}")


def _photo(image: Any, folder: Path) -> Photo:
    name, camera = image.name, image.camera
    if not name or any(".." in path.parts or path.anchor for path in (PurePosixPath(name), PureWindowsPath(name))):
        raise ValueError(f"{folder}: image name {name!r} leaves the images folder, expected a relative path below it")
    model = camera.model.name
    if model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise ValueError(
            f"{folder}: camera model {model} of {name} is not supported, expected PINHOLE or SIMPLE_PINHOLE: "
            "undistort the images with `colmap image_undistorter` or pycolmap.undistort_images first"
        )
    viewmat = np.eye(4)
    viewmat[:3] = image.cam_from_world().matrix()
    return Photo(name, viewmat, np.array(camera.calibration_matrix()), int(camera.width), int(camera.height))


def _points(reconstruction: Any, folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Positions, colours, track lengths and errors, by id so that binary and text models load alike."""
    points = sorted(reconstruction.points3D.items())
    if not points:
        raise ValueError(f"{folder}: the COLMAP model has no 3D points, expected at least one")
    positions = np.array([point.xyz for _, point in points], dtype=np.float64)
    bad = ~np.isfinite(positions).all(axis=1)
    if bad.any():
        index = int(np.flatnonzero(bad)[0])
        where = tuple(positions[index].tolist())
        raise ValueError(f"{folder}: expected finite 3D points, got {where} (point id {points[index][0]})")
    return (
        positions,
        np.array([point.color for _, point in points], dtype=np.uint8),
        np.array([point.track.length() for _, point in points], dtype=np.int32),
        np.array([point.error for _, point in points], dtype=np.float32),
    )
