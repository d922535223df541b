"""The photos of a reconstruction: listing, decoding, EXIF, and grouping by camera."""

import re
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from nexwarp.data.images import read_image
from nexwarp.data.lens import pycolmap_module
from nexwarp.data.sfm.options import SfmOptions

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")  # formats that both PIL and pycolmap 4.2 decode
CONVERTIBLE = (".heic", ".heif", ".webp", ".avif", ".gif", ".jp2", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf")
FILMS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
MIN_PHOTOS = 3
MANY = 5  # photos of one camera that determine the eight parameters of OPENCV
MAKE, MODEL = 271, 272  # EXIF tags


@dataclass(frozen=True)
class InputPhoto:
    """A photo before reconstruction, without a pose.

    Attributes:
        name: path below the photos' folder, with "/" as separator.
        size: width and height in pixels; EXIF orientation is not applied.
        device: make and model of the camera from EXIF, empty if absent.
        focal: focal length in pixels from EXIF; None if absent.
    """

    name: str
    size: tuple[int, int]
    device: tuple[str, str]
    focal: float | None


def list_photos(folder: Path) -> list[str]:
    """Names of the photos below `folder`, without hidden files, in numeric order (IMG_9 before IMG_10).

    Raises:
        FileNotFoundError: no such folder.
        ValueError: it has fewer than 3 photos.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder, expected one with photos")
    files = [f.relative_to(folder) for f in folder.rglob("*") if f.is_file()]
    files = [f for f in files if not any(part.startswith(".") for part in f.parts)]
    names = sorted((f.as_posix() for f in files if f.suffix.lower() in SUFFIXES), key=_natural)
    if len(names) < MIN_PHOTOS:
        kinds = Counter(f.suffix.lower() for f in files)
        others = [f"{kinds[s]} {s}: convert to JPEG or PNG first" for s in CONVERTIBLE if kinds[s]]
        others += [f"{kinds[s]} {s}: give the film itself to nexwarp process" for s in FILMS if kinds[s]]
        there = "; ".join([f"{len(names) or 'none'}", *others])
        raise ValueError(f"{folder}: expected at least {MIN_PHOTOS} photos ({', '.join(SUFFIXES)}), found {there}")
    return names


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key that compares digits as numbers; the name itself decides between 01 and 1."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", name)] + [(-1, name)]


def read_photos(folder: Path, names: Sequence[str], done: Callable[[int], None]) -> list[InputPhoto]:
    """Decode every photo, so that a damaged one is reported before the reconstruction, and read its EXIF.

    Args:
        folder: folder of the photos.
        names: their names below it.
        done: called with the number of photos that were read.

    Raises:
        ValueError: a photo cannot be decoded.
    """
    photos: list[InputPhoto] = []
    with ThreadPoolExecutor() as pool:  # decoding releases the GIL
        jobs = [pool.submit(_read_photo, folder, name) for name in names]
        try:
            for count, job in enumerate(jobs, start=1):
                photos.append(job.result())
                done(count)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return photos


def _read_photo(folder: Path, name: str) -> InputPhoto:
    pycolmap = pycolmap_module()
    path = folder / name
    height, width = read_image(path).shape[:2]
    try:
        camera = pycolmap.infer_camera_from_image(str(path))
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: pycolmap cannot decode it; save it anew as JPEG or PNG, or remove it") from error
    if (camera.width, camera.height) != (width, height):
        raise ValueError(f"{path}: expected {width}x{height}, pycolmap reads {camera.width}x{camera.height}")
    focal = camera.focal_length if camera.has_prior_focal_length else None
    return InputPhoto(name, (width, height), _device(path), focal)


def _device(path: Path) -> tuple[str, str]:
    from PIL import Image

    try:
        with Image.open(path) as image:
            exif = image.getexif()
            return str(exif.get(MAKE, "")), str(exif.get(MODEL, ""))
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, struct.error):  # damaged EXIF counts as absent
        return "", ""


def camera_groups(folder: Path, photos: Sequence[InputPhoto], cameras: str) -> list[list[InputPhoto]]:
    """Group photos that share a camera.

    Args:
        folder: folder of the photos, for messages.
        photos: the photos.
        cameras: `SfmOptions.cameras`.

    Raises:
        ValueError: photos of one group differ in size.
    """
    keys: dict[str, Callable[[InputPhoto], object]] = {
        "auto": lambda p: (p.size, p.device, p.focal and round(p.focal)),
        "single": lambda p: (),
        "folder": lambda p: p.name.rpartition("/")[0],
        "image": lambda p: p.name,
    }
    groups: dict[object, list[InputPhoto]] = {}
    for photo in photos:
        groups.setdefault(keys[cameras](photo), []).append(photo)
    for group in groups.values():
        for photo in group:
            if photo.size != group[0].size:
                raise ValueError(
                    f"{folder}: photos of one camera must have one size, got {_text(group[0].size)} ({group[0].name}) "
                    f"and {_text(photo.size)} ({photo.name}); expected --cameras auto or image rather than {cameras}"
                )
    return list(groups.values())


def camera_model(group: Sequence[InputPhoto], options: SfmOptions) -> str:
    """COLMAP's name of the camera model for photos that share a camera."""
    if options.camera_model != "auto":
        return options.camera_model.upper()
    return "OPENCV" if len(group) >= MANY else "SIMPLE_RADIAL"


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
