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
from nexwarp.machine import in_threads
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
    """M observations of P points in photos, point by point."""

    view: np.ndarray  # (M,) index of the photo
    point: np.ndarray  # (M,) index of the point, ascending
    color: np.ndarray  # (3, M) log colour
    squares: np.ndarray  # (M,) squared tangent of the angle to the optical axis
    places: np.ndarray  # (P, 3) positions of the points, float32

    def of_points(self, chosen: np.ndarray) -> "Observations":
        """Return the observations of those points for which `chosen` (P,) is True."""
        kept = chosen[self.point]
        point = (np.cumsum(chosen) - 1)[self.point[kept]]
        return Observations(self.view[kept], point, self.color[:, kept], self.squares[kept], self.places[chosen])


class Fit(NamedTuple):
    """Exposures fitted to observations."""

    gains: np.ndarray  # (V, 3) log gains with mean 0
    lens: np.ndarray  # (2,) factors of t and t^2 in the logarithm of the falloff, where t = squares / largest
    largest: float  # largest squared tangent of an observed point

    def powers(self, seen: Observations) -> np.ndarray:
        """Return t and t^2 (2, M) of observations."""
        t = seen.squares / self.largest
        return np.stack([t, t**2])

    def unexposed(self, seen: Observations) -> np.ndarray:
        """Return the log colours (3, M) of observations without gains and falloff."""
        return seen.color - self.gains.T.take(seen.view, axis=1) - self.lens @ self.powers(seen)


class Weights:
    """Weights (C, M) of observations of points, in C channels."""

    def __init__(self, point: np.ndarray, values: np.ndarray) -> None:
        self.point, self.values = point, values
        self.totals = np.stack([np.bincount(point, w) for w in values]).clip(LEAST_WEIGHT)

    def apart(self, values: np.ndarray) -> np.ndarray:
        """Return how values (C, M) or (M,) differ from the mean over their points."""
        sums = np.stack([np.bincount(self.point, w) for w in self.values * values])
        return values - (sums / self.totals).take(self.point, axis=1)


def observations(views: Sequence[View]) -> Observations:
    """Return all usable observations of points in photos; a point that photos share has the same bits in each."""
    parts = list(in_threads(lambda numbered: _observed(*numbered), enumerate(views)))
    view, places, color, squares = (np.concatenate(values) for values in zip(*parts, strict=True))
    order, point = _numbered(places)
    first = order[np.flatnonzero(np.diff(point, prepend=-1))]
    return Observations(view[order], point, color[order].T.copy(), squares[order], places[first])


def _numbered(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the order (M,) of positions (M, 3) by x, y and z, and in that order the numbers of distinct ones."""
    order = np.lexsort(places.T[::-1])
    new = (places[order[1:]] != places[order[:-1]]).any(axis=1)
    return order, np.concatenate([np.zeros(min(len(places), 1), np.int64), np.cumsum(new)])


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
    errors = list(in_threads(lambda pair: _held_out_errors(pair[0], pair[1], cameras), halves))
    none, gains, both = np.mean(errors, axis=0).tolist()
    vignetting = both < (1 - MARGIN) * gains
    if (both if vignetting else gains) >= (1 - MARGIN) * none:
        return None
    return fit_exposures(seen, cameras, vignetting=vignetting)


def _halves(seen: Observations) -> list[tuple[Observations, Observations]]:
    """Cut the points at the median along each principal axis of their places; return both orders of both halves."""
    if not len(seen.view):
        return []
    places = seen.places.astype(np.float64)
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
        left, weights = fit.unexposed(held_out), np.ones(held_out.color.shape)
        for _ in range(ROUNDS):
            rest = Weights(held_out.point, weights).apart(left)
            weights = _robust(rest)
        errors.append(float(np.log1p((rest / NOISE) ** 2).mean()))
    return errors


def fit_exposures(seen: Observations, cameras: Sequence[Camera], *, vignetting: bool = True) -> Fit:
    """Fit gains, and with `vignetting` the falloff of the lens, to one observation or more."""
    largest = max(min(FURTHER * float(seen.squares.max()), max(map(_corner, cameras))), 10.0**-DECIMALS)
    fit = Fit(np.zeros((len(cameras), 3)), np.zeros(2), round(largest, DECIMALS))
    powers, values = fit.powers(seen), np.ones(seen.color.shape)
    for _ in range(ROUNDS):
        weights = Weights(seen.point, values)
        gains = solve_gains(seen, len(cameras), seen.color - fit.lens @ powers, weights)
        fit = fit._replace(gains=gains.T)
        if vignetting:
            fit = fit._replace(lens=_solve_lens(powers, seen.color - fit.gains.T.take(seen.view, axis=1), weights))
        values = _robust(weights.apart(fit.unexposed(seen)))
    return Fit(fit.gains.round(DECIMALS), fit.lens.round(DECIMALS), fit.largest)


def _corner(camera: Camera) -> float:
    """Squared tangent between the optical axis and the farthest corner of the image."""
    x, y = max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy
    return x**2 + y**2


def solve_gains(seen: Observations, photos: int, observed: np.ndarray, weights: Weights) -> np.ndarray:
    """Return the log gains (C, V), mean 0 in each channel, of V photos by least squares of log colours (C, M)."""
    # The points' own colours, eliminated, leave a Laplacian of the photos.
    right = weights.values * weights.apart(observed)
    channels = zip(weights.values, weights.totals, right, strict=True)
    gains = np.stack(list(in_threads(lambda channel: _channel_gains(seen, photos, *channel), channels)))
    return gains - gains.mean(axis=1, keepdims=True)


def _channel_gains(
    seen: Observations, photos: int, weights: np.ndarray, totals: np.ndarray, right: np.ndarray
) -> np.ndarray:
    from scipy.sparse import csc_array, csr_array, diags_array
    from scipy.sparse.linalg import spsolve

    shares = weights / np.sqrt(totals).take(seen.point)
    first = np.searchsorted(seen.point, np.arange(len(seen.places) + 1))  # of each point's observations
    by_point = csr_array((shares, seen.view, first), (len(seen.places), photos))
    shared = by_point.T.tocsr() @ by_point
    diagonal = np.bincount(seen.view, weights, photos) + PRIOR
    right = np.bincount(seen.view, right, photos)
    if photos > MOST_DENSE:
        return spsolve(csc_array(diags_array(diagonal) - shared), right)
    factor = torch.linalg.cholesky(torch.from_numpy(np.diag(diagonal) - shared.toarray()))
    return torch.cholesky_solve(torch.from_numpy(right)[:, None], factor)[:, 0].numpy()


def _solve_lens(powers: np.ndarray, observed: np.ndarray, weights: Weights) -> np.ndarray:
    """Factors (2,) of the lens's powers (2, M) in log colours (3, M) without gains, by weighted least squares."""
    apart = np.stack([weights.apart(power) for power in powers])  # (2, 3, M)
    weighted = (apart * weights.values).reshape(2, -1)
    normal = EVEN_PRIOR * np.eye(2) + weighted @ apart.reshape(2, -1).T
    return np.linalg.solve(normal, weighted @ observed.reshape(-1))


def _robust(left: np.ndarray) -> np.ndarray:
    """Return weights of the next round, for what is left of colours beside the points' own."""
    return 1 / (1 + (left / NOISE) ** 2)


def _point_colors(scene: Scene, seen: Observations, fit: Fit) -> torch.Tensor:
    """Return colours (P, 3) of the scene's points at the mean exposure; a point that no photo shows keeps its own."""
    colors = fit.unexposed(seen)
    weights = _robust(Weights(seen.point, np.ones(colors.shape)).apart(colors))
    own = np.zeros(seen.places.shape)
    own[seen.point] = (colors - Weights(seen.point, weights).apart(colors)).T
    order, number = _numbered(np.concatenate([seen.places, scene.points.numpy()]))
    numbers = np.empty_like(number)
    numbers[order] = number
    rows = np.full(len(number), -1)
    rows[numbers[: len(own)]] = np.arange(len(own))
    rows = rows[numbers[len(own) :]]
    shown = torch.from_numpy(rows >= 0)
    return torch.where(shown[:, None], torch.from_numpy(np.exp(own[rows])).float(), scene.colors.float() / 255).clamp(
        0, 1
    )
