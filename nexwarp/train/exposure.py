"""Estimates each training photo's exposure and the lens's vignetting, before training; decides whether to use them.

A point's colour in a photo is modelled as its own colour, times the photo's gain, times the falloff of the lens, a
function of the angle to the optical axis that all photos share (`nexwarp.model.exposures`). The logarithms are fitted
by least squares, reweighted so that highlights and occluders do not count. Priors keep photos with few points near the
mean gain, and the lens near no falloff.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from nexwarp.cameras.camera import Camera, in_image
from nexwarp.data import Scene, View
from nexwarp.model.exposures import DECIMALS, Exposures
from nexwarp.train.recipe import Config

CLIPPED = (8, 247)  # 8-bit values beyond these are clipped, or too dark to tell a ratio
ROUNDS = 6  # rounds of reweighted least squares
NOISE = 0.05  # noise of log colours; larger differences count as outliers
PRIOR = 0.1  # weight of the prior for a gain of 1, in observations
EVEN_PRIOR = 1.0  # weight of the prior for a lens without falloff, in observations
FURTHER = 1.3  # the falloff is extrapolated to this many times the largest squared tangent of an observed point
MARGIN = 0.01  # share of the error at held-out points by which gains must lower it, and then the falloff
MOST_CHECKED = 20_000  # largest number of points that this choice looks at
MOST_DENSE = 300  # photos: up to 263 a dense matrix of them was solved faster than a sparse one, from 500 on slower
LEAST_WEIGHT = 1e-9  # of a point, so that nothing is divided by 0


@dataclass(frozen=True)
class ExposureCalibration:
    """Gains (V, 3) of V training photos, what predicts those of other cameras, and the points' colours at their mean.

    The colours (P, 3) of the scene's points are float32 in [0, 1].
    """

    exposures: Exposures
    gains: torch.Tensor
    colors: torch.Tensor


Calibrate = Callable[[Scene, Config], ExposureCalibration | None]


def calibrate_exposures(scene: Scene, config: Config) -> ExposureCalibration | None:
    """Estimate the exposures of a scene's training photos.

    None where they have one exposure by their nature, or where points do not show that exposures differ.
    """
    rendered = scene.background is not None or scene.random_background
    if not config.exposures or rendered or config.mask_mode == "background":
        return None
    cameras = [view.camera for view in scene.train]
    seen = observations(scene.train)
    fit = choose_fit(seen, cameras)
    if fit is None:
        return None
    log_gains = torch.from_numpy(fit.gains)
    exposures = Exposures.of(log_gains, cameras, (*fit.lens.tolist(), fit.largest))
    return ExposureCalibration(exposures, log_gains.float().exp(), _point_colors(scene, seen, fit))


class Observations(NamedTuple):
    """M observations of P points in photos."""

    view: np.ndarray  # (M,) index of the photo
    point: np.ndarray  # (M,) index of the point
    color: np.ndarray  # (M, 3) log colour
    squares: np.ndarray  # (M,) squared tangent of the angle to the optical axis
    places: np.ndarray  # (P, 3) positions of the points, float32

    def of_points(self, chosen: np.ndarray) -> "Observations":
        """Return the observations of those points for which `chosen` (P,) is True."""
        kept = chosen[self.point]
        return Observations(self.view[kept], self.point[kept], self.color[kept], self.squares[kept], self.places)


class Fit(NamedTuple):
    """Exposures fitted to observations."""

    gains: np.ndarray  # (V, 3) log gains with mean 0
    lens: np.ndarray  # (2,) factors of t and t^2 in the logarithm of the falloff, where t = squares / largest
    largest: float  # largest squared tangent of an observed point

    def powers(self, seen: Observations) -> np.ndarray:
        """Return t and t^2 (M, 2) of observations."""
        t = seen.squares / self.largest
        return np.stack([t, t**2], axis=1)

    def unexposed(self, seen: Observations) -> np.ndarray:
        """Return the log colours (M, 3) of observations without gains and falloff."""
        return seen.color - self.gains[seen.view] - (self.powers(seen) @ self.lens)[:, None]


def observations(views: Sequence[View]) -> Observations:
    """Return all usable observations of points in photos; a point that photos share has the same bits in each."""
    parts = [_observed(index, view) for index, view in enumerate(views)]
    view, places, color, squares = (np.concatenate(values) for values in zip(*parts, strict=True))
    distinct, point = np.unique(places, axis=0, return_inverse=True)
    return Observations(view, point.reshape(-1), color, squares, distinct)


def _observed(index: int, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Index, positions, log colours and squared tangents of the points that a photo shows."""
    camera, points = view.camera, torch.zeros(0, 3) if view.points is None else view.points
    pixels, depths = camera.project(points)
    inside = in_image(pixels, depths, camera.width, camera.height)
    column, row = pixels[inside].long().unbind(1)
    color = view.image[row, column]
    usable = (color >= CLIPPED[0]).all(1) & (color <= CLIPPED[1]).all(1)
    if view.mask is not None:
        usable &= view.mask[row, column]
    x, y = pixels[inside][usable].double().unbind(1)
    squares = ((x - camera.cx) / camera.fx) ** 2 + ((y - camera.cy) / camera.fy) ** 2
    log_color = color[usable].double().div(255).log()
    return np.full(len(squares), index), points[inside][usable].numpy(), log_color.numpy(), squares.numpy()


def choose_fit(seen: Observations, cameras: Sequence[Camera]) -> Fit | None:
    """Choose between no exposures, gains, and gains with a falloff, by how they explain points not fitted to.

    Shading and drift along chains of matches also look like gains, but not like the same gains everywhere: the points
    are cut in two along each of their principal axes, and the fit to one half is judged at the other. Of many points,
    every n-th is judged by. None where gains do not lower the error of held-out points by `MARGIN`.
    """
    stride = max(-(-len(seen.places) // MOST_CHECKED), 1)
    halves = _halves(seen.of_points(np.arange(len(seen.places)) % stride == 0))
    if not halves:  # no points, or one that cannot be cut in two
        return None
    none, gains, both = np.mean([_held_out_errors(*pair, cameras) for pair in halves], axis=0).tolist()
    vignetting = both < (1 - MARGIN) * gains
    if (both if vignetting else gains) >= (1 - MARGIN) * none:
        return None
    return fit_exposures(seen, cameras, vignetting=vignetting)


def _halves(seen: Observations) -> list[tuple[Observations, Observations]]:
    """Cut the points at the median along each principal axis of their places; return both orders of both halves."""
    if not len(seen.view):
        return []
    places = seen.places[np.unique(seen.point)].astype(np.float64)
    centre = np.median(places, axis=0)
    distances = np.linalg.norm(places - centre, axis=1)
    near = places[distances <= np.quantile(distances, 0.9)]  # without far points, which would dominate the axes
    _, _, axes = np.linalg.svd(near - near.mean(0), full_matrices=False)
    pairs = []
    for axis in axes:
        along = (seen.places - centre) @ axis
        first = along < np.median(along[seen.point])
        one, other = seen.of_points(first), seen.of_points(~first)
        if len(one.view) and len(other.view):
            pairs += [(one, other), (other, one)]
    return pairs


def _held_out_errors(fitted: Observations, held_out: Observations, cameras: Sequence[Camera]) -> list[float]:
    """Return the errors at held-out points of no exposures, gains alone, and gains with a falloff.

    An error is the mean of log(1 + (difference from the point's own colour / NOISE)^2): outliers count little.
    """
    gains, both = (fit_exposures(fitted, cameras, vignetting=lens) for lens in (False, True))
    none = Fit(np.zeros_like(gains.gains), np.zeros(2), gains.largest)
    errors = []
    for fit in (none, gains, both):
        weights = np.ones(held_out.color.shape)
        for _ in range(ROUNDS):
            weights, left = _robust(held_out, fit, weights)
        errors.append(float(np.log1p((left / NOISE) ** 2).mean()))
    return errors


def fit_exposures(seen: Observations, cameras: Sequence[Camera], *, vignetting: bool = True) -> Fit:
    """Fit gains, and with `vignetting` the falloff of the lens, to one observation or more."""
    largest = max(min(FURTHER * float(seen.squares.max()), max(map(_corner, cameras))), 10.0**-DECIMALS)
    fit = Fit(np.zeros((len(cameras), 3)), np.zeros(2), round(largest, DECIMALS))
    powers, weights = fit.powers(seen), np.ones(seen.color.shape)
    for _ in range(ROUNDS):
        observed = seen.color - (powers @ fit.lens)[:, None]
        for channel in range(3):
            fit.gains[:, channel] = solve_gains(seen, observed[:, channel], weights[:, channel], len(cameras))
        if vignetting:
            fit = fit._replace(lens=_solve_lens(seen.point, powers, seen.color - fit.gains[seen.view], weights))
        weights, _ = _robust(seen, fit, weights)
    return Fit(fit.gains.round(DECIMALS), fit.lens.round(DECIMALS), fit.largest)


def _corner(camera: Camera) -> float:
    """Squared tangent between the optical axis and the farthest corner of the image."""
    x, y = max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy
    return x**2 + y**2


def solve_gains(seen: Observations, observed: np.ndarray, weights: np.ndarray, photos: int) -> np.ndarray:
    """Return the log gains (V,), mean 0, of one channel of V photos by least squares of log colours (M,)."""
    from scipy.linalg import solve
    from scipy.sparse import csc_array, csr_array, diags_array
    from scipy.sparse.linalg import spsolve

    # The points' own colours, eliminated, leave a Laplacian of the photos.
    view, point = seen.view, seen.point
    totals = np.bincount(point, weights).clip(LEAST_WEIGHT)
    shares = csr_array((weights / np.sqrt(totals)[point], (view, point)), shape=(photos, len(totals)))
    shared, diagonal = shares @ shares.T, np.bincount(view, weights, photos) + PRIOR
    means = np.bincount(point, weights * observed) / totals
    right = np.bincount(view, weights * (observed - means[point]), photos)
    if photos <= MOST_DENSE:
        gains = solve(np.diag(diagonal) - shared.toarray(), right, assume_a="pos")
    else:
        gains = spsolve(csc_array(diags_array(diagonal) - shared), right)
    return gains - gains.mean()


def _solve_lens(point: np.ndarray, powers: np.ndarray, observed: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Factors (2,) of the lens's powers (M, 2) in log colours (M, 3) without gains, by weighted least squares."""
    normal, right = EVEN_PRIOR * np.eye(2), np.zeros(2)
    for channel in range(3):
        w = weights[:, channel : channel + 1].repeat(2, axis=1)
        apart = powers - _means(point, powers, w)
        normal += apart.T @ (w * apart)
        right += apart.T @ (w[:, 0] * observed[:, channel])
    return np.linalg.solve(normal, right)


def _robust(seen: Observations, fit: Fit, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (M, 3) of the next round, and what is left of the colours (M, 3) beside the points' own."""
    left = fit.unexposed(seen)
    left -= _means(seen.point, left, weights)
    return 1 / (1 + (left / NOISE) ** 2), left


def _means(point: np.ndarray, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """For each of values (M, C) the weighted mean over those of its point."""
    totals = [np.bincount(point, w).clip(LEAST_WEIGHT) for w in weights.T]
    sums = [np.bincount(point, w * x) for x, w in zip(values.T, weights.T, strict=True)]
    return np.stack([s / total for s, total in zip(sums, totals, strict=True)], axis=1)[point]


def _point_colors(scene: Scene, seen: Observations, fit: Fit) -> torch.Tensor:
    """Return colours (P, 3) of the scene's points at the mean exposure; a point that no photo shows keeps its own."""
    weights, _ = _robust(seen, fit, np.ones(seen.color.shape))
    _, left = _robust(seen, fit, weights)
    own = np.zeros(seen.places.shape)
    own[seen.point] = fit.unexposed(seen) - left
    row_of = {place.tobytes(): row for row, place in enumerate(seen.places)}
    rows = np.array([row_of.get(place.tobytes(), -1) for place in scene.points.numpy()], dtype=np.int64)
    shown = torch.from_numpy(rows >= 0)
    return torch.where(shown[:, None], torch.from_numpy(np.exp(own[rows])).float(), scene.colors.float() / 255).clamp(
        0, 1
    )
