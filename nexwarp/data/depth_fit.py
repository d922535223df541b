"""Depths in the world's units from the values of depth maps, by the scene's points.

Sensors and multi-view stereo give depths in a unit of their own, some networks depths up to scale and shift, others
inverse depths up to both. Which of these it is, the points tell, and for each photo its scale and shift. They are
fitted once, to points: fitted to renderings they would follow what the training gets wrong.
"""

import dataclasses
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from nexwarp.cameras.camera import visible_points
from nexwarp.data.capture import Cloud
from nexwarp.data.depth_files import LARGEST
from nexwarp.data.views import View

LEAST_POINTS = 16  # in a photo, for a fit
MOST_POINTS = 50_000  # of a cloud that does not tell which photos see a point
MOST_ERROR = 0.3  # median of |log(depth / point's depth)| from which on a fit has failed
GAIN = 0.5  # a shift has to reduce the error to this, or else there is none
STEPS, LEAST_RESIDUAL = 20, 1e-3  # of the iterations to the least sum of absolute residuals
EXTREMES, BEYOND = (0.02, 0.98), 2.0  # a shift holds up to this factor beyond these quantiles of the points' depths
KINDS = ("scale", "shift", "inverse")

Samples = tuple[np.ndarray, np.ndarray]  # (M,) values of a map > 0, and z-depths of the points in these pixels


@dataclass(frozen=True)
class Fit:
    """How values become depths: scale * value + shift, or the inverse of that, from `near` to `far`."""

    scale: float
    shift: float = 0.0
    inverse: bool = False
    near: float = 0.0
    far: float = LARGEST

    def depths(self, values: torch.Tensor) -> torch.Tensor:
        """Return the depths of values, 0 for a value of 0 and beyond `near` and `far`."""
        depths = self.scale * values + self.shift
        depths = 1.0 / depths if self.inverse else depths
        return torch.where((values > 0) & (depths >= self.near) & (depths <= self.far), depths, 0.0)


def fit_depths(views: list[View], cloud: Cloud | None, source: Path) -> list[View]:
    """Return views whose `depth`, the values of their maps, has become depths; without any points it stays as it is.

    All maps are of the kind that fits best on the median of the photos. Where a scale is enough, photos of few points
    get the median of the others'. Maps that cannot be fitted are left out, with a warning.
    """
    samples = {index: _samples(view, cloud) for index, view in enumerate(views) if view.depth is not None}
    fittable = {index: pair for index, pair in samples.items() if len(pair[0]) >= LEAST_POINTS}
    if not fittable and cloud is None:
        return views
    fits: dict[int, Fit] = {}
    least = np.inf
    for kind in KINDS if fittable else ():
        tried = {index: _fit(kind, *pair) for index, pair in fittable.items()}
        errors = {index: _error(fit, *fittable[index]) for index, fit in tried.items()}
        error = float(np.median(list(errors.values())))
        if not fits or error < GAIN * least:
            least, fits = error, {index: fit for index, fit in tried.items() if errors[index] <= MOST_ERROR}
    if fits and not any(fit.shift for fit in fits.values()):
        common = Fit(float(np.exp(np.median([np.log(fit.scale) for fit in fits.values()]))))
        fits |= {index: common for index in samples.keys() - fittable.keys()}
    if len(fits) < len(samples):
        left = f"{len(samples) - len(fits)} of {len(samples)} depth maps do not fit the points and are left out"
        warnings.warn(
            f"{source}: {left}; expected {LEAST_POINTS} points in a photo, and values that rise or fall with "
            "their depths",
            stacklevel=2,
        )
    return [dataclasses.replace(view, depth=_fitted(view.depth, fits.get(index))) for index, view in enumerate(views)]


def _fitted(values: torch.Tensor | None, fit: Fit | None) -> torch.Tensor | None:
    return None if values is None or fit is None else fit.depths(values.float()).half()


def _samples(view: View, cloud: Cloud | None) -> Samples:
    """Return the values of a view's map where points lie: those that it sees, or else all that project into it."""
    points, camera, none = view.points, view.camera, np.zeros(0)
    if points is None and cloud is not None:
        points = torch.from_numpy(cloud.positions[:: -(-len(cloud.positions) // MOST_POINTS)]).float()
    if points is None or view.depth is None:
        return none, none
    places, depths = visible_points(*camera.project(points), camera.width, camera.height, view.mask)
    values = view.depth.flatten()[places]
    return values[values > 0].double().numpy(), depths[values > 0].double().numpy()


def _fit(kind: str, values: np.ndarray, depths: np.ndarray) -> Fit:
    """Fit by the least sum of absolute relative residuals: points at edges or behind the surface are outliers."""
    if kind == "scale":
        return Fit(float(np.exp(np.median(np.log(depths / values)))))
    inverse = kind == "inverse"
    rows = np.stack([values, np.ones_like(values)], axis=1) * (depths if inverse else 1 / depths)[:, None]
    roots = np.ones_like(values)
    for _ in range(STEPS):
        scale, shift = np.linalg.lstsq(rows * roots[:, None], roots, rcond=None)[0].tolist()
        roots = np.maximum(np.abs(rows @ (scale, shift) - 1), LEAST_RESIDUAL) ** -0.5
    near, far = np.quantile(depths, EXTREMES).tolist()
    return Fit(scale, shift, inverse, near / BEYOND, min(far * BEYOND, LARGEST))


def _error(fit: Fit, values: np.ndarray, depths: np.ndarray) -> float:
    """Median of |log(depth of the fit / depth of the point)|; infinite where a larger value is the wrong way."""
    if fit.scale <= 0:
        return np.inf
    fitted = fit.depths(torch.from_numpy(values)).numpy()
    with np.errstate(divide="ignore"):
        return float(np.median(np.abs(np.log(fitted / depths))))
