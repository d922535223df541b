"""Points on a sphere around the scene, where the surfels of a background start. Not in the paper.

Structure from motion finds few points in sky and in blurred backgrounds. Without surfels there, the background colour
shows, or surfels that are too near stretch over it. Both are wrong in a held-out view.
"""

import math
from collections.abc import Sequence

import torch

from nexwarp.camera import in_image
from nexwarp.data.points import InitialPoints
from nexwarp.data.views import View

RADIUS = 2.0  # of the sphere, in units of the distance that nearly all points have from the cameras' mean
NEARLY_ALL = 0.99
SAMPLES = 4096  # directions by which the seen share of the sphere is estimated
LEAST_SHARE = 1 / 64  # where photos show less of the sphere than this, there are fewer points
MOST_VIEWS = 256  # that are asked, evenly chosen


def skybox_points(views: Sequence[View], points: torch.Tensor, count: int) -> InitialPoints:
    """Choose even points on a sphere around the cameras and the points, in the directions that photos show.

    The radius is twice the distance from the cameras' mean that 99 % of the points have, or that all cameras have,
    whichever is larger. A point's colour is the mean of the photos' pixels that it projects to, whatever is in front of
    it. Masked pixels show nothing.

    Args:
        views: training views; at least one.
        points: (P, 3) of the scene, world frame; P >= 1.
        count: roughly the number of points, 1 or more.

    Returns:
        At most `count` points, none if no photo shows any. Normals point to the cameras' mean; a scale is half the
        distance between neighbours.

    Raises:
        ValueError: `count` is below 1.
    """
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    chosen = torch.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).round().long().tolist()
    judges = [views[index] for index in chosen]
    positions = torch.stack([view.camera.position.double() for view in views])
    centre = positions.mean(0)
    reach = (points.double() - centre).norm(dim=1).sort().values[int(NEARLY_ALL * (len(points) - 1))]
    radius = RADIUS * torch.maximum(reach, (positions - centre).norm(dim=1).max())
    share = (_colors(judges, centre + radius * directions(SAMPLES))[1] > 0).double().mean().item()
    total = math.ceil(count / max(share, LEAST_SHARE))
    towards = directions(total)
    sums, seen = _colors(judges, centre + radius * towards)
    kept = (seen > 0).nonzero()[:, 0]
    kept = kept[torch.linspace(0, len(kept) - 1, min(count, len(kept))).round().long()]  # left out all over the sphere
    spacing = radius * math.sqrt(4 * math.pi / total)
    return InitialPoints(
        means=(centre + radius * towards[kept]).float(),
        colors=(sums[kept] / seen[kept, None]).float(),
        scales=torch.full((len(kept),), 0.5 * float(spacing)),
        normals=-towards[kept].float(),
    )


def directions(count: int) -> torch.Tensor:
    """Return (count, 3) unit vectors of nearly equal spacing: a Fibonacci lattice."""
    rows = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * rows / count
    angles = math.pi * (1 + math.sqrt(5)) * rows
    across = (1 - z * z).sqrt()
    return torch.stack([across * angles.cos(), across * angles.sin(), z], dim=1)


def _colors(views: Sequence[View], points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the sums (N, 3) of the colours in [0, 1] at which views show points (N, 3), and how many (N,) do."""
    sums, seen = torch.zeros(len(points), 3, dtype=torch.float64), torch.zeros(len(points), dtype=torch.int64)
    for view in views:
        camera = view.camera
        pixels, depths = camera.project(points.float())
        inside = in_image(pixels, depths, camera.width, camera.height).nonzero()[:, 0]
        column, row = pixels[inside].long().unbind(1)
        if view.mask is not None:
            used = view.mask[row, column]
            inside, column, row = inside[used], column[used], row[used]
        sums[inside] += view.image[row, column].double() / 255
        seen[inside] += 1
    return sums, seen
