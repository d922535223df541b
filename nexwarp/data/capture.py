"""What a scene's files say before a pixel is read: photos with their cameras, and points."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from nexwarp.data.lens import Lens

MAX_PART, MAX_PATH = 240, 1024  # bytes of a file name
LARGEST_COORDINATE = 1e15  # squares stay finite in single precision


@dataclass(frozen=True)
class Photo:
    """One posed photo; the pixels are elsewhere.

    Attributes:
        name: its name below the images folder, "/" between its parts; unique in a scene.
        file: the image file.
        viewmat: (4, 4) float64, world to camera, OpenCV axes.
        lens: the camera as it took the photo, whose size may differ from the file's by a factor.
        mask: the mask's file where the scene names it.
        face: which face of a panorama this is, see `nexwarp.data.lens.FACES`.
        points: (M, 3) float32 world positions of the points that were triangulated from it; None when unknown.
    """

    name: str
    file: Path
    viewmat: np.ndarray
    lens: Lens
    mask: Path | None = None
    face: str | None = None
    points: np.ndarray | None = None


@dataclass(frozen=True)
class Cloud:
    """Points to start from.

    Attributes:
        positions: (P, 3) float64, world frame.
        colors: (P, 3) uint8 sRGB.
        track_lengths: (P,) int32, how many photos see a point; 0 when unknown.
        reprojection_errors: (P,) float32, mean over the track, in pixels of the photos as taken; -1 when unknown.
        observations: (M, 2) int64 pairs of a photo's number and the index of a point that it sees; ascending, none
            twice. None when unknown.
    """

    positions: np.ndarray
    colors: np.ndarray
    track_lengths: np.ndarray
    reprojection_errors: np.ndarray
    observations: np.ndarray | None = None

    @classmethod
    def of(cls, positions: np.ndarray, colors: np.ndarray) -> "Cloud":
        """Points of which nothing but positions and colours is known."""
        count = len(positions)
        return cls(positions, colors, np.zeros(count, np.int32), np.full(count, -1.0, np.float32))


@dataclass(frozen=True)
class Capture:
    """A scene's photos and points.

    Attributes:
        source: the file or folder that the cameras were read from.
        photos: sorted by name.
        cloud: points, None where the scene has none.
        test: names of the photos to judge by; None for every eighth.
        background: colour that goes behind transparent photos unless another is asked for; None drops their alpha.
    """

    source: Path
    photos: list[Photo]
    cloud: Cloud | None
    test: frozenset[str] | None = None
    background: tuple[float, float, float] | None = None


def safe_name(where: str, name: str, folder: str) -> str:
    """Normalise a file name of a scene: "/" between its parts, none of them ".".

    Raises:
        ValueError: it is no printable relative path below the scene's folder, on any system, or longer than one has.
    """
    if (
        not name
        or not name.isprintable()
        or any(".." in path.parts or path.anchor for path in (PurePosixPath(name), PureWindowsPath(name)))
    ):
        raise ValueError(f"{where} {short(name)} leaves the {folder}, expected a relative path below it")
    path = PurePosixPath(name)
    if not path.parts:
        raise ValueError(f"{where} {short(name)} names no file, expected a relative path below the {folder}")
    # What a mask or an undistorted photo adds to a name has to fit as well.
    if len(name.encode()) > MAX_PATH or any(len(part.encode()) > MAX_PART for part in path.parts):
        raise ValueError(f"{where} {short(name)}: expected at most {MAX_PART} bytes a part and {MAX_PATH} in all")
    return str(path)


def inside_folder(where: str, path: Path, folder: Path) -> Path:
    """Return a path below a scene's folder unless symbolic links lead it out; the folder itself may be a link.

    Raises:
        ValueError: they do.
    """
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # links in a circle
        inside = False
    if not inside:
        raise ValueError(f"{where} {short(path.name)}: a link leaves {folder}, expected a file in it")
    return path


def check_unique(source: Path, photos: list[Photo]) -> None:
    """Raise ValueError when two photos have one name."""
    seen: set[str] = set()
    for photo in photos:
        if photo.name in seen:
            raise ValueError(f"{source}: expected each photo once, got {photo.name} twice")
        seen.add(photo.name)


def check_points(source: Path, positions: np.ndarray, what: str, name: Callable[[int], str]) -> None:
    """Raise ValueError naming the first of (P, 3) positions that is not finite or is absurdly far."""
    bad = ~(np.abs(positions) <= LARGEST_COORDINATE).all(axis=1)
    if bad.any():
        index = int(np.flatnonzero(bad)[0])
        where = tuple(positions[index].tolist())
        raise ValueError(
            f"{source}: expected finite {what}, got {where} ({name(index)}); at most {LARGEST_COORDINATE:g} from 0"
        )


def short(value: Any) -> str:
    """What a file holds, for a message of one line."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
