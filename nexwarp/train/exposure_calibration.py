"""Estimates each training photo's exposure and the lens's vignetting, before training; decides whether to use them."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from nexwarp.cameras.camera import Camera, in_image
from nexwarp.data import Scene
from nexwarp.model.exposures import (
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

MARGIN = 0.01  # share of the error at held-out points by which gains must lower it, and then the falloff
MOST_CHECKED = 20_000  # largest number of points that this choice looks at

MOST_DENSE = 300  # photos: up to 263 a dense matrix of them was solved faster than a sparse one, from 500 on slower

Falloff = tuple[float, float, float]


@dataclass(frozen=True)
class ExposureCalibration:
    """What the training photos tell of their exposures.

    Attributes:
        exposures: predict the gains of other cameras.
        gains: (V, 3) gains of the V training photos.
        colors: (P, 3) float32 in [0, 1], colours of the scene's points at the mean exposure.
    """

    exposures: Exposures
    gains: torch.Tensor
    colors: torch.Tensor


Calibrate = Callable[[Scene, Config], ExposureCalibration | None]


class Observations(NamedTuple):
    """M observations of P points in photos.

    Attributes:
        view: (M,) index of the photo.
        point: (M,) index of the point.
        color: (M, 3) log colour.
        squares: (M,) squared tangent of the angle to the optical axis.
        places: (P, 3) positions of the points, float32.
    """

    view: np.ndarray
    point: np.ndarray
    color: np.ndarray
    squares: np.ndarray
    places: np.ndarray

    def of_points(self, chosen: np.ndarray) -> "Observations":
        """Return the observations of those points for which `chosen` (P,) is True."""
        kept = chosen[self.point]
        return Observations(self.view[kept], self.point[kept], self.color[kept], self.squares[kept], self.places)


class Fit(NamedTuple):
    """Exposures fitted to observations.

    Attributes:
        gains: (V, 3) log gains with mean 0.
        lens: (2,) factors of t and t^2 in the logarithm of the falloff, where t = squares / largest.
        largest: largest squared tangent of an observed point.
    """

    gains: np.ndarray
    lens: np.ndarray
    largest: float

    def unexposed(self, seen: Observations) -> np.ndarray:
        """Return the log colours (M, 3) of observations without gains and falloff."""
        return seen.color - self.gains[seen.view] - (_powers(seen, self.largest) @ self.lens)[:, None]


def photo_gains(
    cameras: Sequence[Camera],
    photos: Sequence[torch.Tensor],
    points: Sequence[torch.Tensor],
    masks: Sequence[torch.Tensor | None] | None = None,
) -> tuple[np.ndarray, Falloff]:
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
    seen = observations(cameras, photos, points, masks)
    if len(seen.view) == 0:
        return np.zeros((len(cameras), 3)), EVEN
    fit = fit_exposures(seen, cameras)
    return fit.gains, _falloff(fit)


def fit_exposures(seen: Observations, cameras: Sequence[Camera], *, vignetting: bool = True) -> Fit:
    """Fit gains, and with `vignetting` the falloff of the lens, to one observation or more."""
    largest = max(min(FURTHER * float(seen.squares.max()), max(map(_corner, cameras))), 10.0**-DECIMALS)
    fit = Fit(np.zeros((len(cameras), 3)), np.zeros(2), round(largest, DECIMALS))
    powers = _powers(seen, fit.largest)
    weights, shared = np.ones(seen.color.shape), SharedPoints(seen.view, seen.point, len(cameras))
    for _ in range(ROUNDS):
        observed = seen.color - (powers @ fit.lens)[:, None]
        for channel in range(3):
            columns = observed[:, channel], weights[:, channel]
            fit.gains[:, channel] = shared.solve_gains(*columns)
        if vignetting:
            fit = fit._replace(lens=_solve_lens(seen.point, powers, seen.color - fit.gains[seen.view], weights))
        weights, _ = _robust(seen, fit, weights)
    return Fit(fit.gains.round(DECIMALS), fit.lens.round(DECIMALS), fit.largest)


def held_out_error(seen: Observations, fit: Fit) -> float:
    """Return how unlike the colours of a point in several photos are without their gains and falloff.

    Args:
        seen: observations of points that the fit does not know.
        fit: gains and falloff.

    Returns:
        The mean of log(1 + (difference from the point's own colour / NOISE)^2), in which outliers count little.
    """
    weights = np.ones(seen.color.shape)
    for _ in range(ROUNDS):
        weights, left = _robust(seen, fit, weights)
    return float(np.log1p((left / NOISE) ** 2).mean())


def choose_fit(seen: Observations, cameras: Sequence[Camera]) -> Fit | None:
    """Choose between no exposures, gains, and gains with a falloff, by how they explain points not fitted to.

    Shading and drift along chains of matches also look like gains, but not like the same gains everywhere: the points
    are cut in two along each of their principal axes, and the fit to one half is judged at the other.

    Args:
        seen: all observations.
        cameras: cameras of the photos.

    Returns:
        The chosen fit to all points; None where gains do not lower the error of held-out points by `MARGIN`.
    """
    if len(seen.view) == 0:
        return None
    none, gains, both = held_out_errors(seen, cameras)
    with_lens = both < (1 - MARGIN) * gains
    if (both if with_lens else gains) >= (1 - MARGIN) * none:
        return None
    return fit_exposures(seen, cameras, vignetting=with_lens)


def held_out_errors(seen: Observations, cameras: Sequence[Camera]) -> tuple[float, float, float]:
    """Return the errors at held-out halves of the points of no exposures, gains alone, and gains with a falloff.

    Args:
        seen: one observation or more; of many points, every n-th is taken.
        cameras: cameras of the photos.

    Returns:
        Means of `held_out_error` over both halves along each principal axis; 0 where the points cannot be cut in two.
    """
    stride = -(-len(seen.places) // MOST_CHECKED)
    some = seen.of_points(np.arange(len(seen.places)) % stride == 0)
    errors = [_errors_of(a, b, cameras) for a, b in _halves(some)]
    none, gains, both = np.mean(errors, axis=0).tolist() if errors else (0.0, 0.0, 0.0)
    return none, gains, both


def _halves(seen: Observations) -> list[tuple[Observations, Observations]]:
    """Cut the points at the median along each principal axis of their places; return both orders of both halves."""
    places = seen.places[np.unique(seen.point)].astype(np.float64)
    centre = np.median(places, axis=0)
    distances = np.linalg.norm(places - centre, axis=1)
    near = places[distances <= np.quantile(distances, 0.9)]  # without far points, which would dominate the axes
    _, _, axes = np.linalg.svd(near - near.mean(0), full_matrices=False)
    found = []
    for axis in axes:
        along = (seen.places - centre) @ axis
        first = along < np.median(along[seen.point])
        parts = seen.of_points(first), seen.of_points(~first)
        if all(len(part.view) for part in parts):
            found += [parts, parts[::-1]]
    return found


def _errors_of(fitted: Observations, held_out: Observations, cameras: Sequence[Camera]) -> tuple[float, float, float]:
    """Return the errors at held-out points of no exposures, gains alone, and gains with a falloff."""
    gains, both = (fit_exposures(fitted, cameras, vignetting=lens) for lens in (False, True))
    none = Fit(np.zeros_like(gains.gains), np.zeros(2), gains.largest)
    no, one, two = (held_out_error(held_out, fit) for fit in (none, gains, both))
    return no, one, two


def _robust(seen: Observations, fit: Fit, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (M, 3) of the next round, and what is left of the colours (M, 3) beside the points' own."""
    left = fit.unexposed(seen)
    left -= _means(seen.point, left, weights)
    return 1 / (1 + (left / NOISE) ** 2), left


def _powers(seen: Observations, largest: float) -> np.ndarray:
    t = seen.squares / largest
    return np.stack([t, t**2], axis=1)


def _falloff(fit: Fit) -> Falloff:
    a, b = fit.lens.tolist()
    return a, b, fit.largest


def observations(
    cameras: Sequence[Camera],
    photos: Sequence[torch.Tensor],
    points: Sequence[torch.Tensor],
    masks: Sequence[torch.Tensor | None] | None,
) -> Observations:
    """Return all usable observations of points in photos; the arguments are those of `photo_gains`."""
    views, places, colors, squares = [], [], [], []
    masks = [None] * len(cameras) if masks is None else masks
    for index, (camera, photo, seen, mask) in enumerate(zip(cameras, photos, points, masks, strict=True)):
        pixels, depths = camera.project(seen)
        inside = in_image(pixels, depths, camera.width, camera.height)
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
    distinct, point = np.unique(np.concatenate(places), axis=0, return_inverse=True)
    return Observations(
        np.concatenate(views), point.reshape(-1), np.concatenate(colors), np.concatenate(squares), distinct
    )


def _corner(camera: Camera) -> float:
    """Squared tangent between the optical axis and the farthest corner of the image."""
    x, y = max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy
    return x**2 + y**2


class SharedPoints:
    """Which photos show which points: what all least-squares problems of a fit have in common."""

    def __init__(self, view: np.ndarray, point: np.ndarray, photos: int) -> None:
        """Prepare for M observations of points in photos.

        Args:
            view: (M,) index of the photo.
            point: (M,) index of the point.
            photos: V, how many photos there are.
        """
        from scipy.sparse import csr_array

        def grouped(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, csr_array]:
            order = np.argsort(rows, kind="stable")
            starts = np.concatenate([[0], np.bincount(rows, minlength=shape[0]).cumsum()])
            return order, csr_array((np.zeros(len(rows)), columns[order], starts), shape=shape)

        self.view, self.point, self.photos, points = view, point, photos, int(point.max()) + 1
        self.by_view, self.of_photos = grouped(view, point, (photos, points))
        self.by_point, self.of_points = grouped(point, view, (points, photos))

    def solve_gains(self, observed: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the log gains (V,), mean 0, of one channel: least squares.

        Args:
            observed: (M,) log colours.
            weights: (M,) of the squared errors.
        """
        from scipy.linalg import solve
        from scipy.sparse import csc_array, diags_array
        from scipy.sparse.linalg import spsolve

        # The points' own colours, eliminated, leave a Laplacian of the photos.
        view, point, photos = self.view, self.point, self.photos
        totals = np.bincount(point, weights).clip(1e-9)
        shares = weights / np.sqrt(totals)[point]
        self.of_photos.data, self.of_points.data = shares[self.by_view], shares[self.by_point]
        shared, diagonal = self.of_photos @ self.of_points, np.bincount(view, weights, photos) + PRIOR
        means = np.bincount(point, weights * observed) / totals
        right = np.bincount(view, weights * (observed - means[point]), photos)
        if photos <= MOST_DENSE:
            found = solve(np.diag(diagonal) - shared.toarray(), right, assume_a="pos")
        else:
            found = spsolve(csc_array(diags_array(diagonal) - shared), right)
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


def calibrate_exposures(scene: Scene, config: Config) -> ExposureCalibration | None:
    """Estimate the exposures of a scene's training photos.

    Returns:
        None where the photos have one exposure by their nature, or where their points do not show that exposures
        differ (`choose_fit`).
    """
    rendered = scene.background is not None or scene.random_background
    if not config.exposures or rendered or config.mask_mode == "background":
        return None
    points = [view.points if view.points is not None else scene.points[:0] for view in scene.train]
    cameras = [view.camera for view in scene.train]
    photos, masks = [view.image for view in scene.train], [view.mask for view in scene.train]
    seen = observations(cameras, photos, points, masks)
    fit = choose_fit(seen, cameras)
    if fit is None:
        return None
    log_gains = torch.from_numpy(fit.gains)
    exposures = Exposures.of(log_gains, cameras, _falloff(fit))
    return ExposureCalibration(exposures, log_gains.float().exp(), _point_colors(scene, seen, fit))


class CalibrateOnce:
    """Estimates the exposures of a scene for the first of several trainings, and returns copies for the others.

    Their settings are to be alike in what `calibrate_exposures` reads.
    """

    def __init__(self) -> None:
        self.found: list[ExposureCalibration | None] = []

    def __call__(self, scene: Scene, config: Config) -> ExposureCalibration | None:
        """Return what `calibrate_exposures` returns."""
        if not self.found:
            self.found.append(calibrate_exposures(scene, config))
        return copy.deepcopy(self.found[0])  # a training moves its exposures to its device


def _point_colors(scene: Scene, seen: Observations, fit: Fit) -> torch.Tensor:
    """Return colours (P, 3) of the scene's points at the mean exposure; a point that no photo shows keeps its own."""
    colors = scene.colors.float() / 255 if scene.colors.dtype == torch.uint8 else scene.colors.float()
    weights, left = _robust(seen, fit, np.ones(seen.color.shape))
    weights, left = _robust(seen, fit, weights)
    own = np.zeros(seen.places.shape)
    own[seen.point] = fit.unexposed(seen) - left
    rows = {place.tobytes(): row for row, place in enumerate(seen.places)}
    found = [rows.get(place.tobytes(), -1) for place in scene.points.numpy()]
    known = np.array([row >= 0 for row in found], dtype=bool)
    colors = colors.clone()
    colors[torch.from_numpy(known)] = torch.from_numpy(np.exp(own[[row for row in found if row >= 0]])).float()
    return colors.clamp(0, 1)
