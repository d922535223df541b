"""Cameras for a scene that has none: a ring around its points."""

import math

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import look_at

WIDTH, HEIGHT = 1280, 720  # pixels
FOV = 0.9  # vertical, radians
DISTANCE = 3.0  # of the cameras from the middle, in median distances of the points from there
RISE = 0.3  # height of the ring above the middle, as a fraction of its radius
UP = (0.0, -1.0, 0.0)  # of most COLMAP models


def surrounding(points: torch.Tensor, near: float, count: int = 12) -> list[Camera]:
    """Return cameras on a ring around the median of points (N, 3), which they look at, with up direction -y.

    The radius is three times the median distance of the points from their median. The cameras have 1280 x 720 pixels, a
    vertical field of view of 0.9 rad and the near depth `near`, float32 on the CPU.
    """
    positions = points.detach().double().cpu()
    middle = positions.median(dim=0).values if len(positions) else torch.zeros(3, dtype=torch.float64)
    spread = (positions - middle).norm(dim=1).median().item() if len(positions) else 1.0
    radius = DISTANCE * (spread or 1.0)
    up = torch.tensor(UP, dtype=torch.float64)
    focal = 0.5 * HEIGHT / math.tan(0.5 * FOV)
    K = torch.tensor([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
    cameras: list[Camera] = []
    for index in range(count):
        angle = 2.0 * math.pi * index / count
        offset = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)], dtype=torch.float64) + RISE * up
        cameras.append(Camera(look_at(middle + radius * offset, middle, up).float(), K.clone(), WIDTH, HEIGHT, near))
    return cameras
