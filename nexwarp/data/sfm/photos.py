"""The photos of a reconstruction: listing, decoding, EXIF, and grouping by camera."""

import math
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from nexwarp.data.capture import safe_name, short
from nexwarp.data.images import (
    EXIF_ERRORS,
    MAKE,
    MODEL,
    copy_upright,
    decodable_formats,
    image_size,
    is_turned,
    read_image,
    read_in_threads,
)
from nexwarp.data.lens import pycolmap_module
from nexwarp.data.scene import GIB, SHARE
from nexwarp.data.sfm.report import SfmOptions
from nexwarp.errors import OutOfMemoryError
from nexwarp.machine import available_memory

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")  # formats that both PIL and pycolmap 4.2 decode
CONVERTED = {".heic": "HEIF", ".heif": "HEIF", ".avif": "AVIF", ".webp": "WEBP"}  # to JPEG, where PIL decodes them
OTHERS = (*CONVERTED, ".exr", ".gif", ".jp2", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf")
FILMS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
SECOND = "another file of that name is used"
MIN_PHOTOS = 3
MANY = 5  # photos of one camera that determine the eight parameters of OPENCV
PIXEL_BYTES = 12  # of memory, to decode or undistort a photo, a pixel
FEATURE_BYTES = 240  # of memory, to find SIFT features, a pixel of the reduced photo
MOST_DECODED = 2 * GIB  # memory of the photos that are decoded at once, if there are several


@dataclass(frozen=True)
class InputPhoto:
    """A photo before reconstruction, without a pose."""

    name: str  # in the scene: path below the photos' folder, with "/" as separator; .jpg if it was converted
    size: tuple[int, int]  # width and height in pixels, upright
    device: tuple[str, str]  # make and model of the camera from EXIF, empty if absent
    focal: float | None  # in pixels from EXIF; None if absent


def list_photos(folder: Path) -> tuple[list[str], dict[str, str]]:
    """Names of the photos below `folder`, without hidden files, in numeric order (IMG_9 before IMG_10).

    The second value names those in other formats that are not used, with the reason. ValueError: the folder has fewer
    than 3 photos, or one that is a link out of it or has a name that no scene can have.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder, expected one with photos")
    files = [f.relative_to(folder) for f in folder.rglob("*") if f.is_file()]
    files = [f for f in files if not any(part.startswith(".") for part in f.parts)]
    names, skipped = [f.as_posix() for f in files if f.suffix.lower() in SUFFIXES], {}
    taken, formats = {_stem(name) for name in names}, decodable_formats()
    for file in sorted(f.as_posix() for f in files if f.suffix.lower() in OTHERS):
        kind = Path(file).suffix.lower()
        if _stem(file) in taken:  # phones write one photo in two formats
            skipped[file] = SECOND
        elif CONVERTED.get(kind) in formats:
            taken.add(_stem(file))
            names.append(file)
        else:
            package = ", or pip install pillow-heif" if CONVERTED.get(kind) == "HEIF" else ""
            skipped[file] = f"{kind}: convert to JPEG or PNG first{package}"
    names = sorted(names, key=_natural)
    if len(names) < MIN_PHOTOS:
        kinds = Counter(f.suffix.lower() for f in files)
        others = [f"{count} {reason}" for reason, count in Counter(skipped.values()).items()]
        others += [f"{kinds[s]} {s}: give the film itself to nexwarp process" for s in FILMS if kinds[s]]
        there = "; ".join([f"{len(names) or 'none'}", *others])
        raise ValueError(f"{folder}: expected at least {MIN_PHOTOS} photos ({', '.join(SUFFIXES)}), found {there}")
    for name in names:
        safe_name(f"{folder}: photo", name, "folder of the photos")
        if not (folder / name).resolve().is_relative_to(folder.resolve()):
            raise ValueError(f"{folder}: photo {short(name)}: a link leaves the folder; put the photo itself there")
    return names, skipped


def _stem(name: str) -> str:
    """What two files of one photo have in common."""
    return str(PurePosixPath(name).with_suffix("")).casefold()


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key that compares digits as numbers; the name itself decides between 01 and 1."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", name)] + [(-1, name)]


def affordable_threads(folder: Path, names: Sequence[str], options: SfmOptions) -> int:
    """Return how many threads may hold a photo at once, by the sizes that the files' headers give.

    OutOfMemoryError: there is too little memory for the largest photo.
    """
    sizes = {"": 1}
    for name in names:
        with suppress(ValueError):  # one that cannot be read is left out later
            sizes[name] = math.prod(image_size(folder / name))
    name, pixels = max(sizes.items(), key=lambda item: item[1])
    searched = min(pixels, options.max_image_size**2)
    each = PIXEL_BYTES * pixels + FEATURE_BYTES * searched
    free = available_memory()
    if each > free:
        raise OutOfMemoryError(
            f"{folder / name}: {pixels / 1e6:.0f} megapixels need {each / GIB:.1f} GiB of memory, of which "
            f"{free / GIB:.1f} GiB are free; reduce the photos, or give a smaller --max-image-size",
            f"{each / GIB:.1f} GiB",
        )
    most = options.threads or os.cpu_count() or 1
    return max(1, min(most, int(SHARE * free) // each, max(MOST_DECODED // (PIXEL_BYTES * pixels), 1)))


def read_photos(
    folder: Path, names: Sequence[str], threads: int, done: Callable[[int], None], prepared: Path, strict: bool = True
) -> tuple[list[InputPhoto], dict[str, str]]:
    """Decode every photo, `threads` at once, and read its EXIF; return also name -> reason of those that fail.

    `prepared` gets what pycolmap is to read: links to the photos, and copies of those that are turned or no format of
    pycolmap. `done` is called with the number of photos that were read. ValueError: fewer than 3 photos are left, or,
    if `strict`, one cannot be read.
    """

    def read(name: str) -> InputPhoto | str:
        """Return a photo, or the reason why it cannot be read."""
        try:
            return _read_photo(folder, name, prepared)
        except ValueError as error:
            if strict or isinstance(error.__cause__, MemoryError):
                raise
            return str(error).removeprefix(f"{folder / name}: ")

    results = dict(zip(names, read_in_threads(read, names, threads, done), strict=True))
    photos = [photo for photo in results.values() if isinstance(photo, InputPhoto)]
    skipped = {name: reason for name, reason in results.items() if isinstance(reason, str)}
    if skipped and len(photos) < MIN_PHOTOS:
        name, reason = next(iter(skipped.items()))
        there = f"{len(photos) or 'none'} of {len(names)}; {name}: {reason}"
        raise ValueError(f"{folder}: expected at least {MIN_PHOTOS} photos that can be read, found {there}")
    return photos, skipped


def _read_photo(folder: Path, name: str, prepared: Path) -> InputPhoto:
    original, converted = folder / name, Path(name).suffix.lower() in CONVERTED
    name = PurePosixPath(name).with_suffix(".jpg").as_posix() if converted else name
    path = prepared / name
    if converted or is_turned(original):
        pixels = copy_upright(original, path)
    else:
        pixels = read_image(original)
        link(original, path)
    height, width = pixels.shape[:2]
    del pixels  # before pycolmap reads it
    try:
        camera = pycolmap_module().infer_camera_from_image(str(path))
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{original}: pycolmap cannot decode it; save it anew as JPEG or PNG, or remove it") from error
    if (camera.width, camera.height) != (width, height):
        raise ValueError(f"{original}: expected {width}x{height}, pycolmap reads {camera.width}x{camera.height}")
    focal = camera.focal_length if camera.has_prior_focal_length else None
    return InputPhoto(name, (width, height), _device(path), focal)


def link(file: Path, target: Path) -> None:
    """Make `target` a link to a file, with its folders; a copy where the system allows no links."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        target.symlink_to(file.absolute())
    except OSError:  # Windows allows it to administrators only
        shutil.copyfile(file, target)


def _device(path: Path) -> tuple[str, str]:
    from PIL import Image

    try:
        with Image.open(path) as image:
            exif = image.getexif()
            return str(exif.get(MAKE, "")), str(exif.get(MODEL, ""))
    except EXIF_ERRORS:  # damaged EXIF counts as absent
        return "", ""


def camera_groups(folder: Path, photos: Sequence[InputPhoto], cameras: str) -> list[list[InputPhoto]]:
    """Group photos that share a camera by `SfmOptions.cameras`; ValueError where photos of one differ in size.

    Portrait and landscape photos have a camera each.
    """
    keys: dict[str, Callable[[InputPhoto], object]] = {
        "auto": lambda p: (p.size, p.device, p.focal and round(p.focal)),
        "single": lambda p: p.size[0] < p.size[1],
        "folder": lambda p: (p.name.rpartition("/")[0], p.size[0] < p.size[1]),
        "image": lambda p: p.name,
    }
    groups: dict[object, list[InputPhoto]] = {}
    for photo in photos:
        groups.setdefault(keys[cameras](photo), []).append(photo)
    for group in groups.values():
        for photo in group:
            if photo.size != group[0].size:
                one, other = (f"{p.size[0]}x{p.size[1]} ({p.name})" for p in (group[0], photo))
                raise ValueError(
                    f"{folder}: photos of one camera must have one size, got {one} and {other}; "
                    f"expected --cameras auto or image rather than {cameras}"
                )
    return list(groups.values())


def camera_model(group: Sequence[InputPhoto], options: SfmOptions) -> str:
    """COLMAP's name of the camera model for photos that share a camera."""
    if options.camera_model != "auto":
        return options.camera_model.upper()
    return "OPENCV" if len(group) >= MANY else "SIMPLE_RADIAL"
