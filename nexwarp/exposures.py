"""Exposures: how bright each training photo is, a gain a channel, and what a camera between them would take.

Phones and cameras set their exposure and white balance anew for every photo, and lenses darken the corners
(vignetting). A model that has to explain the differences by its surfels learns what no other view agrees with; here it
learns the scene as at the mean exposure and through an even lens, and a rendering takes the gains of the photos around
it and the falloff of the lens.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn

from nexwarp.camera import Camera
from nexwarp.ops.checks import check_tensors

# 8-bit values beyond these are clipped, or too dark to tell a ratio.
CLIPPED = (8, 247)
ROUNDS = 6  # of reweighted least squares
NOISE = 0.05  # of log colours: larger differences count as outliers
PRIOR = 0.1  # observations that speak for a gain of 1
EVEN_PRIOR = 1.0  # observations that speak for an even lens
FURTHER = 1.3  # how much farther from its axis than points were seen, in squared tangents, a lens is known
DECIMALS = 6  # of log gains: the solver's rounding must not make a run another one
MOST_PHOTOS = 1000  # that renderings take their gains from
EVEN = (0.0, 0.0, 1.0)  # the falloff of a lens without any
LENGTHS = (0.4, 0.8, 1.6, 3.2, 6.4)  # of the kernel, over the spread of the cameras
MOST_FALLOFFS = 16  # of different cameras, to be kept
NOISES = (1e-3, 1e-2, 1e-1)  # variance of a photo's own deviation, over that of the process
TINY = 1e-9  # squared error that is none


class Exposures(nn.Module):
    """Gains of photos by the pose of their cameras: a Gaussian process with the Matern 3/2 kernel.

    Places between the photos, whose gains were predicted (`nexwarp.metering`), count as photos do.

    Buffers: `log_gains` (V, 3); `positions` (V, 3) of the cameras, world units; `directions` (V, 3) unit, where they
    look; `coefficients` (V, 3) and `mean` (3,) of the process; `lengths` (2,) world units: what a direction's change by
    1 counts, and the kernel's length; `falloff` (3,): a, b and the largest T > 0 of the lens, which leaves
    exp(a t + b t^2) of the light, where t = min(tan^2 / T, 1) and tan that of the angle to the optical axis.
    """

    def __init__(
        self,
        log_gains: torch.Tensor,
        positions: torch.Tensor,
        directions: torch.Tensor,
        coefficients: torch.Tensor,
        mean: torch.Tensor,
        lengths: torch.Tensor,
        falloff: torch.Tensor | None = None,
    ) -> None:
        super().__init__()
        if falloff is None:  # as in files from before there was one
            falloff = lengths.new_tensor(EVEN)
        shapes = {
            "log_gains": (log_gains, ("V", 3)),
            "positions": (positions, ("V", 3)),
            "directions": (directions, ("V", 3)),
            "coefficients": (coefficients, ("V", 3)),
            "mean": (mean, (3,)),
            "lengths": (lengths, (2,)),
            "falloff": (falloff, (3,)),
        }
        check_tensors(shapes)
        # Not persistent: they go with the surfels to another device, but are no part of their state.
        for name, (tensor, _) in shapes.items():
            self.register_buffer(name, tensor, persistent=False)
        # Numbers, so that nobody has to wait for a GPU to know them.
        self._lens = tuple(falloff.tolist())
        self._falloffs: dict[tuple, torch.Tensor] = {}
        if not self._lens[2] > 0:
            raise ValueError(f"falloff: expected a largest squared tangent > 0, got {self._lens[2]:g}")

    @classmethod
    def of(
        cls, log_gains: torch.Tensor, cameras: Sequence[Camera], falloff: Sequence[float] | None = None
    ) -> "Exposures":
        """Exposures of photos with log gains (V, 3) that these V cameras took, V >= 1; float32 on the CPU.

        `falloff` (3,) is the lens's, None is an even one.

        How far gains reach and how exact they are is what would have predicted each photo best from the others.
        """
        viewmats = torch.stack([camera.viewmat.cpu().double() for camera in cameras])
        every = -(-len(cameras) // MOST_PHOTOS)
        positions, directions = (x[::every] for x in _poses(viewmats))
        gains = log_gains.double()[::every]
        with _one_thread():
            size, squares = _apart(positions, directions)
            kernels = [(_matern(squares, length * size), length * size) for length in LENGTHS]
            fits = [(*_fit(kernel, gains, noise), length) for kernel, length in kernels for noise in NOISES]
            _, _, coefficients, mean, length = min(fits, key=lambda fit: fit[0])
        tensors = (gains, positions, directions, coefficients.round(decimals=5), mean, torch.stack([size, length]))
        return cls(*(x.float() for x in tensors), torch.tensor([float(x) for x in falloff or EVEN]))

    def tensors(self) -> dict[str, torch.Tensor]:
        """Its buffers by name; `Exposures(**tensors)` makes it again."""
        return dict(self.named_buffers())

    @torch.no_grad()
    def gains(self, camera: Camera) -> torch.Tensor:
        """Gains (3,) for the colours of a rendering; never beyond those of the photos, and their mean far away."""
        position, direction = _poses(camera.viewmat.to(self.positions))
        turned = self.lengths[0] * (self.directions - direction)
        squares = (self.positions - position).square().sum(1) + turned.square().sum(1)
        found = self.mean + _matern(squares, self.lengths[1]) @ self.coefficients
        return found.clamp(self.log_gains.amin(0), self.log_gains.amax(0)).exp()

    @torch.no_grad()
    def factors(self, camera: Camera) -> torch.Tensor:
        """What the colours (H, W, 3) of a rendering are times: (H, W, 3), or (3,) where the lens is even."""
        gains, light = self.gains(camera), self.falloff_of(camera)
        return gains if light is None else light * gains

    @torch.no_grad()
    def falloff_of(self, camera: Camera) -> torch.Tensor | None:
        """What the lens leaves of the light at each pixel, (H, W, 1), not to be written to; None where it is even."""
        a, b, largest = self._lens
        if a == b == 0:
            return None
        device = self.falloff.device
        key = (device, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        found = self._falloffs.get(key)
        if found is None:
            x = (torch.arange(camera.width, device=device) + 0.5 - camera.cx) / camera.fx
            y = (torch.arange(camera.height, device=device) + 0.5 - camera.cy) / camera.fy
            t = ((x**2 + (y**2)[:, None]) / largest).clamp(max=1.0)
            if len(self._falloffs) >= MOST_FALLOFFS:
                self._falloffs.clear()
            found = self._falloffs[key] = (t * (a + b * t)).exp()[..., None]
        return found


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sums of several threads are other sums, and a rounding's other side can be another file."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _matern(squares: torch.Tensor, length: torch.Tensor) -> torch.Tensor:
    """Matern 3/2 kernel of squared distances."""
    r = (3 * squares).sqrt() / length
    return (1 + r) * torch.exp(-r)


def _apart(positions: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Spread of cameras' positions (V, 3), and squares (V, V) of how far poses are apart."""
    size = (positions - positions.mean(0)).square().sum(1).mean().sqrt().clamp_min(1e-12)
    return size, torch.cdist(*[torch.cat([positions, size * directions], 1)] * 2).square()


def _fit(
    kernel: torch.Tensor, values: torch.Tensor, noise: float
) -> tuple[float, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Fit a process to values (V, 3).

    Returns:
        The sum of squares of the next; errors (V, 3) of each from the others; coefficients (V, 3); mean (3,).
    """
    inverse = torch.linalg.inv(kernel + noise * torch.eye(len(values), dtype=values.dtype))
    mean = inverse.sum(0) @ values / inverse.sum()
    coefficients = inverse @ (values - mean)
    errors = coefficients / inverse.diagonal()[:, None]
    return round(errors.square().sum().item(), 9), errors, coefficients, mean


@_one_thread()
def predict(
    log_gains: torch.Tensor,
    cameras: Sequence[Camera],
    brightness: torch.Tensor,
    others: Sequence[Camera],
    others_brightness: Callable[[], torch.Tensor],
) -> torch.Tensor | None:
    """Predict other cameras' log gains (M, 3) float64, as automatic exposure has them: by what they see.

    A process of the pose, as `Exposures`, and beside it linear in the brightness: each channel in those of all three.
    None where that predicts each photo from the others no better than the pose alone, by Akaike's criterion, corrected
    for few photos. Channels are not independent there: what goes wrong with a photo (its exposure was set by hand, the
    scene learnt it by heart) goes wrong with all of them.

    Args:
        log_gains: (V, 3) of photos.
        cameras: of those.
        brightness: (V, 3) float64 on the CPU, logarithms, of what is before them (`nexwarp.metering.brightness`).
        others: M cameras.
        others_brightness: gives (M, 3), likewise; not called where there is nothing to predict.
    """
    values = log_gains.cpu().double()
    here, there = (_poses(torch.stack([c.viewmat.cpu().double() for c in each])) for each in (cameras, others))
    size, squares = _apart(*here)
    seen = brightness - brightness.mean(0)
    poses = [(_matern(squares, length * size), length * size) for length in LENGTHS]
    alone = min((_fit(kernel, values, noise) for kernel, _ in poses for noise in NOISES), key=lambda fit: fit[0])
    # Slopes as large as the process is, a priori.
    fits = [(*_fit(kernel + seen @ seen.T, values, noise), length) for kernel, length in poses for noise in NOISES]
    _, errors, coefficients, mean, length = min(fits, key=lambda fit: fit[0])
    if not _better(errors, alone[1], seen.shape[1]):
        return None
    points, more = (torch.cat([position, size * direction], 1) for position, direction in (here, there))
    kernel = _matern(torch.cdist(more, points).square(), length)
    found = mean + (kernel + (others_brightness() - brightness.mean(0)) @ seen.T) @ coefficients
    return found.clamp(values.amin(0), values.amax(0)).round(decimals=DECIMALS)


def _better(errors: torch.Tensor, others: torch.Tensor, slopes: int) -> bool:
    """Whether errors (V, 3), of a fit with so many slopes a channel, are less than others (V, 3) by Akaike's criterion.

    Of errors that are normal, and dependent from channel to channel, with the correction for few photos (Bedrick and
    Tsai 1994, Model selection for multivariate regression in small samples).
    """
    photos, channels = errors.shape

    def criterion(errors: torch.Tensor, regressors: int) -> float:
        left = photos - regressors - channels - 1
        if left <= 0:
            return math.inf
        squares = errors.T @ errors + TINY * torch.eye(channels, dtype=errors.dtype)
        parameters = channels * regressors + channels * (channels + 1) / 2
        return photos * torch.logdet(squares).item() + 2 * parameters * photos / left

    return criterion(errors, 1 + slopes) < criterion(others, 1)


def photo_gains(
    cameras: Sequence[Camera],
    photos: Sequence[torch.Tensor],
    points: Sequence[torch.Tensor],
    masks: Sequence[torch.Tensor | None] | None = None,
) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Estimate log gains (V, 3) float64, mean 0, of photos, and the falloff of their lens, from points that they share.

    A point's colour in a photo is its own times the photo's gain times what the lens leaves of the light there, one
    function of the angle to the axis for all photos (`Exposures`). Least squares over the logarithms, reweighted so
    that highlights and occluders do not count; a photo with few points stays near the mean, and so does the lens.

    Args:
        cameras: of the V photos.
        photos: (H, W, 3) uint8 each.
        points: (M, 3) each, world positions that were triangulated from the photo; the same point has the same bits.
        masks: (H, W) bool each, True where the photo counts; None where all of it does.
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
    """Who sees what how: indices of photo and point (M,), log colours (M, 3), squared tangents to the axis (M,)."""
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


def _poses(viewmats: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and viewing directions (..., 3) of world-to-camera matrices (..., 4, 4)."""
    rotation, shift = viewmats[..., :3, :3], viewmats[..., :3, 3:]
    return -(rotation.mT @ shift)[..., 0], rotation[..., 2, :]
