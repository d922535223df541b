"""Read the views of a scene: masks, transparency, undistortion and reduction of photos."""

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any

import numpy as np
import torch
from torch.utils.data._utils.collate import collate, default_collate_fn_map

from nexwarp.cameras.camera import Camera
from nexwarp.data.capture import Photo
from nexwarp.data.depth_files import read_depth
from nexwarp.data.images import (
    Color,
    compose,
    downscale_image,
    downscale_mask,
    image_size,
    read_mask,
    read_transparent,
    resize_nearest,
)
from nexwarp.data.lens import FACES, PANORAMA, Intrinsics, Lens, Map, undistortion
from nexwarp.io.files import one_line

OPAQUE = 255
# A side larger than both, the ratio in those of the camera, is refused before decoding.
MAX_ENLARGED, SMALL = 16, 1024
KEPT_MAPS = 6  # for the faces of a panorama
SHAPE_TOLERANCE = 0.02  # of the ratio of a depth map's sides: networks have sides that are multiples of 14, say
HALF = 128  # smallest alpha of a used pixel, with alpha as the mask

undistorted = lru_cache(maxsize=4096)(Lens.undistorted)


@dataclass(frozen=True)
class View:
    """A posed photo with its pixels.

    Attributes:
        camera: its pinhole camera, float32 on the CPU, in pixels of `image`.
        image: (H, W, 3) uint8 sRGB on the CPU; a transparent photo is composited on the scene's background.
        mask: (H, W) bool, True for the pixels that are used; None if all are.
        name: path of the photo below the images folder.
        alpha: (H, W) uint8, 255 for opaque pixels; None if all are opaque, or if the scene has no background for
            transparent photos. On another background B the photo is
            image + (1 - alpha / 255) (B - background), in sRGB.
        points: (M, 3) float32 world positions of the sparse points that were triangulated from the photo; None if
            unknown. Points of an undistorted photo may project outside the image.
        depth: (H, W) float16 z-depths of a training photo's depth map, world units, 0 where unknown; None without.
    """

    camera: Camera
    image: torch.Tensor
    mask: torch.Tensor | None
    name: str
    alpha: torch.Tensor | None = None
    points: torch.Tensor | None = None
    depth: torch.Tensor | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return what a batch of a torch `DataLoader` is made of, which is how views collate.

        `image` (H, W, 3) uint8, `mask` (H, W) bool, all True where all pixels count, `viewmat` (4, 4) and `K` (3, 3)
        float32, `near`, `width`, `height` and `name`.
        """
        camera = self.camera
        mask = torch.ones(self.image.shape[:2], dtype=torch.bool) if self.mask is None else self.mask
        numbers = {"near": camera.near, "width": camera.width, "height": camera.height, "name": self.name}
        return {"image": self.image, "mask": mask, "viewmat": camera.viewmat, "K": camera.K, **numbers}


def _collate(views: list[View], *, collate_fn_map: Any = None) -> Any:
    return collate([view.as_dict() for view in views], collate_fn_map=collate_fn_map)


default_collate_fn_map[View] = _collate


@dataclass(frozen=True)
class PlannedView:
    """A view before its pixels are read."""

    photo: Photo  # or a face of it if it is a panorama
    size: tuple[int, int]  # width and height of its file in pixels
    target: Intrinsics  # after undistortion, before the reduction


@dataclass
class ViewReader:
    """Reads views; thread-safe."""

    downscale: int  # factor by which images are reduced, averaging blocks of pixels
    background: Color | None  # behind transparent photos; None drops their alpha
    alpha_mask: bool  # use alpha >= 128 as the mask
    white: float | None  # as of `read_image`
    positions: np.ndarray | None  # (P, 3) float32 of the capture's points
    near: float  # of all cameras
    origin: tuple[float, float, float]  # of all cameras

    def __post_init__(self) -> None:
        self._maps, self._lock = lru_cache(KEPT_MAPS)(undistortion), Lock()

    def plan(self, photo: Photo) -> list[PlannedView]:
        """Read the header of a photo and check it against its lens; return one view, or six for a panorama."""
        size, lens = image_size(photo.file), photo.lens
        # Tolerance: the size of a reduced image, as in a folder images_4, is rounded by up to one pixel.
        full = (lens.width, lens.height)
        _check_shape(photo.file, size, full, "an image", max(full))
        if photo.mask is not None and not self.alpha_mask:
            shape = image_size(photo.mask)
            _check_shape(photo.mask, shape, size, "a mask", max(*size, *shape), photo)
        try:
            target = undistorted(lens)
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"{photo.file}: the camera of this image is not usable: {one_line(error)}") from error
        ratio = size[0] / lens.width, size[1] / lens.height
        target = target.resized(
            *(max(round(a * b), 1) for a, b in zip((target.width, target.height), ratio, strict=True))
        )
        if self.downscale > min(target.width, target.height):
            raise ValueError(
                f"downscale: expected at most the size of {photo.file}, {target.width}x{target.height}, "
                f"got {self.downscale}"
            )
        if lens.model != PANORAMA:
            return [PlannedView(photo, size, target)]
        return [PlannedView(_face(photo, face), size, target) for face in FACES]

    def read(self, plan: PlannedView) -> View:
        """Read, undistort and reduce a photo."""
        photo = plan.photo
        image, alpha, mask = self._pixels(plan)
        depth = None if photo.depth is None else self._depth(plan, photo.depth)
        if mask is not None and mask.all():
            mask = None
        if mask is not None and not mask.any():
            raise ValueError(f"{photo.mask or photo.file}: expected a mask with pixels that count, got none")
        target = plan.target
        K = torch.tensor([[target.fx, 0, target.cx], [0, target.fy, target.cy], [0, 0, 1]], dtype=torch.float64)
        K[:2] /= self.downscale
        try:
            viewmat = torch.from_numpy(photo.viewmat).float()
            camera = Camera(viewmat, K.float(), image.shape[1], image.shape[0], self.near, origin=self.origin)
        except ValueError as error:
            raise ValueError(f"{photo.file}: the camera of this image is not usable: {error}") from error
        points = None
        if photo.points is not None and self.positions is not None:
            points = torch.from_numpy(self.positions[photo.points])
        return View(camera, image, mask, photo.name, alpha, points, depth)

    def _pixels(self, plan: PlannedView) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """Read image, alpha and mask, undistort and reduce them."""
        photo = plan.photo
        image, alpha = read_transparent(photo.file, self.white)
        mask = _mask(photo, image, alpha if self.alpha_mask else None)
        if self.background is None or (alpha is not None and bool((alpha == OPAQUE).all())):
            alpha = None
        elif alpha is not None:
            image = compose(image, alpha, self.background)
        if photo.lens.distorted:
            undistort = self._map(plan)
            image, mask = undistort.colors(image), undistort.mask(mask)
            alpha = undistort.colors(alpha[:, :, None])[:, :, 0] if alpha is not None else None
        image = downscale_image(image, self.downscale)
        mask = downscale_mask(mask, self.downscale) if mask is not None else None
        alpha = downscale_image(alpha[:, :, None], self.downscale)[:, :, 0] if alpha is not None else None
        return image, alpha, mask

    def _map(self, plan: PlannedView) -> Map:
        with self._lock:  # photos that share a lens wait for its map
            return self._maps(plan.photo.lens, plan.target, plan.photo.face)

    def _depth(self, plan: PlannedView, file: Path) -> torch.Tensor:
        """Read a depth map and resample it to the view by nearest neighbours: means would lie between two surfaces."""
        if plan.photo.face is not None:
            raise ValueError(f"{file}: expected no depth map of a panorama, which cannot be used")
        values, (width, height) = read_depth(file), plan.size
        rows, columns = values.shape
        slack = SHAPE_TOLERANCE * columns * height
        _check_shape(file, (columns, rows), plan.size, "a depth map", slack, plan.photo)
        if plan.photo.lens.distorted:
            values = self._map(plan).nearest(values.float()).half()
        else:
            values = resize_nearest(values, width, height)
        step, (height, width) = self.downscale, values.shape
        middle = slice(step // 2, None, step)
        return values[middle, middle][: height // step, : width // step].contiguous()


def _face(photo: Photo, face: str) -> Photo:
    name = PurePosixPath(photo.name)
    turn = np.eye(4)
    turn[:3, :3] = FACES[face]
    named = str(name.with_name(f"{name.stem}_{face}{name.suffix}"))
    return dataclasses.replace(photo, name=named, viewmat=turn @ photo.viewmat, face=face)


def _mask(photo: Photo, image: torch.Tensor, alpha: torch.Tensor | None) -> torch.Tensor | None:
    """The mask of a photo, (H, W) bool; a mask of another size is resampled."""
    if alpha is not None:
        return alpha >= HALF
    if photo.mask is None:
        return None
    height, width = image.shape[:2]
    mask = read_mask(photo.mask)
    return mask if mask.shape == (height, width) else resize_nearest(mask, width, height)


def _check_shape(
    file: Path, size: tuple[int, int], expected: tuple[int, int], what: str, slack: float, photo: Photo | None = None
) -> None:
    """Raise ValueError unless width and height have the ratio of those expected, of a photo or else of its camera.

    They may be at most 16 times as large: tiny files can hold huge images.
    """
    wanted, got = f"{expected[0]}x{expected[1]}", f"{size[0]}x{size[1]}"
    if abs(size[0] * expected[1] - size[1] * expected[0]) > slack:
        whose = "" if photo is None else f" as {photo.file.name} has"
        raise ValueError(f"{file}: expected {what} of {wanted} pixels{whose}, or that shape at another size, got {got}")
    if max(size) > max(MAX_ENLARGED * max(expected), SMALL):
        whose = "its camera" if photo is None else "its photo"
        raise ValueError(
            f"{file}: expected an image of at most {MAX_ENLARGED} times the size of {whose}, {wanted}, got {got}"
        )
