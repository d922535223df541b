"""Thumbnails of the scene's cameras: their photos, or renderings where there are none."""

import logging
from collections.abc import Callable, Mapping

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.model.model import Model
from nexwarp.viewer.modes import Settings, draw
from nexwarp.viewer.world import Viewpoint

SIDE = 96  # pixels along the longer side
log = logging.getLogger(__name__)


def of_photos(photos: Mapping[str, Callable[[], torch.Tensor]]) -> dict[str, np.ndarray]:
    """Reduce photos to thumbnails; `photos` returns an (H, W, 3) uint8 photo by name, and unreadable ones have none."""
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
    """Render a thumbnail of a photo's camera; a black one if that fails, for example out of memory."""
    try:
        scale = min(SIDE / max(camera.width, camera.height), 1.0)
        bands = Viewpoint.of_camera(camera).bands(scale, near, model.surfels.means)
        picture = draw(model, bands, Settings(max_hits=model.options.max_hits))
    except (ValueError, RuntimeError, MemoryError) as error:
        log.warning("a camera has no thumbnail: %s", error)
        return np.zeros((1, 1, 3), dtype=np.uint8)
    assert picture is not None  # never stale
    return picture.pixels
