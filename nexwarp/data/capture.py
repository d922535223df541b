"""The content of a scene's files without pixels: photos with their cameras, and points."""

import dataclasses
import math
import os
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from nexwarp.data.images import Color
from nexwarp.data.lens import Lens
from nexwarp.errors import MissingError, NexwarpError, SceneError
from nexwarp.io.files import one_line

MAX_PART, MAX_PATH = 240, 1024  # bytes of a part of a file's path, and of the path
PICTURES = frozenset(f".{name}" for name in "jpg jpeg png webp tif tiff bmp ppm pgm pnm gif tga jp2 j2k avif".split())
MOST_NAMED = 100  # missing photos in a message
LOST_PIXELS = 0.01  # by single precision, from which on a scene gets a frame of its own
DEPTH_SAMPLES = 2000  # points from which the depth of a scene is estimated
LARGEST_COORDINATE = 1e15  # its square is finite in single precision


@dataclass(frozen=True)
class Photo:
    """A posed photo, without its pixels."""

    name: str  # path below the images folder, with "/" as separator; unique in a scene
    file: Path
    viewmat: np.ndarray  # (4, 4) float64, world to camera, OpenCV axes; a capture's "world" has its `origin`
    lens: Lens  # the size of the image file may differ from the lens's by a factor
    test: bool | None = None  # whether it is a test photo; None if the scene has no split
    mask: Path | None = None  # None if the scene names none
    depth: Path | None = None  # its depth map; None if it has none
    face: str | None = None  # of a panorama, a key of `nexwarp.data.lens.FACES`; None for other photos
    points: np.ndarray | None = None  # (M,) indices of the cloud's points triangulated from it; None if unknown

    def project(self, points: np.ndarray) -> np.ndarray:
        """Positions (N, 2) of points (N, 3), in shares of the photo's width and height; NaN for those it does not show.

        The points are in the frame of `viewmat`; something may hide them.
        """
        pixels = self.lens.project(points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3])
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels < [self.lens.width, self.lens.height])).all(axis=1, keepdims=True)
        return np.where(inside, pixels / [self.lens.width, self.lens.height], np.nan)


@dataclass(frozen=True)
class Cloud:
    """The points of a scene."""

    positions: np.ndarray  # (P, 3) float64
    colors: np.ndarray  # (P, 3) uint8 sRGB
    track_lengths: np.ndarray  # (P,) int32, number of photos that see a point; 0 if unknown
    reprojection_errors: np.ndarray  # (P,) float32, mean over the track, pixels of the original photos; -1 if unknown

    def moved(self, origin: np.ndarray) -> "Cloud":
        """Return the points in the frame with another origin (3,) in the coordinates of theirs."""
        return dataclasses.replace(self, positions=self.positions - origin)

    @classmethod
    def of(cls, positions: np.ndarray, colors: np.ndarray) -> "Cloud":
        """Points with positions (P, 3) and colours (P, 3) only."""
        count = len(positions)
        return cls(positions, colors, np.zeros(count, np.int32), np.full(count, -1.0, np.float32))


@dataclass(frozen=True)
class Capture:
    """The photos and points of a scene."""

    source: Path  # the file or folder that the cameras were read from
    photos: list[Photo]  # sorted by name
    cloud: Cloud | None  # None if the scene has none
    origin: np.ndarray  # (3,) float64, world coordinates of the origin of photos and cloud; see `Scene.origin`
    background: Color | None = None  # behind transparent photos; None drops their alpha

    @classmethod
    def of(cls, source: Path, photos: list[Photo], cloud: Cloud | None, background: Color | None = None) -> "Capture":
        """Sort photos by name, and move photos and cloud from the world frame to one near them where that is needed.

        ValueError: two photos have one name.
        """
        photos = sorted(photos, key=lambda photo: photo.name)
        for photo, following in pairwise(photos):
            if photo.name == following.name:
                raise ValueError(f"{source}: expected each photo once, got {photo.name} twice")
        cloud = cloud if cloud is not None and len(cloud.positions) else None
        largest = max((max(photo.lens.width, photo.lens.height) for photo in photos), default=0)
        origin = far_origin([photo.viewmat for photo in photos], largest, cloud)
        if origin.any():
            photos = [dataclasses.replace(photo, viewmat=moved(photo.viewmat, origin)) for photo in photos]
            cloud = cloud and cloud.moved(origin)
            warnings.warn(
                f"{source}: too far from its world's origin for single precision; cameras and points are relative to "
                f"{tuple(origin.tolist())}, the scene's `origin`",
                stacklevel=2,
            )
        return cls(source, photos, cloud, origin, background)


def far_origin(viewmats: Sequence[np.ndarray], size: int, cloud: Cloud | None) -> np.ndarray:
    """Choose the origin (3,) of a frame in whose coordinates single precision loses less than 1/100 pixel.

    Takes world-to-camera matrices (4, 4) float64 and the pixels of the photos' longer side, roughly a focal length.
    """
    centres = np.array([-viewmat[:3, :3].T @ viewmat[:3, 3] for viewmat in viewmats]).reshape(-1, 3)
    if not len(centres) or not np.isfinite(centres).all():
        return np.zeros(3)
    middle = np.median(centres, axis=0)
    depth = float(np.linalg.norm(centres - middle, axis=1).max())
    if cloud is not None and len(cloud.positions):
        from scipy.spatial import cKDTree

        sample = cloud.positions[:: -(-len(cloud.positions) // DEPTH_SAMPLES)]
        depth = float(np.median(cKDTree(centres).query(sample)[0])) or depth
    lost = 2.0**-24 * np.abs(centres).max() * size
    if not depth > 0 or lost <= LOST_PIXELS * depth:
        return np.zeros(3)
    return np.round(middle, -math.floor(math.log10(depth)))


def moved(viewmat: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return a world-to-camera matrix (4, 4) float64 for the frame with another origin (3,) in world coordinates."""
    out = viewmat.copy()
    out[:3, 3] += viewmat[:3, :3] @ origin
    return out


@contextmanager
def scene_errors() -> Iterator[None]:
    """Turn what the readers of a scene raise into the package's errors, which are of the same built-in kinds."""
    try:
        yield
    except NexwarpError:
        raise
    except FileNotFoundError as error:
        raise MissingError(str(error)) from error
    except ValueError as error:
        raise SceneError(str(error)) from error


def safe_name(where: str, name: str, folder: str, root: Path | None = None) -> str:
    """Normalise a path relative to the `folder` of a message: "/" as separator, without ".".

    An absolute path below `root`, the folder itself, becomes a relative one. ValueError: the path is not printable, is
    absolute or has ".." on any operating system, or is too long.
    """
    for base in () if root is None or not Path(name).is_absolute() else (root.absolute(), root.resolve()):
        if Path(name).is_relative_to(base):
            name = str(Path(name).relative_to(base))
    name = name.replace("\\", "/")
    if (
        not name
        or not name.isprintable()
        or any(".." in path.parts or path.anchor for path in (PurePosixPath(name), PureWindowsPath(name)))
    ):
        raise ValueError(f"{where} {short(name)} leaves the {folder}, expected a relative path below it")
    path = PurePosixPath(name)
    if not path.parts:
        raise ValueError(f"{where} {short(name)} names no file, expected a relative path below the {folder}")
    # The limits leave room for the suffixes of masks and undistorted photos.
    if len(name.encode()) > MAX_PATH or any(len(part.encode()) > MAX_PART for part in path.parts):
        raise ValueError(f"{where} {short(name)}: expected at most {MAX_PART} bytes a part and {MAX_PATH} in all")
    return str(path)


def find_file(folder: Path, name: str) -> Path:
    """Return `folder / name`, with the parts of the name in the Unicode form that exists, if one does."""
    path = folder
    for part in PurePosixPath(name).parts:
        forms = (part, *(unicodedata.normalize(form, part) for form in ("NFC", "NFD") if not part.isascii()))
        path = next((path / form for form in forms if (path / form).exists()), path / part)
    return path


def find_named(folder: Path, name: str, appended: Sequence[str], replaced: Sequence[str] = ()) -> Path | None:
    """Find the file of a photo in a folder: its name with a suffix appended, or its stem with another one, or None."""
    path = PurePosixPath(name)
    candidates = [path.with_name(path.name + suffix) for suffix in appended]
    candidates += [path.with_suffix(suffix) for suffix in replaced]
    files = (find_file(folder, str(candidate)) for candidate in candidates)
    return next((file for file in files if file.is_file()), None)


def inside_folder(where: str, path: Path, folder: Path, follow_links: bool) -> Path:
    """Return a path below `folder`, which may be a link itself; ValueError if a link leads out and may not."""
    if follow_links:
        return path
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # circular links
        inside = False
    if not inside:
        link = f"{where} {short(path.name)}: a link leaves {folder}, expected a file in it"
        raise ValueError(f"{link}; --follow-links allows it, for scenes that you trust")
    return path


def report_missing(source: Path, names: Sequence[str], count: int, skip: bool) -> None:
    """Raise FileNotFoundError naming the photos of `count` that do not exist; with `skip` warn, if two are left."""
    if not names:
        return
    absent = f"{source}: {len(names)} of {count} photos: image not found: {listed(names, MOST_NAMED)}"
    if not skip or count - len(names) < 2:
        raise FileNotFoundError(absent if skip else f"{absent}; --skip-missing goes on without them")
    warnings.warn(f"{absent}; going on without them", stacklevel=2)


def report_unused(source: Path, folder: Path, photos: Iterable[Photo]) -> None:
    """Warn of pictures below the folder of the photos that are none of them, unless no photo lies there."""
    used = {plain_name(str(photo.file)).casefold() for photo in photos}
    files = (Path(parent, name) for parent, _, names in os.walk(folder) for name in names)
    pictures = [file for file in files if file.suffix.lower() in PICTURES and not file.name.startswith(".")]
    unused = sorted(str(file.relative_to(folder)) for file in pictures if plain_name(str(file)).casefold() not in used)
    if unused and len(pictures) - len(unused) > 1:  # fewer photos are an error
        warnings.warn(
            f"{folder}: {len(unused)} of {len(pictures)} photos are not used, as {source} does not list them: "
            f"{one_line(listed(unused, 8), 400)}",
            stacklevel=2,
        )


def plain_name(name: str) -> str:
    """A name in one Unicode form, for comparisons."""
    return unicodedata.normalize("NFC", name)


def listed(names: Sequence[str], most: int) -> str:
    """The first names of many, for messages."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" * (len(names) > most))


def check_points(source: Path, positions: np.ndarray, what: str, name: Callable[[int], str]) -> None:
    """Raise ValueError naming the first of (P, 3) positions that is not finite or further than 1e15 from the origin."""
    bad = ~(np.abs(positions) <= LARGEST_COORDINATE).all(axis=1)
    if bad.any():
        index = int(np.flatnonzero(bad)[0])
        where = tuple(positions[index].tolist())
        raise ValueError(
            f"{source}: expected finite {what}, got {where} ({name(index)}); at most {LARGEST_COORDINATE:g} from 0"
        )


def short(value: object) -> str:
    """The representation of a value in at most 60 characters, for messages."""
    return one_line(repr(value), 60)
