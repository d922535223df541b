"""From a photo's file to a view: masks, transparency, undistortion, reduction."""

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath

import numpy as np
import torch

from nexwarp.camera import Camera
from nexwarp.data.cache import PhotoCache
from nexwarp.data.capture import Photo
from nexwarp.data.images import (
    compose,
    downscale_image,
    downscale_mask,
    image_size,
    read_image,
    read_mask,
    read_transparent,
    resize_mask,
)
from nexwarp.data.lens import FACES, PANORAMA, Lens, Maps, Pinhole
from nexwarp.io.files import one_line

MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG")
OPAQUE = 255
# A small camera's photo is not decoded when it is huge: one of a single colour takes hardly a byte in its file.
MAX_ENLARGED, SMALL = 16, 1024
HALF = 128  # alpha of a pixel that counts


@dataclass(frozen=True)
class View:
    """One posed photo.

    Attributes:
        camera: its pinhole camera, float32 on the CPU, in pixels of `image`.
        image: (H, W, 3) uint8 sRGB on the CPU; a transparent photo lies on the scene's background.
        mask: (H, W) bool, True where the photo counts; None when all of it does.
        name: name of the photo below the images folder.
        alpha: (H, W) uint8, 255 where the photo is opaque; None when all of it is, or when the scene has no
            background for transparent photos. On another background B the photo is
            image + (1 - alpha / 255) (B - background), in sRGB.
        points: (M, 3) float32 world positions of the sparse points that were triangulated from the photo; None when
            unknown. They may lie outside the image where a lens was undistorted.
    """

    camera: Camera
    image: torch.Tensor
    mask: torch.Tensor | None
    name: str
    alpha: torch.Tensor | None = None
    points: torch.Tensor | None = None


@dataclass(frozen=True)
class Job:
    """A photo whose header is read.

    Attributes:
        photo: the photo.
        size: width and height of its file.
        target: the pinhole image that it becomes, before it is reduced.
    """

    photo: Photo
    size: tuple[int, int]
    target: Pinhole


class ViewReader:
    """Reads views; safe to use from several threads."""

    def __init__(
        self,
        *,
        downscale: int,
        background: tuple[float, float, float] | None,
        alpha_mask: bool,
        cache: PhotoCache,
    ) -> None:
        """Choose how views are made.

        Args:
            downscale: average blocks of this many pixels squared.
            background: colour behind transparent photos; None drops their alpha.
            alpha_mask: let alpha of one half and more be the mask.
            cache: where undistorted photos are kept.
        """
        self.downscale, self.background, self.alpha_mask, self.cache = downscale, background, alpha_mask, cache
        self.maps = Maps()

    def plan(self, photo: Photo) -> list[Job]:
        """Read a photo's header and check it against its lens; a panorama becomes six jobs."""
        size = width, height = image_size(photo.file)
        lens = photo.lens
        # One pixel of the longer side's rounding may go either way when a folder like images_4 was made.
        if abs(width * lens.height - height * lens.width) > max(lens.width, lens.height):
            raise ValueError(
                f"{photo.file}: expected an image of {lens.width}x{lens.height} pixels, or that shape at another "
                f"size, got {width}x{height}"
            )
        _check_enlarged(photo.file, size, (lens.width, lens.height), "its camera")
        if photo.mask is not None and not self.alpha_mask:
            _check_mask(photo, size)
        try:
            target = _pinhole(lens)
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"{photo.file}: the camera of this image is not usable: {one_line(error)}") from error
        ratio = width / lens.width, height / lens.height
        target = target.resized(
            *(max(round(a * b), 1) for a, b in zip((target.width, target.height), ratio, strict=True))
        )
        if self.downscale > min(target.width, target.height):
            raise ValueError(
                f"downscale: expected at most the size of {photo.file}, {target.width}x{target.height}, "
                f"got {self.downscale}"
            )
        if lens.model != PANORAMA:
            return [Job(photo, size, target)]
        return [Job(_face(photo, face), size, target) for face in FACES]

    def read(self, job: Job, near: float) -> View:
        """Read, undistort and reduce a photo."""
        photo = job.photo
        image, alpha, mask = self._undistorted(job) if photo.lens.distorted else self._pixels(job, None)
        if mask is not None and mask.all():
            mask = None
        if mask is not None and not mask.any():
            raise ValueError(f"{photo.mask or photo.file}: expected a mask with pixels that count, got none")
        K = job.target.K.copy()
        K[:2] /= self.downscale
        try:
            camera = Camera(
                torch.from_numpy(photo.viewmat).float(),
                torch.from_numpy(K).float(),
                image.shape[1],
                image.shape[0],
                near,
            )
        except ValueError as error:
            raise ValueError(f"{photo.file}: the camera of this image is not usable: {error}") from error
        points = None if photo.points is None else torch.from_numpy(photo.points)
        return View(camera, image, mask, photo.name, alpha, points)

    def _pixels(self, job: Job, maps: Maps | None) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """Image, alpha and mask, reduced; by way of a map where the lens needs one."""
        photo = job.photo
        if self.background is None and not self.alpha_mask:
            image, alpha = read_image(photo.file), None
        else:
            image, alpha = read_transparent(photo.file)
        mask = _mask(photo, image, alpha if self.alpha_mask else None)
        if self.background is None or (alpha is not None and bool((alpha == OPAQUE).all())):
            alpha = None
        if alpha is not None:
            image = compose(image, alpha, self.background)
        if maps is not None:
            way = maps.get(photo.lens, job.target, photo.face)
            image, mask = way.colors(image), way.mask(mask)
            alpha = way.colors(alpha[:, :, None])[:, :, 0] if alpha is not None else None
        image = downscale_image(image, self.downscale)
        mask = downscale_mask(mask, self.downscale) if mask is not None else None
        alpha = downscale_image(alpha[:, :, None], self.downscale)[:, :, 0] if alpha is not None else None
        return image, alpha, mask

    def _undistorted(self, job: Job) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """As `_pixels`, from the cache where it has them."""
        photo, target = job.photo, job.target
        settings = (
            photo.lens,
            photo.face,
            target.width,
            target.height,
            self.downscale,
            self.background,
            self.alpha_mask,
        )
        mask_bytes = b"" if photo.mask is None or self.alpha_mask else photo.mask.read_bytes()
        key = self.cache.key(repr(settings).encode(), target.K.tobytes(), photo.file.read_bytes(), mask_bytes)
        kept = self.cache.load(key, target.height // self.downscale, target.width // self.downscale)
        if kept is not None:
            pixels, mask = kept
            alpha = pixels[:, :, 3].contiguous() if pixels.shape[2] == 4 else None
            return pixels[:, :, :3].contiguous(), alpha, mask
        image, alpha, mask = self._pixels(job, self.maps)
        self.cache.save(key, image if alpha is None else torch.cat([image, alpha[:, :, None]], dim=2), mask)
        return image, alpha, mask


@lru_cache(maxsize=4096)
def _pinhole(lens: Lens) -> Pinhole:
    return lens.pinhole()


def _face(photo: Photo, face: str) -> Photo:
    name = PurePosixPath(photo.name)
    turn = np.eye(4)
    turn[:3, :3] = FACES[face]
    named = str(name.with_name(f"{name.stem}_{face}{name.suffix}"))
    return dataclasses.replace(photo, name=named, viewmat=turn @ photo.viewmat, face=face)


def find_mask(folder: Path, name: str) -> Path | None:
    """The mask of a photo in a folder of masks: the photo's name with .png after it, or its stem with any suffix."""
    path = folder / name
    for candidate in (path.with_name(f"{path.name}.png"), *(path.with_suffix(suffix) for suffix in MASK_SUFFIXES)):
        if candidate.is_file():
            return candidate
    return None


def _mask(photo: Photo, image: torch.Tensor, alpha: torch.Tensor | None) -> torch.Tensor | None:
    """(H, W) bool in the photo's pixels; masks of the same shape at another size are resampled."""
    if alpha is not None:
        return alpha >= HALF
    if photo.mask is None:
        return None
    height, width = image.shape[:2]
    mask = read_mask(photo.mask)
    return mask if mask.shape == (height, width) else resize_mask(mask, width, height)


def _check_mask(photo: Photo, size: tuple[int, int]) -> None:
    """Compare a mask's header with its photo's size, before it is decoded."""
    width, height = size
    columns, rows = image_size(photo.mask)
    if abs(columns * height - rows * width) > max(width, height, columns, rows):
        raise ValueError(
            f"{photo.mask}: expected a mask of {width}x{height} pixels as {photo.file.name} has, or that shape at "
            f"another size, got {columns}x{rows}"
        )
    _check_enlarged(photo.mask, (columns, rows), size, "its photo")


def _check_enlarged(file: Path, size: tuple[int, int], expected: tuple[int, int], what: str) -> None:
    if max(size) > max(MAX_ENLARGED * max(expected), SMALL):
        raise ValueError(
            f"{file}: expected an image of at most {MAX_ENLARGED} times the size of {what}, "
            f"{expected[0]}x{expected[1]}, got {size[0]}x{size[1]}"
        )
