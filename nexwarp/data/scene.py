"""A scene: posed photos, split into training and test views, and the sparse points they were posed with."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from nexwarp.camera import Camera
from nexwarp.data.colmap import ColmapModel, Photo, read_model
from nexwarp.data.images import downscale_image, read_image

TEST_EVERY = 8  # the field's split: of the views sorted by name, those with index % 8 == 0 are for testing
NEAR_FRACTION = 0.01  # near plane, in units of the scene scale
SCALE_MARGIN = 1.1


@dataclass(frozen=True)
class View:
    """One posed photo.

    Attributes:
        camera: its pinhole camera, float32 on the CPU, in pixels of `image`.
        image: (H, W, 3) uint8 sRGB on the CPU.
        mask: (H, W) bool, True where the photo counts; None when all of it does.
        name: name of the photo below the images folder.
    """

    camera: Camera
    image: torch.Tensor
    mask: torch.Tensor | None
    name: str


@dataclass(frozen=True)
class Scene:
    """What training sees and what it is judged by, in COLMAP's world frame and units.

    Attributes:
        train: views to learn from, sorted by name.
        test: views to judge by, never to learn from, sorted by name.
        points: (P, 3) float32 sparse points.
        colors: (P, 3) uint8 sRGB of the points.
        track_lengths: (P,) int32, how many photos a point was triangulated from.
        reprojection_errors: (P,) float32, mean over the track, in pixels of the COLMAP cameras; -1 when
            unknown.
        scale: 1.1 times the largest distance of a training camera from their mean, in world units; with all
            of them in one place, the median distance of the points from there.
        path: the folder it was read from.
    """

    train: list[View]
    test: list[View]
    points: torch.Tensor
    colors: torch.Tensor
    track_lengths: torch.Tensor
    reprojection_errors: torch.Tensor
    scale: float
    path: Path


def load_scene(path: str | os.PathLike, images: str = "images", downscale: int = 1) -> Scene:
    """Read a COLMAP scene: undistorted photos, and a model in sparse/0, in sparse or in the folder itself.

    Photos of another size than the COLMAP cameras (images_2, images_4, ...) scale the intrinsics by the ratio
    of the sizes, an axis at a time. Every camera's near depth is 0.01 of the scene scale.

    Args:
        path: folder of the scene.
        images: folder of the photos, inside `path`.
        downscale: average blocks of this many pixels squared; what fills no block is cropped.

    Returns:
        The scene, all tensors on the CPU.

    Raises:
        FileNotFoundError: no such folder, no model, no images folder, or a photo of the model is absent.
        TypeError: `downscale` is not an int.
        ValueError: `downscale` < 1 or larger than a photo, a damaged model or photo, a camera that is no
            pinhole, a photo whose shape is not its camera's, fewer than 2 photos, no points, points that are
            not finite.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    if not isinstance(images, str):
        raise TypeError(f"images: expected the name of a folder, got {type(images).__name__}")
    path = Path(path)
    _check_downscale(downscale)
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder, expected a COLMAP scene")
    model = read_model(path)
    if len(model.photos) < 2:
        raise ValueError(f"{model.folder}: expected at least 2 registered images (1 to train, 1 to test), got 1")
    folder = _images_folder(path, images)
    scale = _scene_scale(model)
    with ThreadPoolExecutor() as pool:  # decoding frees the GIL
        views = list(
            pool.map(
                lambda photo: _view(photo, folder / photo.name, downscale, NEAR_FRACTION * scale),
                model.photos,
            )
        )
    return Scene(
        train=[view for index, view in enumerate(views) if index % TEST_EVERY != 0],
        test=views[::TEST_EVERY],
        points=torch.from_numpy(model.points.astype(np.float32)),
        colors=torch.from_numpy(model.colors),
        track_lengths=torch.from_numpy(model.track_lengths),
        reprojection_errors=torch.from_numpy(model.reprojection_errors),
        scale=scale,
        path=path,
    )


def _check_downscale(downscale: int) -> None:
    if isinstance(downscale, bool) or not isinstance(downscale, int):
        raise TypeError(f"downscale: expected an int, got {type(downscale).__name__}")
    if downscale < 1:
        raise ValueError(f"downscale: expected at least 1, got {downscale}")


def _images_folder(path: Path, images: str) -> Path:
    folder = path / images
    if not folder.is_dir():
        found = sorted(entry.name for entry in path.glob("images*") if entry.is_dir())
        there = ", ".join(found) if found else "no folder images*"
        raise FileNotFoundError(f"images: no folder {images!r} in {path}, which has {there}")
    return folder


def _scene_scale(model: ColmapModel) -> float:
    train = [photo.viewmat for index, photo in enumerate(model.photos) if index % TEST_EVERY != 0]
    centres = np.array([-viewmat[:3, :3].T @ viewmat[:3, 3] for viewmat in train])
    mean = centres.mean(axis=0)
    radius = float(np.linalg.norm(centres - mean, axis=1).max())
    distance = float(np.median(np.linalg.norm(model.points - mean, axis=1)))
    # A camera that only turns is at one place but for rounding: its centres are computed from its poses.
    scale = SCALE_MARGIN * radius if radius > 1e-6 * distance else distance
    if not 0 < scale < float("inf"):
        raise ValueError(f"{model.folder}: cannot tell the scene's scale: cameras and points give {scale}")
    return scale


def _view(photo: Photo, path: Path, downscale: int, near: float) -> View:
    image = read_image(path)
    height, width = image.shape[:2]
    # One pixel of the longer side's rounding may go either way when a folder like images_4 was made.
    if abs(width * photo.height - height * photo.width) > max(photo.width, photo.height):
        raise ValueError(
            f"{path}: expected an image of {photo.width}x{photo.height} pixels, or that shape at another "
            f"size, got {width}x{height}"
        )
    if downscale > min(width, height):
        raise ValueError(f"downscale: expected at most the size of {path}, {width}x{height}, got {downscale}")
    K = photo.K.copy()
    K[0] *= width / photo.width / downscale
    K[1] *= height / photo.height / downscale
    image = downscale_image(image, downscale)
    try:
        camera = Camera(
            torch.from_numpy(photo.viewmat).float(),
            torch.from_numpy(K).float(),
            image.shape[1],
            image.shape[0],
            near,
        )
    except ValueError as error:
        raise ValueError(f"{path}: the COLMAP camera of this image is not usable: {error}") from error
    return View(camera, image, None, photo.name)
