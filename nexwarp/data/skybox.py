"""Points on a sphere around the scene, where the surfels of a background start. Not in the paper.

Structure from motion finds few points in sky and in blurred backgrounds. Without surfels there, the background colour
shows, or surfels that are too near stretch over it. Both are wrong in a held-out view. Where the cloud has points, a
sphere would be too far.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch

from nexwarp.cameras.camera import in_image
from nexwarp.data.points import InitialPoints
from nexwarp.data.views import View
from nexwarp.machine import in_threads

RADIUS = 2.0  # of the sphere, in units of the distance that nearly all points have from the cameras' mean
NEARLY_ALL = 0.99
SAMPLES = 4096  # directions by which the seen share of the sphere is estimated
LEAST_SHARE = 1 / 64  # where photos show less of the sphere than this, there are fewer points
MOST_VIEWS = 256  # that are asked, evenly chosen
GAP = 0.03  # in image diagonals: a point of the cloud within this distance is near one of the sphere
MOST_POINTS = 100_000  # of the cloud, evenly chosen: more would not fill other gaps


def skybox_points(views: Sequence[View], points: torch.Tensor, count: int) -> InitialPoints:
    """Choose even points on a sphere around the cameras and the points, where photos show no point of the cloud.

    The radius is twice the distance from the cameras' mean that 99 % of the points have, or that all cameras have,
    whichever is larger. Of the photos that show a point's direction, more than half have no point of the cloud within
    3 % of their diagonal there. A point's colour is the mean of the photos' pixels that it projects to, whatever is in
    front of it. Masked pixels show nothing.

    Takes points (P, 3) of the scene, world frame, and returns at most `count`, none if photos show none. Normals point
    to the cameras' mean; a scale is half the distance between neighbours.
    """
    chosen = torch.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).round().long().tolist()
    judges = [views[index] for index in chosen]
    positions = torch.stack([view.camera.position.double() for view in views])
    centre = positions.mean(0)
    reach = (points.double() - centre).norm(dim=1).sort().values[int(NEARLY_ALL * (len(points) - 1))]
    radius = RADIUS * torch.maximum(reach, (positions - centre).norm(dim=1).max())
    share = (_looks(judges, centre + radius * directions(SAMPLES), points[:0])[1] > 0).double().mean().item()
    total = math.ceil(count / max(share, LEAST_SHARE))
    towards = directions(total)
    cloud = points[:: math.ceil(len(points) / MOST_POINTS)]
    sums, seen, empty = _looks(judges, centre + radius * towards, cloud)
    kept = (2 * empty > seen).nonzero()[:, 0]
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


def _looks(views: Sequence[View], points: torch.Tensor, cloud: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return what views show of points (N, 3): sums (N, 3) of colours in [0, 1] and numbers (N,) of views.

    The third, (N,), is how many of these views show no point of the cloud (M, 3) near it.
    """
    sums, seen = torch.zeros(len(points), 3, dtype=torch.float64), torch.zeros(len(points), dtype=torch.int64)
    empty = torch.zeros_like(seen)
    for shown, colors, alone in in_threads(lambda view: _look(view, points, cloud), views):
        sums[shown] += colors
        seen[shown] += 1
        empty[shown] += alone
    return sums, seen, empty


def _look(view: View, points: torch.Tensor, cloud: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the indices (M,) of the points that a view shows, their colours (M, 3), and whether they are alone."""
    from scipy.spatial import cKDTree

    camera = view.camera
    pixels, depths = camera.project(points.float())
    shown = in_image(pixels, depths, camera.width, camera.height).nonzero()[:, 0]
    column, row = pixels[shown].long().unbind(1)
    if view.mask is not None:
        used = view.mask[row, column]
        shown, column, row = shown[used], column[used], row[used]
    around, depths = camera.project(cloud.float())
    around = around[in_image(around, depths, camera.width, camera.height)]
    # Balancing the tree would take longer than the few searches.
    tree = cKDTree(around.numpy(), compact_nodes=False, balanced_tree=False)
    gap = GAP * math.hypot(camera.width, camera.height)
    nearest, _ = tree.query(pixels[shown].numpy(), distance_upper_bound=gap)  # infinite beyond it
    return shown, view.image[row, column].double() / 255, torch.from_numpy(np.isinf(nearest))
