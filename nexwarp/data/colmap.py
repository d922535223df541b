"""COLMAP models, binary and text: search for their files, and conversion of their records to photos and points.

pycolmap's reader allocates memory for a count before it checks the file's size, and aborts the process on some damaged
files. Rigs and frames, which repeat the poses of the images, are not read.
"""

import codecs
import dataclasses
import struct
import warnings
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np

from nexwarp.data.capture import (
    LARGEST_COORDINATE,
    Capture,
    Cloud,
    Photo,
    check_points,
    find_file,
    inside_folder,
    safe_name,
)
from nexwarp.data.lens import Lens, camera_models, pycolmap_module
from nexwarp.data.ply import read_ply

PARTS = ("cameras", "images", "points3D")
FORMATS = ("bin", "txt")
POINTS_PLY = "points3D.ply"  # of MASt3R's and DUSt3R's exporters, and of 3DGS
MAX_IMAGES = 100_000  # and cameras
MAX_POINTS = 10_000_000
LARGEST_ID = 2**32 - 1  # of an image, as binary files hold it
MAX_NAME = 4096  # bytes
MAX_LINE = 64 * 2**20  # bytes of a line of a text file, enough for a million keypoints
KEYPOINT_BYTES = b"0123456789+-.eEinfaINFA \t"  # of numbers, nan and inf
CAMERA, IMAGE, POINT = struct.Struct("<IiQQ"), struct.Struct("<I7dI"), struct.Struct("<Q3d3BdQ")
POINTS = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])

CameraRecord: TypeAlias = tuple[str, tuple[float, ...], int, int]  # the arguments of `Lens`
Record = TypeVar("Record")
Reader: TypeAlias = Callable[[Path], Iterator[tuple[int, Record]]]  # of the records in a file, each with its id


class ImageRecord(NamedTuple):
    """A registered image: rotation wxyz, not normalised, and translation (7,), world to camera; camera's id; name."""

    pose: tuple[float, ...]
    camera: int
    name: str


@dataclass(frozen=True)
class PointRecords:
    """Points by ascending id."""

    table: np.ndarray  # (P,) of `POINTS`: world positions, colours, mean errors in pixels, numbers of observations
    seen_by: np.ndarray  # (E,) uint32, image ids of the observations
    points: np.ndarray  # (E,) int32, index of the point of each observation


def _folders(path: Path) -> list[Path]:
    """Folders that a scene's models lie in: sparse/0, sparse/1 and so on, sparse and the scene's folder itself."""
    numbered = [folder for folder in (path / "sparse").glob("*") if folder.name.isdecimal()]
    return [*sorted(numbered, key=lambda folder: int(folder.name)), path / "sparse", path]


def has_model(path: Path) -> bool:
    """Whether a file of a COLMAP model exists in a folder that `read_model` searches."""
    return any((folder / f"{part}.{end}").is_file() for folder in _folders(path) for part in PARTS for end in FORMATS)


def _find_model(path: Path, need_points: bool) -> tuple[Path, str, Path | None]:
    """Return the folder of a scene's COLMAP model, its format, "bin" (preferred) or "txt", and the file of its points.

    Points lie in points3D.bin or .txt, as the model, else in points3D.ply; None without any. Of several models it is
    the one with the most registered photos, else the first of `_folders`.
    """
    incomplete = None
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
            if begun and incomplete is None:
                incomplete = f"{path}: incomplete COLMAP model in {folder}: {' and '.join(missing)} not found"
                incomplete += "; --points FILE.ply stands in for it" if missing == [own.name] else ""
    if models:
        return models[0] if len(models) == 1 else max(models, key=lambda model: _count_images(*model[:2]))
    raise FileNotFoundError(
        incomplete
        or f"{path}: no COLMAP model found, expected cameras, images and points3D (.bin or .txt) "
        "in sparse/0, in sparse or in the folder itself"
    )


def read_model(path: Path, images: Path, follow_links: bool = False, need_points: bool = True) -> Capture:
    """Read the COLMAP model of a scene in `path`, whose photos lie in `images`.

    With `need_points` a model without a file of points is refused; one of no points is accepted. FileNotFoundError:
    there is no complete model. ValueError: it is damaged, has no registered image, an invalid camera or pose, an image
    name that leaves the images folder or occurs twice, or points that are not finite.
    """
    folder, suffix, points_file = _find_model(path, need_points)
    in_ply = points_file is not None and points_file.name == POINTS_PLY
    read_cameras, read_images, read_points = READERS[suffix]
    cameras = _unique(folder / f"cameras.{suffix}", read_cameras)
    records = _unique(folder / f"images.{suffix}", read_images)
    cloud = points = None
    if points_file is not None and in_ply:
        cloud = read_ply(inside_folder(f"{folder}:", points_file, path, follow_links))
    elif points_file is not None:
        points = read_points(points_file)
    if not records:
        raise ValueError(f"{folder}: the COLMAP model has no registered images")
    photos = [_photo(image, cameras, folder, images, follow_links) for image in records.values()]
    if points is not None and len(points.table):
        points = _without_strays(points, records, folder)
        cloud = _cloud(points.table, folder)
        seen = _seen(points, records)
        photos = [dataclasses.replace(photo, points=indices) for photo, indices in zip(photos, seen, strict=True)]
    return Capture.of(folder, photos, cloud)


def _photo(
    image: ImageRecord, cameras: dict[int, CameraRecord], folder: Path, images: Path, follow_links: bool
) -> Photo:
    name = safe_name(f"{folder}: image name", image.name, "images folder", images)
    where = f"{folder}: {name}"
    file = inside_folder(f"{folder}: image name", find_file(images, name), images, follow_links)
    if image.camera not in cameras:
        raise ValueError(f"{where}: expected a camera of the model, got id {image.camera}")
    try:
        lens = Lens(*cameras[image.camera])
    except ValueError as error:
        raise ValueError(f"{where}: the COLMAP camera of this image is not usable: {error}") from error
    return Photo(name, file, _viewmat(where, image.pose), lens)


def _viewmat(where: str, pose: tuple[float, ...]) -> np.ndarray:
    """(4, 4) float64 matrix of a rotation wxyz and a translation."""
    quat, shift = np.array(pose[:4]), np.array(pose[4:])
    if not (np.abs(pose) <= LARGEST_COORDINATE).all() or not np.abs(quat).max() >= 1 / LARGEST_COORDINATE:
        raise ValueError(f"{where}: expected a finite pose with a rotation, got {pose}")
    quat /= np.abs(quat).max()
    w, x, y, z = quat / np.linalg.norm(quat)
    pycolmap, viewmat = pycolmap_module(), np.eye(4)
    viewmat[:3] = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), shift).matrix()
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
    points.table["length"] = np.bincount(kept, minlength=len(points.table))
    return PointRecords(points.table, points.seen_by[known], kept)


def _seen(points: PointRecords, images: dict[int, ImageRecord]) -> list[np.ndarray]:
    """For each image, the ascending indices (M,) of the points that were triangulated from it."""
    from scipy.sparse import coo_matrix

    identities = np.array(list(images), np.uint32)
    ascending = np.argsort(identities).astype(np.int32)
    rows = ascending[np.searchsorted(identities, points.seen_by, sorter=ascending)]
    shape = len(images), len(points.table)
    seen = coo_matrix((np.ones(len(rows), bool), (rows, points.points)), shape).tocsr()  # sorted, without duplicates
    return np.split(seen.indices, seen.indptr[1:-1])


def _cloud(table: np.ndarray, folder: Path) -> Cloud:
    def name(index: int) -> str:
        return f"point id {table['id'][index]}"

    positions, errors = np.ascontiguousarray(table["xyz"]), table["error"]
    check_points(folder, positions, "3D points", name)
    bad = ~(np.abs(errors) <= LARGEST_COORDINATE)
    if bad.any():
        index = int(np.flatnonzero(bad)[0])
        raise ValueError(f"{folder}: expected finite reprojection errors, got {errors[index]} ({name(index)})")
    colors = np.ascontiguousarray(table["rgb"])
    return Cloud(positions, colors, table["length"].astype(np.int32), errors.astype(np.float32))


# Binary files


def _count_images(folder: Path, suffix: str) -> int:
    """Number of registered images of the model in a folder, "bin" or "txt"."""
    if suffix == "txt":
        return sum(1 for _ in _text_images(folder / "images.txt"))
    with (folder / "images.bin").open("rb") as file:
        return int.from_bytes(file.read(8), "little")


class _MappedFile:
    """A binary file that is mapped into memory, and how far it is read; ValueError where it ends too early."""

    def __init__(self, path: Path, content: mmap) -> None:
        self.path, self.content, self.position = path, content, 0

    def skip(self, size: int) -> int:
        """Go on by some bytes; return where they begin."""
        start, self.position = self.position, self.position + size
        if self.position > len(self.content):
            raise ValueError(f"{self.path}: truncated or damaged, expected more records than the file holds")
        return start

    def read(self, size: int) -> bytes:
        return self.content[self.skip(size) : self.position]

    def number(self) -> int:
        return int.from_bytes(self.read(8), "little")

    def text(self) -> bytes:
        """Read bytes up to a zero."""
        end = self.content.find(b"\0", self.position, self.position + MAX_NAME + 1)
        if end < 0 and len(self.content) > self.position + MAX_NAME:
            raise ValueError(f"{self.path}: damaged, expected image names of at most {MAX_NAME} bytes")
        return self.read((end if end >= 0 else len(self.content)) - self.position + 1)[:-1]


def _records(read: Callable[[_MappedFile], Record], path: Path) -> Iterator[Record]:
    """Read the records of a binary file, whose number is its first one, to its end."""
    if not path.stat().st_size:
        raise ValueError(f"{path}: truncated or damaged, expected more records than the file holds")
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        reader = _MappedFile(path, content)
        for _ in range(reader.number()):
            yield read(reader)
        if reader.position != len(content):
            sizes = f"expected {reader.position:,} bytes as its counts say, got {len(content):,}"
            raise ValueError(f"{path}: damaged, {sizes}")


def _unique(path: Path, read: Reader[Record]) -> dict[int, Record]:
    """Read records by id; ValueError if an id occurs twice or there are too many."""
    by_id: dict[int, Record] = {}
    for identity, record in read(path):
        if identity in by_id:
            raise ValueError(f"{path}: damaged, expected each id once, got {identity} twice")
        by_id[identity] = record
        if len(by_id) > MAX_IMAGES:
            raise ValueError(f"{path}: expected at most {MAX_IMAGES:,} records, got more")
    return by_id


def _binary_camera(file: _MappedFile) -> tuple[int, CameraRecord]:
    identity, model, width, height = CAMERA.unpack(file.read(CAMERA.size))
    if model not in camera_models():
        raise ValueError(f"{file.path}: camera {identity}: expected a camera model that COLMAP knows, got {model}")
    name, count = camera_models()[model]
    return identity, (name, struct.unpack(f"<{count}d", file.read(8 * count)), width, height)


def _binary_image(file: _MappedFile) -> tuple[int, ImageRecord]:
    identity, *pose, camera = IMAGE.unpack(file.read(IMAGE.size))
    name = _decoded(file.path, file.text())
    file.skip(24 * file.number())  # keypoints
    return identity, ImageRecord(tuple(pose), camera, name)


def _binary_points(path: Path) -> PointRecords:
    heads, tracks = bytearray(), bytearray()

    def read(file: _MappedFile) -> None:
        nonlocal heads, tracks
        head = file.read(POINT.size)
        heads += head
        tracks += file.read(8 * int.from_bytes(head[-8:], "little"))

    for _ in _records(read, path):
        pass
    return _sorted(path, heads, np.frombuffer(tracks, "<u4")[::2].copy())


# Text files


def _lines(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield each line with its place for messages, without a byte order mark, comments and empty lines."""
    with path.open("rb") as file:
        number = 0
        while line := file.readline(MAX_LINE):
            number += 1
            if len(line) == MAX_LINE:
                raise ValueError(f"{path}: line {number}: expected at most {MAX_LINE:,} bytes")
            line = line.removeprefix(codecs.BOM_UTF8).strip()
            if line and not line.startswith(b"#"):
                yield f"{path}: not a readable COLMAP model: line {number}", line


def _unreadable(where: str, expected: str, line: bytes) -> ValueError:
    return ValueError(f"{where}: expected {expected}, got {line[:60].decode('ascii', 'backslashreplace')!r}")


def _integers(words: Sequence[bytes]) -> list[int]:
    """Integers of words such as 12, 12.0 and 1.2e1; ValueError for other numbers."""
    try:
        return [int(word) for word in words]
    except ValueError:
        numbers = [float(word) for word in words]
        if not all(number.is_integer() for number in numbers):
            raise
        return [int(number) for number in numbers]


def _text_cameras(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    known = {name.encode(): count for name, count in camera_models().values()}
    for where, line in _lines(path):
        try:
            identity, model, width, height, *params = line.split()
            if known.get(model) != len(params):
                raise ValueError
            number, columns, rows = _integers((identity, width, height))
            yield number, (model.decode(), tuple(map(float, params)), columns, rows)
        except ValueError:
            expected = "id, model, width, height and the model's parameters of a camera"
            raise _unreadable(where, expected, line) from None


def _text_images(path: Path) -> Iterator[tuple[int, ImageRecord]]:
    """Read images; their lines of keypoints, which some programs leave out, are told by their content."""
    for where, line in _lines(path):
        if not line.translate(None, KEYPOINT_BYTES) and len(line.split()) % 3 == 0:
            continue  # triples of x, y and a point's id
        try:
            *numbers, name = line.split(None, 9)
            pose = tuple(map(float, numbers[1:8]))
            identity, camera = _integers((numbers[0], numbers[8]))
            if not 0 <= identity <= LARGEST_ID:
                raise ValueError
        except (ValueError, IndexError):
            raise _unreadable(where, "id, pose, camera and name of an image, or its keypoints", line) from None
        yield identity, ImageRecord(pose, camera, _decoded(path, name))


def _text_points(path: Path) -> PointRecords:
    heads, seen_by = bytearray(), array("I")
    for where, line in _lines(path):
        words = line.split()
        try:
            x, y, z, error = map(float, (*words[1:4], words[7]))
            identity, *color = _integers((words[0], *words[4:7]))
            seen_by.extend(_integers(words[8::2]))
            heads += POINT.pack(identity, x, y, z, *color, error, len(words[8::2]))
            if len(words) % 2:
                raise ValueError
        except (ValueError, IndexError, OverflowError, struct.error):
            raise _unreadable(where, "id, position, colour, error and track of a point", line) from None
    return _sorted(path, heads, np.frombuffer(seen_by, np.uint32))


def _sorted(path: Path, heads: bytearray, seen_by: np.ndarray) -> PointRecords:
    """Sort points by ascending id, so that binary and text models give the same result."""
    table = np.frombuffer(heads, POINTS)
    if len(table) > MAX_POINTS:
        raise ValueError(f"{path}: expected at most {MAX_POINTS:,} points, got {len(table):,}")
    order = np.argsort(table["id"], kind="stable")
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    points = np.repeat(rank, table["length"].astype(np.int64))
    table = table[order]
    twice = np.flatnonzero(table["id"][1:] == table["id"][:-1])
    if len(twice):
        raise ValueError(f"{path}: damaged, expected each id once, got {table['id'][twice[0]]} twice")
    return PointRecords(table, seen_by, points)


def _decoded(path: Path, name: bytes) -> str:
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: expected image names in UTF-8, got {name[:60]!r}") from None


# Readers of cameras and images, with their ids, and of points. ValueError names a damaged file, and a line of text.
READERS: dict[str, tuple[Reader[CameraRecord], Reader[ImageRecord], Callable[[Path], PointRecords]]] = {
    "bin": (partial(_records, _binary_camera), partial(_records, _binary_image), _binary_points),
    "txt": (_text_cameras, _text_images, _text_points),
}
