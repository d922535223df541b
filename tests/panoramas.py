"""Helpers turn cameras, and look up in a panorama what a pinhole camera sees."""

import math

import torch

import nexwarp as nw

MARGIN = 3  # pixels around a window, for the interpolation


def turned(viewmat: torch.Tensor, yaw: float, pitch: float) -> torch.Tensor:
    """A viewmat after the camera was turned about its own centre."""
    c, s, d, e = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    around = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=torch.float64)
    up = torch.tensor([[1, 0, 0], [0, d, e], [0, -e, d]], dtype=torch.float64)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = up @ around
    return (motion @ viewmat.double().cpu()).to(viewmat)


def crop(camera: nw.Camera, turn: tuple[float, float], width: int) -> nw.Camera:
    """The camera, turned by a yaw and a pitch, with pixels as large as those of a panorama of `width` pixels."""
    factor = width / (2 * math.pi) / camera.focal
    K = camera.K.clone()
    K[:2] *= factor
    size = round(camera.width * factor), round(camera.height * factor)
    return nw.Camera(turned(camera.viewmat, *turn), K, *size, camera.near)


def sampled(model: nw.Model, viewmat: torch.Tensor, camera: nw.Camera, width: int) -> torch.Tensor:
    """Look up a pinhole's pixels in a panorama at the mean exposure, by bicubic interpolation.

    Only the window of the panorama that the pinhole sees is rendered; it must not cross the panorama's border.

    Args:
        model: the model, on the CPU or a GPU.
        viewmat: (4, 4) of the panorama, at the pinhole's place.
        camera: the pinhole.
        width: pixels of the whole panorama.

    Returns:
        (H, W, 3) image, not clamped.
    """
    turn = (camera.viewmat[:3, :3].double() @ viewmat[:3, :3].double().T).cpu()
    rays = nw.RayCamera.pinhole(camera).rays.double().cpu() @ turn
    x, y = places(rays, width)
    left, top = int(x.min()) - MARGIN, int(y.min()) - MARGIN
    right, bottom = int(x.max()) + MARGIN + 1, int(y.max()) + MARGIN + 1
    longitude = ((torch.arange(left, right).double() + 0.5) / width - 0.5) * 2 * math.pi
    latitude = ((torch.arange(top, bottom).double() + 0.5) / (width // 2) - 0.5) * math.pi
    latitude, longitude = torch.meshgrid(latitude, longitude, indexing="ij")
    across = latitude.cos()
    window = torch.stack([longitude.sin() * across, latitude.sin(), longitude.cos() * across], -1).to(viewmat)
    image = model.render(nw.RayCamera(viewmat, window, camera.near, width / (2 * math.pi)), exposure="mean").image
    height, columns = image.shape[:2]
    at = torch.stack([(x - left) / columns, (y - top) / height], -1) * 2 - 1
    layers = image.permute(2, 0, 1)[None]
    found = torch.nn.functional.grid_sample(layers, at.to(image)[None], mode="bicubic", align_corners=False)
    return found[0].permute(1, 2, 0)


def places(rays: torch.Tensor, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixel coordinates x and y (H, W) of rays (H, W, 3) in an equirectangular panorama's frame."""
    units = torch.nn.functional.normalize(rays, dim=-1)
    x = (torch.atan2(units[..., 0], units[..., 2]) / (2 * math.pi) + 0.5) * width
    return x, (torch.asin(units[..., 1].clamp(-1, 1)) / math.pi + 0.5) * (width // 2)
