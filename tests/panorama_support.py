"""Turned cameras, and where rays lie in a panorama."""

import math

import torch


def turned(viewmat: torch.Tensor, yaw: float, pitch: float) -> torch.Tensor:
    """A viewmat after the camera was turned about its own centre."""
    c, s, d, e = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    around = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=torch.float64)
    up = torch.tensor([[1, 0, 0], [0, d, e], [0, -e, d]], dtype=torch.float64)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = up @ around
    return (motion @ viewmat.double().cpu()).to(viewmat)


def places(rays: torch.Tensor, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixel coordinates x and y (H, W) of rays (H, W, 3) in an equirectangular panorama's frame."""
    units = torch.nn.functional.normalize(rays, dim=-1)
    x = (torch.atan2(units[..., 0], units[..., 2]) / (2 * math.pi) + 0.5) * width
    return x, (torch.asin(units[..., 1].clamp(-1, 1)) / math.pi + 0.5) * (width // 2)
