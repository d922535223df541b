"""Random points for a scene without points, in the region that its cameras look at."""

from collections.abc import Sequence

import numpy as np
import torch

from nexwarp.cameras.camera import in_image
from nexwarp.data.capture import Cloud
from nexwarp.data.views import View

COUNT = 100_000
ROUNDS = 20  # largest number of draws
NEAREST, FARTHEST = 0.3, 3.0  # depths relative to the distance of the cameras' focus
UNKNOWN_DEPTHS = (1.0, 30.0)  # depths relative to the scene's scale, without a common focus
MIN_CONVERGENCE = 1e-3  # ratio of eigenvalues below which optical axes count as parallel
HULL_VIEWS = 24  # largest number of views that check a point


def random_points(views: Sequence[View], scale: float, count: int = COUNT, seed: int = 0) -> Cloud:
    """Draw random points in the views' frustums, with the colours of their pixels.

    Depths are log-uniform between 0.3 and 3 times the distance to the point nearest to all optical axes or, for
    parallel axes, between 1 and 30 times the scene's `scale`, world units. Points that only one view sees are dropped.
    So are points that a photo shows as fully transparent, as they lie outside the visual hull. Returns between 1 and
    `count` points, in the world frame.
    """
    rng = np.random.default_rng(seed)
    viewmats = np.stack([view.camera.viewmat.numpy().astype(np.float64) for view in views])
    centres = -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    depths = _depths(viewmats, centres, scale)
    judges = [views[index] for index in np.unique(np.linspace(0, len(views) - 1, HULL_VIEWS).round().astype(int))]
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    first: list[tuple[np.ndarray, np.ndarray]] = []
    total = 0
    for _ in range(ROUNDS):
        points, colors = _draw(views, viewmats, centres, depths, rng, count)
        keep = _plausible(judges, points, 2 if len(views) > 1 else 1)
        kept.append((points[keep], colors[keep]))
        first = first or [(points, colors)]
        total += int(keep.sum())
        if total >= count:
            break
    if not total:  # all photos are transparent, or no two views see a common point
        kept = first
    positions, colors = (np.concatenate(parts)[:count] for parts in zip(*kept, strict=True))
    return Cloud.of(positions, colors)


def _depths(viewmats: np.ndarray, centres: np.ndarray, scale: float) -> np.ndarray:
    """(V, 2) smallest and largest depth for each view."""
    axes = viewmats[:, 2, :3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    values = np.linalg.eigvalsh(total)
    if values[0] > MIN_CONVERGENCE * values[-1]:
        focus = np.linalg.solve(total, np.einsum("vij,vj->i", across, centres))
        ahead = ((focus - centres) * axes).sum(axis=1)
        if (ahead > 0).mean() > 0.5:
            distance = np.where(ahead > 0, ahead, np.median(ahead[ahead > 0]))
            return distance[:, None] * np.array([NEAREST, FARTHEST])
    return np.tile(np.array(UNKNOWN_DEPTHS) * scale, (len(viewmats), 1))


def _draw(
    views: Sequence[View],
    viewmats: np.ndarray,
    centres: np.ndarray,
    depths: np.ndarray,
    rng: np.random.Generator,
    count: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw `count` pixels and depths; return world positions (count, 3) and colours (count, 3) uint8."""
    chosen = np.sort(rng.integers(0, len(views), count))
    depth = np.exp(rng.uniform(np.log(depths[chosen, 0]), np.log(depths[chosen, 1])))
    where = rng.uniform(0.0, 1.0, (count, 2))
    points = np.empty((count, 3))
    colors = np.empty((count, 3), np.uint8)
    for index in np.unique(chosen):
        here = chosen == index
        camera, image = views[index].camera, views[index].image
        pixels = where[here] * [camera.width, camera.height]
        rays = np.ones((len(pixels), 3))
        rays[:, :2] = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        points[here] = centres[index] + (rays * depth[here, None]) @ viewmats[index, :3, :3]
        colors[here] = image.numpy()[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    return points, colors


def _plausible(judges: Sequence[View], points: np.ndarray, least: int) -> np.ndarray:
    """(N,) bool: at least `least` views have the point in their frustum, and none shows it as fully transparent."""
    seen = np.zeros(len(points), int)
    empty = np.zeros(len(points), bool)
    for view in judges:
        camera = view.camera
        pixels, depths = camera.to(torch.float64).project(torch.from_numpy(points))
        inside = in_image(pixels, depths, camera.width, camera.height) & (depths > camera.near)
        seen += inside.numpy()
        if view.alpha is not None:
            column, row = pixels[inside].long().unbind(1)
            empty[inside.numpy()] |= (view.alpha[row, column] == 0).numpy()
    return (seen >= least) & ~empty
