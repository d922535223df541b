"""Photos of 360 degrees: which are equirectangular panoramas, and the six pinhole views that each is cut into."""

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from nexwarp.data.images import image_size, read_image
from nexwarp.data.lens import FACES, PANORAMA, Lens, pycolmap_module, undistortion
from nexwarp.data.sfm.photos import InputPhoto, link
from nexwarp.io.pictures import save_jpeg, save_png

if TYPE_CHECKING:
    import pycolmap
else:
    pycolmap = pycolmap_module()

FOLDER, FRONT = "panorama_{}", "front"  # folder of the views of a face
STEP = 8  # rows, of which one is looked at
CLOSED = 0.45  # mean difference, relative to the usual one, below which edges meet
LEVEL = 1.0  # grey level: least usual difference
JPEG, JPEG_QUALITY = (".jpg", ".jpeg"), 97


def cut_panoramas(
    source: Path, names: Sequence[str], panoramas: Collection[str], folder: Path, done: Callable[[int], None]
) -> dict[str, str]:
    """Fill a folder with photos: panoramas cut into the faces of a cube, views of one size, and the others linked.

    Returns name -> photo that it is of. The six views of a panorama are panorama_FACE/NAME, in a row. `done` is called
    with the number of panoramas that are cut. OSError: `folder` cannot be written.
    """
    origins: dict[str, str] = {}
    width = max(image_size(source / name)[0] for name in panoramas)
    view, maps, count = sphere(width).undistorted(), lru_cache(len(FACES))(undistortion), 0
    for name in names:
        if name not in panoramas:
            link(source / name, folder / name)
            origins[name] = name
            continue
        pixels, kind = read_image(source / name), PurePosixPath(name).suffix.lower()
        for face in FACES:
            part = f"{FOLDER.format(face)}/{name if kind in (*JPEG, '.png') else name + '.jpg'}"
            colors = maps(sphere(pixels.shape[1]), view, face).colors(pixels)
            if kind == ".png":
                save_png(folder / part, colors)
            else:
                save_jpeg(folder / part, colors, JPEG_QUALITY)
            origins[part] = name
        count += 1
        done(count)
    return origins


def sphere(width: int) -> Lens:
    """The lens of a panorama of this width in pixels."""
    return Lens(PANORAMA, (float(width), width / 2), width, width // 2)


def view_groups(photos: Sequence[InputPhoto]) -> list[list[InputPhoto]]:
    """Group the views of panoramas by face, each with a camera of its own, whose focal length is known."""
    known = [replace(photo, focal=photo.size[0] / 2) for photo in photos]
    return [known[face :: len(FACES)] for face in range(len(FACES) if known else 0)]


def rig() -> pycolmap.RigConfig:
    """How the views of a panorama lie around its centre."""
    config = pycolmap.RigConfig()
    config.cameras = [
        pycolmap.RigConfigCamera(
            ref_sensor=face == FRONT,
            image_prefix=f"{FOLDER.format(face)}/",
            cam_from_rig=None if face == FRONT else pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(turn)), np.zeros(3)),
        )
        for face, turn in FACES.items()
    ]
    return config


def find_panoramas(folder: Path, names: Sequence[str]) -> set[str]:
    """Return the names of equirectangular panoramas: twice as wide as high, and closed, or XMP (GPano) says so.

    All photos of one size are panoramas if at least half of them are. A photo that cannot be read is none.
    """
    by_size: dict[tuple[int, int], dict[str, bool]] = {}
    for name in names:
        with suppress(ValueError):
            width, height = image_size(folder / name)
            if width == 2 * height:
                by_size.setdefault((width, height), {})[name] = _is_panorama(folder / name)
    return {name for group in by_size.values() if 2 * sum(group.values()) >= len(group) for name in group}


def _is_panorama(file: Path) -> bool:
    from PIL import Image

    with Image.open(file) as image:
        told = "equirectangular" in str(image.info.get("xmp"))
    return told or is_closed(read_image(file).numpy())


def is_closed(pixels: np.ndarray) -> bool:
    """Whether the left edge of an (H, W, 3) uint8 picture continues the right one, and top and bottom are points.

    The mean of three differences, each relative to a usual one, is 0.03 to 0.16 for panoramas of the demo, and at least
    0.56 for 801 pictures cut 2 to 1 of photos of five scenes.
    """
    quarter = pixels.shape[1] // 4
    left, right, top, bottom = (edge.astype(int) for edge in (pixels[:, 0], pixels[:, -1], pixels[0], pixels[-1]))
    rows = pixels[::STEP].astype(int)
    along, across = np.abs(left - left.mean(axis=0)).mean(), np.abs(rows - np.roll(rows, quarter, axis=1)).mean()
    poles = [np.abs(edge - np.roll(edge, quarter, axis=0)).mean() / max(across, LEVEL) for edge in (top, bottom)]
    return bool(along > LEVEL and np.abs(left - right).mean() / along + sum(poles) < 3 * CLOSED)
