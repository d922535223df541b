"""Readers of COLMAP's model files, binary and text, into numpy arrays.

pycolmap is not used: it allocates memory for a count before it checks the file's size, reads past the end of a
truncated file, aborts the process on some damaged files, and creates a Python object for each point. Rigs and frames,
which repeat the poses of the images, are not read.
"""

import codecs
import struct
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar

import numpy as np

from nexwarp.data.lens import camera_models

MAX_CAMERAS = MAX_IMAGES = 100_000
MAX_POINTS = 10_000_000
LARGEST_ID = 2**32 - 1  # of an image, as binary files hold it
MAX_OBSERVATIONS = 100_000_000
MAX_NAME = 4096  # bytes
MAX_LINE = 64 * 2**20  # bytes of a line of a text file, enough for a million keypoints
KEYPOINT_BYTES = b"0123456789+-.eEinfaINFA \t"  # of numbers, nan and inf
CAMERA, IMAGE, POINT = struct.Struct("<IiQQ"), struct.Struct("<I7dI"), 51
POINT_RECORD = np.dtype(
    {
        "names": ["id", "xyz", "rgb", "error", "length"],
        "formats": ["<u8", ("<f8", 3), ("u1", 3), "<f8", "<u8"],
        "offsets": [0, 8, 32, 35, 43],
        "itemsize": POINT,
    }
)

Record = TypeVar("Record")


class CameraRecord(NamedTuple):
    """A camera: COLMAP's name of its model, parameters in COLMAP's order, size in pixels; the arguments of `Lens`."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int


class ImageRecord(NamedTuple):
    """A registered image: rotation wxyz, not normalised, and translation (7,), world to camera; camera's id; name."""

    pose: tuple[float, ...]
    camera: int
    name: str


@dataclass(frozen=True)
class PointRecords:
    """Points by ascending id.

    Attributes:
        ids: (P,) uint64.
        positions: (P, 3) float64, world frame.
        colors: (P, 3) uint8.
        errors: (P,) float64, mean reprojection errors in pixels.
        lengths: (P,) int64, number of observations of each point.
        seen_by: (E,) uint32, image ids of the observations, in the order of `points`.
        points: (E,) int32, index of the point of each observation.
    """

    ids: np.ndarray
    positions: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    lengths: np.ndarray
    seen_by: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class Records:
    """The records of a model: cameras and images by id, and points, or None."""

    cameras: dict[int, CameraRecord]
    images: dict[int, ImageRecord]
    points: PointRecords | None


def read_records(folder: Path, suffix: str, points: bool = True) -> Records:
    """Read the cameras and images of a model, "bin" or "txt", and its points, unless it has none of this kind.

    Raises:
        ValueError: a file is truncated or damaged, or exceeds the limits above; the message names it, and the line.
    """
    if suffix == "bin":
        with _opened(folder / "cameras.bin") as file:
            cameras = _unique(file.path, (_binary_camera(file) for _ in range(file.count(MAX_CAMERAS))))
        with _opened(folder / "images.bin") as file:
            images = _unique(file.path, (_binary_image(file) for _ in range(file.count(MAX_IMAGES))))
        if points:
            with _opened(folder / "points3D.bin") as file:
                return Records(cameras, images, _binary_points(file))
    else:
        lines = _lines(folder / "cameras.txt")
        cameras = _unique(folder / "cameras.txt", (_text_camera(where, line) for where, line in lines), MAX_CAMERAS)
        images = _unique(folder / "images.txt", _text_images(folder / "images.txt"), MAX_IMAGES)
        if points:
            return Records(cameras, images, _text_points(folder / "points3D.txt"))
    return Records(cameras, images, None)


def count_images(folder: Path, suffix: str) -> int:
    """Number of registered images of the model in a folder, "bin" or "txt"; errors are those of the readers."""
    if suffix == "txt":
        return sum(1 for _ in _text_images(folder / "images.txt"))
    with (folder / "images.bin").open("rb") as file:
        return _Reader(folder / "images.bin", file).count(MAX_IMAGES)


class _Reader:
    """Reads a binary file with checks against its size: it never reads or allocates beyond it."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file, self.size = path, file, path.stat().st_size
        self.position = 0

    def read(self, size: int) -> bytes:
        self._advance(size)
        data = self.file.read(size)
        if len(data) < size:
            raise self._short()
        return data

    def skip(self, size: int) -> None:
        self._advance(size)
        self.file.seek(self.position)

    def number(self, kind: str) -> int:
        return struct.unpack(f"<{kind}", self.read(struct.calcsize(f"<{kind}")))[0]

    def count(self, limit: int) -> int:
        count = self.number("Q")
        if count > self.size - self.position:  # each record has at least one byte
            raise self._short()
        if count > limit:
            raise ValueError(f"{self.path}: expected at most {limit:,} records, got {count:,}")
        return count

    def text(self) -> bytes:
        """Read bytes up to a zero."""
        start = self.position
        data, zero, _ = self.file.read(MAX_NAME + 1).partition(b"\0")
        if not zero and start + MAX_NAME < self.size:
            raise ValueError(f"{self.path}: damaged, expected image names of at most {MAX_NAME} bytes")
        self.skip(len(data) + 1)
        return data

    def _advance(self, size: int) -> None:
        self.position += size
        if self.position > self.size:
            raise self._short()

    def _short(self) -> ValueError:
        return ValueError(f"{self.path}: truncated or damaged, expected more records than the file holds")


@contextmanager
def _opened(path: Path) -> Iterator[_Reader]:
    """Open a binary file that is to be read to its end."""
    with path.open("rb") as file:
        reader = _Reader(path, file)
        yield reader
    if reader.position != reader.size:
        raise ValueError(f"{path}: damaged, expected {reader.position:,} bytes as its counts say, got {reader.size:,}")


def _unique(path: Path, records: Iterator[tuple[int, Record]], limit: int = MAX_CAMERAS) -> dict[int, Record]:
    """Collect records by id; ValueError if an id occurs twice or there are more than `limit`."""
    by_id: dict[int, Record] = {}
    for identity, record in records:
        if identity in by_id:
            raise ValueError(f"{path}: damaged, expected each id once, got {identity} twice")
        by_id[identity] = record
        if len(by_id) > limit:
            raise ValueError(f"{path}: expected at most {limit:,} records, got more")
    return by_id


def _binary_camera(file: _Reader) -> tuple[int, CameraRecord]:
    identity, model, width, height = CAMERA.unpack(file.read(CAMERA.size))
    if model not in camera_models():
        raise ValueError(f"{file.path}: camera {identity}: expected a camera model that COLMAP knows, got {model}")
    name, count = camera_models()[model]
    return identity, CameraRecord(name, struct.unpack(f"<{count}d", file.read(8 * count)), width, height)


def _binary_image(file: _Reader) -> tuple[int, ImageRecord]:
    identity, *pose, camera = IMAGE.unpack(file.read(IMAGE.size))
    name = _decoded(file.path, file.text())
    file.skip(24 * file.number("Q"))  # keypoints
    return identity, ImageRecord(tuple(pose), camera, name)


def _binary_points(file: _Reader) -> PointRecords:
    heads, tracks = bytearray(), bytearray()
    for _ in range(file.count(MAX_POINTS)):
        head = file.read(POINT)
        heads += head
        if length := int.from_bytes(head[43:], "little"):
            _check_observations(file.path, len(tracks) // 8 + length)
            tracks += file.read(8 * length)
    points = np.frombuffer(heads, POINT_RECORD)
    seen_by = np.frombuffer(tracks, "<u4")[::2].copy()
    del tracks
    return _sorted(file.path, points["id"], points["xyz"], points["rgb"], points["error"], points["length"], seen_by)


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


def _text_camera(where: str, line: bytes) -> tuple[int, CameraRecord]:
    try:
        identity, model, width, height, *params = line.split()
        known = {name.encode(): count for name, count in camera_models().values()}
        if known.get(model) != len(params):
            raise ValueError
        numbers = _integers((identity, width, height))
        return numbers[0], CameraRecord(model.decode(), tuple(map(float, params)), *numbers[1:])
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
    ids, values, colors, lengths, seen_by = array("Q"), array("d"), array("B"), array("q"), array("I")
    for where, line in _lines(path):
        words = line.split()
        try:
            ids.extend(_integers(words[:1]))
            values.extend(map(float, (*words[1:4], words[7])))
            colors.extend(_integers(words[4:7]))
            seen_by.extend(_integers(words[8::2]))
            lengths.append(len(words[8::2]))
            if len(words) % 2:
                raise ValueError
        except (ValueError, IndexError, OverflowError):
            raise _unreadable(where, "id, position, colour, error and track of a point", line) from None
        if len(ids) > MAX_POINTS:
            raise ValueError(f"{path}: expected at most {MAX_POINTS:,} points, got more")
        _check_observations(path, len(seen_by))
    table = np.frombuffer(values, np.float64).reshape(-1, 4)
    return _sorted(
        path,
        np.frombuffer(ids, np.uint64),
        table[:, :3],
        np.frombuffer(colors, np.uint8).reshape(-1, 3),
        table[:, 3],
        np.frombuffer(lengths, np.int64),
        np.frombuffer(seen_by, np.uint32),
    )


def _sorted(
    path: Path,
    ids: np.ndarray,
    positions: np.ndarray,
    colors: np.ndarray,
    errors: np.ndarray,
    lengths: np.ndarray,
    seen_by: np.ndarray,
) -> PointRecords:
    """Sort points by ascending id, so that binary and text models give the same result."""
    order = np.argsort(ids, kind="stable")
    ids = ids[order]
    twice = np.flatnonzero(ids[1:] == ids[:-1])
    if len(twice):
        raise ValueError(f"{path}: damaged, expected each id once, got {ids[twice[0]]} twice")
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    lengths = lengths.astype(np.int64)
    return PointRecords(
        ids, positions[order], colors[order], errors[order], lengths[order], seen_by, np.repeat(rank, lengths)
    )


def _check_observations(path: Path, count: int) -> None:
    if count > MAX_OBSERVATIONS:
        raise ValueError(f"{path}: expected at most {MAX_OBSERVATIONS:,} observations, got more")


def _decoded(path: Path, name: bytes) -> str:
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: expected image names in UTF-8, got {name[:60]!r}") from None
