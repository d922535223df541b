"""Which photos there are, whether they can be read, and which of them share a camera."""

import re
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from nexwarp.data.images import read_image
from nexwarp.data.lens import pycolmap_module
from nexwarp.sfm.options import SfmOptions

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")  # what both PIL and pycolmap 4.2 decode
CONVERTIBLE = (".heic", ".heif", ".webp", ".avif", ".gif", ".jp2", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf")
FILMS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
MIN_PHOTOS = 3
MANY = 5  # photos that carry the eight parameters of OPENCV
MAKE, MODEL = 271, 272  # EXIF tags


@dataclass(frozen=True)
class Photo:
    """A photo that can be read.

    Attributes:
        name: path below the photos' folder, "/" between its parts.
        size: width and height in pixels, EXIF orientation not applied.
        device: make and model of the camera as in EXIF, empty where absent.
        focal: focal length in pixels from EXIF; None where absent.
    """

    name: str
    size: tuple[int, int]
    device: tuple[str, str]
    focal: float | None


def list_photos(folder: Path) -> list[str]:
    """Names of the photos below `folder`, hidden files apart, in the order people number them (IMG_9 before IMG_10).

    Raises:
        FileNotFoundError: no such folder.
        ValueError: fewer than 3 photos in it.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder, expected one with photos")
    files = [f.relative_to(folder) for f in folder.rglob("*") if f.is_file()]
    files = [f for f in files if not any(part.startswith(".") for part in f.parts)]
    names = sorted((f.as_posix() for f in files if f.suffix.lower() in SUFFIXES), key=_natural)
    if len(names) < MIN_PHOTOS:
        kinds = Counter(f.suffix.lower() for f in files)
        others = [f"{kinds[s]} {s}: convert to JPEG or PNG first" for s in CONVERTIBLE if kinds[s]]
        others += [f"{kinds[s]} {s}: take photos from the film first" for s in FILMS if kinds[s]]
        found = "; ".join([f"{len(names) or 'none'}", *others])
        raise ValueError(f"{folder}: expected at least {MIN_PHOTOS} photos ({', '.join(SUFFIXES)}), found {found}")
    return names


def _natural(name: str) -> list:
    """Sort key in which numbers count as numbers; the name itself decides between 01 and 1."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", name)] + [(-1, name)]


def read_photos(folder: Path, names: Sequence[str], done: Callable[[int], None]) -> list[Photo]:
    """Decode every photo once, so that a damaged one is named before hours of work, and read its EXIF.

    Raises:
        ValueError: a photo cannot be decoded.
    """
    photos = []
    with ThreadPoolExecutor() as pool:  # decoding frees the GIL
        jobs = [pool.submit(_read_photo, folder, name) for name in names]
        try:
            for count, job in enumerate(jobs, start=1):
                photos.append(job.result())
                done(count)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return photos


def _read_photo(folder: Path, name: str) -> Photo:
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
    return Photo(name, (width, height), _device(path), focal)


def _device(path: Path) -> tuple[str, str]:
    from PIL import Image

    try:
        with Image.open(path) as image:
            exif = image.getexif()
            return str(exif.get(MAKE, "")), str(exif.get(MODEL, ""))
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, struct.error):  # damaged EXIF says nothing
        return "", ""


def camera_groups(folder: Path, photos: Sequence[Photo], cameras: str) -> list[list[Photo]]:
    """Split photos into those that share a camera.

    Raises:
        ValueError: photos that shall share a camera differ in size.
    """
    keys = {
        "auto": lambda p: (p.size, p.device, p.focal and round(p.focal)),
        "single": lambda p: (),
        "folder": lambda p: p.name.rpartition("/")[0],
        "image": lambda p: p.name,
    }
    groups: dict[object, list[Photo]] = {}
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


def camera_model(group: Sequence[Photo], options: SfmOptions) -> str:
    """COLMAP's name of the camera model of photos that share one."""
    if options.camera_model != "auto":
        return options.camera_model.upper()
    return "OPENCV" if len(group) >= MANY else "SIMPLE_RADIAL"


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
