"""COLMAP models: search for their files, and conversion of their records to photos and points."""

import dataclasses
import warnings
from pathlib import Path

import numpy as np

from nexwarp.data.capture import (
    LARGEST_COORDINATE,
    Capture,
    Cloud,
    Photo,
    check_points,
    distinct_photos,
    find_file,
    inside_folder,
    safe_name,
)
from nexwarp.data.colmap_files import (
    CameraRecord,
    ImageRecord,
    PointRecords,
    Records,
    count_images,
    read_records,
)
from nexwarp.data.lens import Lens
from nexwarp.data.ply import read_ply

PARTS = ("cameras", "images", "points3D")
FORMATS = ("bin", "txt")
POINTS_PLY = "points3D.ply"  # of MASt3R's and DUSt3R's exporters, and of 3DGS


def _folders(path: Path) -> list[Path]:
    """Folders that a scene's models lie in: sparse/0, sparse/1 and so on, sparse and the scene's folder itself."""
    numbered = [folder for folder in (path / "sparse").glob("*") if folder.name.isdecimal()]
    return [*sorted(numbered, key=lambda folder: int(folder.name)), path / "sparse", path]


def has_model(path: Path) -> bool:
    """Whether a file of a COLMAP model exists in a folder that `find_model` searches."""
    return any((folder / f"{part}.{end}").is_file() for folder in _folders(path) for part in PARTS for end in FORMATS)


def find_model(path: Path, need_points: bool = True) -> tuple[Path, str, Path | None]:
    """Return the folder of a scene's COLMAP model, its format, "bin" (preferred) or "txt", and the file of its points.

    Points lie in points3D.bin or .txt, as the model, else in points3D.ply; None without any. Of several models it is
    the one with the most registered photos, else the first of sparse/0, sparse/1 and so on, sparse and `path` itself.

    Raises:
        FileNotFoundError: there is no complete model; the message names the missing files of a partial one. Points are
            a part of it if `need_points`.
    """
    partial = None
    models: list[tuple[Path, str, Path | None]] = []
    for folder in _folders(path):
        for end in FORMATS:
            missing = [f"{part}.{end}" for part in ("cameras", "images") if not (folder / f"{part}.{end}").is_file()]
            own = folder / f"points3D.{end}"
            points = next((file for file in (own, folder / POINTS_PLY) if file.is_file()), None)
            begun = len(missing) < 2 or own.is_file()
            if points is None and (need_points or missing):
                missing.append(own.name)
            if not missing:
                models.append((folder, end, points))
                break
            if begun and partial is None:
                partial = f"{path}: incomplete COLMAP model in {folder}: {' and '.join(missing)} not found"
                partial += "; --points FILE.ply stands in for it" if missing == [own.name] else ""
    if models:
        return models[0] if len(models) == 1 else max(models, key=lambda model: count_images(*model[:2]))
    raise FileNotFoundError(
        partial
        or f"{path}: no COLMAP model found, expected cameras, images and points3D (.bin or .txt) "
        "in sparse/0, in sparse or in the folder itself"
    )


def read_model(path: Path, images: Path, follow_links: bool = False, need_points: bool = True) -> Capture:
    """Read the COLMAP model of a scene.

    Args:
        path: folder of the scene.
        images: folder of its photos.
        follow_links: see `load_scene`.
        need_points: refuse a model without a file of points; one of no points is accepted.

    Raises:
        FileNotFoundError: there is no model.
        ValueError: the model is damaged, has no registered image, an invalid camera or pose, an image name that leaves
            the images folder or occurs twice, or points that are not finite.
    """
    folder, suffix, points = find_model(path, need_points)
    in_ply = points is not None and points.name == POINTS_PLY
    records = read_records(folder, suffix, points is not None and not in_ply)
    cloud = read_ply(inside_folder(f"{folder}:", points, path, follow_links)) if points is not None and in_ply else None
    return capture_of(records, folder, images, follow_links, cloud)


def capture_of(records: Records, folder: Path, images: Path, follow_links: bool, cloud: Cloud | None = None) -> Capture:
    """Convert the records of a model; `cloud` has the points of records without any.

    `folder` names the model in messages. Other arguments and errors are those of `read_model`.
    """
    if not records.images:
        raise ValueError(f"{folder}: the COLMAP model has no registered images")
    lenses: dict[int, Lens] = {}
    each = (_photo(image, records.cameras, lenses, folder, images, follow_links) for image in records.images.values())
    photos = distinct_photos(folder, each)
    points = records.points
    if points is None or not len(points.ids):
        return Capture.of(folder, photos, cloud)
    points = _without_strays(points, records.images, folder)
    capture = Capture.of(folder, photos, _cloud(points, folder))
    assert capture.cloud is not None
    seen = _seen(points, records.images, capture.cloud.positions.astype(np.float32))
    points_of = {photo.name: positions for photo, positions in zip(photos, seen, strict=True)}
    photos = [dataclasses.replace(photo, points=points_of[photo.name]) for photo in capture.photos]
    return dataclasses.replace(capture, photos=photos)


def _photo(
    image: ImageRecord,
    cameras: dict[int, CameraRecord],
    lenses: dict[int, Lens],
    folder: Path,
    images: Path,
    follow_links: bool,
) -> Photo:
    name = safe_name(f"{folder}: image name", image.name, "images folder", images)
    where = f"{folder}: {name}"
    file = inside_folder(f"{folder}: image name", find_file(images, name), images, follow_links)
    if image.camera not in cameras:
        raise ValueError(f"{where}: expected a camera of the model, got id {image.camera}")
    if image.camera not in lenses:
        try:
            lenses[image.camera] = Lens(*cameras[image.camera])
        except ValueError as error:
            raise ValueError(f"{where}: the COLMAP camera of this image is not usable: {error}") from error
    return Photo(name, file, _viewmat(where, image.pose), lenses[image.camera])


def _viewmat(where: str, pose: tuple[float, ...]) -> np.ndarray:
    """(4, 4) float64 matrix of a rotation wxyz and a translation."""
    quat, shift = np.array(pose[:4]), np.array(pose[4:])
    if not (np.abs(pose) <= LARGEST_COORDINATE).all() or not np.abs(quat).max() >= 1 / LARGEST_COORDINATE:
        raise ValueError(f"{where}: expected a finite pose with a rotation, got {pose}")
    quat /= np.abs(quat).max()
    w, x, y, z = quat / np.linalg.norm(quat)
    viewmat = np.eye(4)
    viewmat[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    viewmat[:3, 3] = shift
    return viewmat


def _without_strays(points: PointRecords, images: dict[int, ImageRecord], folder: Path) -> PointRecords:
    """Leave out, with a warning, observations of images that the model does not have."""
    known = np.isin(points.seen_by, np.array(list(images), np.uint32))
    if known.all():
        return points
    strays = np.unique(points.seen_by[~known])
    warnings.warn(
        f"{folder}: {(~known).sum():,} observations of points are of {len(strays):,} images that the model does not "
        f"have, such as id {strays[0]}; left out",
        stacklevel=2,
    )
    kept = points.points[known]
    lengths = np.bincount(kept, minlength=len(points.ids))
    return dataclasses.replace(points, seen_by=points.seen_by[known], points=kept, lengths=lengths)


def _seen(points: PointRecords, images: dict[int, ImageRecord], positions: np.ndarray) -> list[np.ndarray]:
    """For each image, those (M, 3) of the positions (P, 3) that were triangulated from it, by ascending id."""
    identities = np.array(list(images), np.int64)
    ascending = np.argsort(identities)
    # Observations are the largest arrays of a model, so they are processed in place.
    pairs = np.searchsorted(identities[ascending].astype(np.uint32), points.seen_by)
    # Sort by image, then by point, and remove duplicates.
    pairs *= len(points.ids)
    pairs += points.points
    pairs.sort()
    pairs = pairs[np.concatenate([[True], pairs[1:] != pairs[:-1]])[: len(pairs)]]
    ends = np.searchsorted(pairs, np.arange(1, len(identities)) * len(points.ids))
    seen: list[np.ndarray] = [positions[part % len(points.ids)] for part in np.split(pairs, ends)]
    order = np.empty_like(ascending)
    order[ascending] = np.arange(len(ascending))
    return [seen[index] for index in order]


def _cloud(points: PointRecords, folder: Path) -> Cloud:
    check_points(folder, points.positions, "3D points", lambda index: f"point id {points.ids[index]}")
    bad = ~(np.abs(points.errors) <= LARGEST_COORDINATE)
    if bad.any():
        index = int(np.flatnonzero(bad)[0])
        raise ValueError(
            f"{folder}: expected finite reprojection errors, got {points.errors[index]} (point id {points.ids[index]})"
        )
    return Cloud(points.positions, points.colors, points.lengths.astype(np.int32), points.errors.astype(np.float32))
