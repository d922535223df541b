"""Figures of a trained scene beside those of its test views: training views, close views, small views."""

import statistics
from collections.abc import Callable

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.data import Scene
from nexwarp.data.images import downscale_image, downscale_mask
from nexwarp.io.pictures import to_uint8
from nexwarp.run.metrics import psnr

RenderImage = Callable[[Camera], torch.Tensor]  # (H, W, 3), not clamped, on any device
ZOOM = 4
REDUCTION = 4


@torch.no_grad()
def train_psnr(scene: Scene, image: RenderImage) -> float:
    """Return the mean PSNR of every 8th training view, in dB."""
    views = scene.train[::8]
    return statistics.fmean(psnr(to_uint8(image(view.camera)).cpu(), to_uint8(view.image)) for view in views)


@torch.no_grad()
def zoom_psnr(scene: Scene, image: RenderImage) -> float:
    """Return the mean PSNR of the test views' centres, rendered at 4 times the focal length, in dB.

    Each is reduced by 4 again and compared with the same part of the rendering at the photo's size.
    """
    figures = []
    for view in scene.test:
        c = view.camera
        width, height = c.width // ZOOM, c.height // ZOOM
        left, top = (c.width - width) // 2, (c.height - height) // 2
        K = c.K.clone()
        K[:2] *= ZOOM
        close = Camera(c.viewmat, K, c.width * ZOOM, c.height * ZOOM, c.near)
        close = close.crop(left * ZOOM, top * ZOOM, width * ZOOM, height * ZOOM)
        zoomed = image(close).clamp(0, 1).permute(2, 0, 1)
        reduced = torch.nn.functional.avg_pool2d(zoomed, ZOOM).permute(1, 2, 0)
        plain = image(c)[top : top + height, left : left + width]
        figures.append(psnr(to_uint8(reduced).cpu(), to_uint8(plain).cpu()))
    return statistics.fmean(figures)


@torch.no_grad()
def quarter_psnr(scene: Scene, image: RenderImage) -> float:
    """Return the mean PSNR of the test views at a quarter of the size, against their photos reduced by 4, in dB."""
    figures = []
    for view in scene.test:
        small = to_uint8(image(smaller(view.camera, REDUCTION))).cpu()
        mask = None if view.mask is None else downscale_mask(view.mask, REDUCTION)
        figures.append(psnr(small, downscale_image(to_uint8(view.image), REDUCTION), mask))
    return statistics.fmean(figures)


def smaller(camera: Camera, factor: int) -> Camera:
    """Return a camera whose pixels are blocks of `factor` x `factor` pixels, as `downscale_image` makes them."""
    K = camera.K.clone()
    K[:2] /= factor
    return Camera(camera.viewmat, K, camera.width // factor, camera.height // factor, camera.near)
