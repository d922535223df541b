"""Points for a scene that has none: spread over what its cameras look at."""

from collections.abc import Sequence

import numpy as np

from nexwarp.data.capture import Cloud

COUNT = 100_000
ROUNDS = 20
NEAREST, FARTHEST = 0.3, 3.0  # in units of the distance to what the cameras look at
UNKNOWN_DEPTHS = (1.0, 30.0)  # in units of the scene's scale, where they look at nothing in common
MIN_CONVERGENCE = 1e-3
HULL_VIEWS = 24


def random_points(views: Sequence, scale: float, count: int = COUNT, seed: int = 0) -> Cloud:
    """Random points in the views' frustums, with the colours of the pixels that they were drawn from.

    Depths are log-uniform around the distance to the place nearest to all optical axes, or, where the axes are
    parallel, over 1 to 30 times the scene's scale. Points that only one view sees are dropped, and so are points that
    some photo shows as fully transparent: they lie outside the visual hull.

    Args:
        views: training views, with `camera`, `image` and `alpha`.
        scale: of the scene, in world units.
        count: points wanted; fewer come where hardly any place passes.
        seed: of the choice, which is always the same.

    Returns:
        At least one point, in the world frame.
    """
    rng = np.random.default_rng(seed)
    viewmats = np.stack([view.camera.viewmat.numpy().astype(np.float64) for view in views])
    centres = -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    depths = _depths(viewmats, centres, scale)
    judges = [views[index] for index in np.unique(np.linspace(0, len(views) - 1, HULL_VIEWS).round().astype(int))]
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    spare: tuple[np.ndarray, np.ndarray] | None = None
    found = 0
    for _ in range(ROUNDS):
        points, colors = _draw(views, viewmats, centres, depths, rng, count)
        keep = _plausible(judges, points, 2 if len(views) > 1 else 1)
        kept.append((points[keep], colors[keep]))
        spare = spare or (points, colors)
        found += int(keep.sum())
        if found >= count:
            break
    if not found:  # the photos show nothing but transparency, or no two of them the same place
        kept = [spare]
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
    views: Sequence, viewmats: np.ndarray, centres: np.ndarray, depths: np.ndarray, rng: np.random.Generator, count: int
) -> tuple[np.ndarray, np.ndarray]:
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


def _plausible(judges: Sequence, points: np.ndarray, least: int) -> np.ndarray:
    """Whether enough views have a point in their frustum, and none of them shows it as fully transparent."""
    seen = np.zeros(len(points), int)
    empty = np.zeros(len(points), bool)
    for view in judges:
        camera = view.camera
        local = points @ camera.viewmat[:3, :3].numpy().T + camera.viewmat[:3, 3].numpy()
        ahead = local[:, 2] > camera.near
        depth = np.where(ahead, local[:, 2], 1.0)
        x = local[:, 0] / depth * camera.fx + camera.cx
        y = local[:, 1] / depth * camera.fy + camera.cy
        inside = ahead & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        seen += inside
        if view.alpha is not None:
            alpha = view.alpha.numpy()[y[inside].astype(int), x[inside].astype(int)]
            empty[np.flatnonzero(inside)[alpha == 0]] = True
    return (seen >= least) & ~empty
