"""Thumbnails of the scene's cameras: their photos, or renderings where there are none."""

import logging
from collections.abc import Callable, Mapping

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.model.model import Model
from nexwarp.viewer.modes import Settings, draw
from nexwarp.viewer.world import Viewpoint, camera_to_world, vertical_fov

SIDE = 96  # pixels along the longer side
log = logging.getLogger(__name__)


def of_photos(photos: Mapping[str, Callable[[], torch.Tensor]]) -> dict[str, np.ndarray]:
    """Reduce photos to thumbnails; one that cannot be read has none.

    Args:
        photos: functions that return an (H, W, 3) uint8 photo, by name.
    """
    from PIL import Image

    thumbnails: dict[str, np.ndarray] = {}
    for name, photo in photos.items():
        try:
            image = Image.fromarray(photo().numpy())
            image.thumbnail((SIDE, SIDE))
            thumbnails[name] = np.asarray(image)
        except (OSError, ValueError, RuntimeError, MemoryError) as error:
            log.warning("%s has no thumbnail: %s", name, error)
    return thumbnails


def of_camera(model: Model, camera: Camera, near: float) -> np.ndarray:
    """Render a thumbnail; a black one if that fails, for example out of memory.

    Args:
        model: the model to render.
        camera: the camera of a photo.
        near: near depth, world units.
    """
    here = Viewpoint(camera_to_world(camera), vertical_fov(camera), camera.width, camera.height)
    try:
        small = here.bands(min(SIDE / max(camera.width, camera.height), 1.0), near, model.surfels.means)
        picture = draw(model, small, Settings(max_hits=model.options.max_hits))
    except (ValueError, RuntimeError, MemoryError) as error:
        log.warning("a camera has no thumbnail: %s", error)
        return np.zeros((1, 1, 3), dtype=np.uint8)
    assert picture is not None  # never stale
    return picture.pixels
