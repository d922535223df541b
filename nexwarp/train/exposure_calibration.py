"""Estimates each training photo's exposure and the lens's vignetting, before training."""

from collections.abc import Sequence

import numpy as np
import torch

from nexwarp.camera import Camera
from nexwarp.data import Scene
from nexwarp.representation.exposures import (
    DECIMALS,
    EVEN,
    Exposures,
)
from nexwarp.train.config import Config

# 8-bit values beyond these are clipped, or too dark to tell a ratio.
CLIPPED = (8, 247)

ROUNDS = 6  # rounds of reweighted least squares
NOISE = 0.05  # noise of log colours; larger differences count as outliers
PRIOR = 0.1  # weight of the prior for a gain of 1, in observations
EVEN_PRIOR = 1.0  # weight of the prior for a lens without falloff, in observations
FURTHER = 1.3  # the falloff is extrapolated to this many times the largest squared tangent of an observed point


def photo_gains(
    cameras: Sequence[Camera],
    photos: Sequence[torch.Tensor],
    points: Sequence[torch.Tensor],
    masks: Sequence[torch.Tensor | None] | None = None,
) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Estimate the log gains of photos and the falloff of their lens, from points that several photos show.

    A point's colour in a photo is modelled as its own colour, times the photo's gain, times the falloff of the lens, a
    function of the angle to the optical axis that all photos share (`Exposures`). The logarithms are fitted by least
    squares, reweighted so that highlights and occluders do not count. Priors keep photos with few points near the mean
    gain, and the lens near no falloff.

    Args:
        cameras: cameras of the V photos.
        photos: (H, W, 3) uint8 each.
        points: (M, 3) each, world positions triangulated from the photo; a shared point has the same bits in each.
        masks: (H, W) bool each, True where the photo counts; None where all of it counts.

    Returns:
        Log gains (V, 3) float64 with mean 0, and the falloff (a, b, largest squared tangent) of `Exposures`.
    """
    count = len(cameras)
    view, point, color, squares = _observations(cameras, photos, points, masks)
    gains = np.zeros((count, 3))
    if len(view) == 0:
        return gains, EVEN
    largest = max(min(FURTHER * float(squares.max()), max(_corner(camera) for camera in cameras)), 10.0**-DECIMALS)
    largest = round(largest, DECIMALS)
    t = squares / largest
    powers = np.stack([t, t**2], axis=1)
    lens = np.zeros(2)
    weights = np.ones(color.shape)
    for _ in range(ROUNDS):
        observed = color - (powers @ lens)[:, None]
        for channel in range(3):
            gains[:, channel] = _solve_gains(view, point, observed[:, channel], weights[:, channel], count)
        lens = _solve_lens(point, powers, color - gains[view], weights)
        left = color - gains[view] - (powers @ lens)[:, None]
        left -= _means(point, left, weights)
        weights = 1 / (1 + (left / NOISE) ** 2)
    a, b = lens.round(DECIMALS).tolist()
    return gains.round(DECIMALS), (a, b, largest)


def _observations(
    cameras: Sequence[Camera],
    photos: Sequence[torch.Tensor],
    points: Sequence[torch.Tensor],
    masks: Sequence[torch.Tensor | None] | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return all observations of points in photos.

    Returns:
        Indices of the photo (M,) and of the point (M,), log colour (M, 3), squared tangent of the angle to the axis
        (M,).
    """
    views, places, colors, squares = [], [], [], []
    masks = [None] * len(cameras) if masks is None else masks
    for index, (camera, photo, seen, mask) in enumerate(zip(cameras, photos, points, masks, strict=True)):
        pixels, depths = camera.project(seen)
        inside = (depths > 0) & (pixels >= 0).all(1)
        inside &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        column, row = pixels[inside].long().unbind(1)
        color = photo[row, column]
        usable = (color >= CLIPPED[0]).all(1) & (color <= CLIPPED[1]).all(1)
        if mask is not None:
            usable &= mask[row, column]
        x, y = pixels[inside][usable].double().unbind(1)
        squares.append((((x - camera.cx) / camera.fx) ** 2 + ((y - camera.cy) / camera.fy) ** 2).numpy())
        colors.append(color[usable].double().div(255).log().numpy())
        places.append(seen[inside][usable].numpy())
        views.append(np.full(len(colors[-1]), index))
    _, point = np.unique(np.concatenate(places), axis=0, return_inverse=True)
    return np.concatenate(views), point.reshape(-1), np.concatenate(colors), np.concatenate(squares)


def _corner(camera: Camera) -> float:
    """Squared tangent between the optical axis and the farthest corner of the image."""
    x, y = max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy
    return x**2 + y**2


def _solve_gains(view: np.ndarray, point: np.ndarray, observed: np.ndarray, w: np.ndarray, count: int) -> np.ndarray:
    """Log gains (V,), mean 0, of one channel, by least squares with weights (M,)."""
    from scipy.sparse import coo_array, csc_array, diags_array, eye_array
    from scipy.sparse.linalg import spsolve

    # The points' own colours, eliminated, leave a Laplacian of the photos.
    totals = 1 / np.bincount(point, w).clip(1e-9)
    shared = coo_array((w, (view, point)), shape=(count, len(totals))).tocsr()
    normal = diags_array(np.bincount(view, w, count)) - shared @ diags_array(totals) @ shared.T
    right = np.bincount(view, w * observed, count) - shared @ (totals * np.bincount(point, w * observed))
    found = spsolve(csc_array(normal + PRIOR * eye_array(count)), right)
    return found - found.mean()


def _solve_lens(point: np.ndarray, powers: np.ndarray, observed: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Factors (2,) of the lens's powers (M, 2) in log colours (M, 3) without gains, by weighted least squares."""
    normal, right = EVEN_PRIOR * np.eye(2), np.zeros(2)
    for channel in range(3):
        w = weights[:, channel : channel + 1].repeat(2, axis=1)
        apart = powers - _means(point, powers, w)
        normal += apart.T @ (w * apart)
        right += apart.T @ (w[:, 0] * observed[:, channel])
    return np.linalg.solve(normal, right)


def _means(point: np.ndarray, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """For each of values (M, C) the weighted mean over those of its point."""
    means = [
        np.bincount(point, w * x) / np.bincount(point, w).clip(1e-9) for x, w in zip(values.T, weights.T, strict=True)
    ]
    return np.stack(means, axis=1)[point]


def calibrate_exposures(scene: Scene, config: Config) -> tuple[Exposures, torch.Tensor] | tuple[None, None]:
    """Of the training photos, and each one's gains (V, 3), which exposures have of some alone where photos are many.

    None where the photos have one exposure by their nature, or no points tell theirs.
    """
    rendered = scene.background is not None or scene.random_background
    if not config.exposures or rendered or config.mask_mode == "background":
        return None, None
    seen = [view.points if view.points is not None else scene.points[:0] for view in scene.train]
    if sum(map(len, seen)) == 0:
        return None, None
    cameras = [view.camera for view in scene.train]
    photos, masks = [view.image for view in scene.train], [view.mask for view in scene.train]
    log_gains, falloff = photo_gains(cameras, photos, seen, masks)
    found = torch.from_numpy(log_gains)
    return Exposures.of(found, cameras, falloff if config.vignetting else None), found.float().exp()
