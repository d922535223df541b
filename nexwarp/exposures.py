"""Exposures: how bright each training photo is, a gain a channel, and what a camera between them would take.

Phones and cameras set their exposure and white balance anew for every photo. A model that has to explain the
differences by its surfels learns what no other view agrees with; here it learns the scene as at the mean exposure, and
a rendering takes the gains of the photos around it.
"""

from collections.abc import Sequence

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
DECIMALS = 6  # of log gains: the solver's rounding must not make a run another one
MOST_PHOTOS = 1000  # that renderings take their gains from
LENGTHS = (0.4, 0.8, 1.6, 3.2, 6.4)  # of the kernel, over the spread of the cameras
NOISES = (1e-3, 1e-2, 1e-1)  # variance of a photo's own deviation, over that of the process


class Exposures(nn.Module):
    """Gains of photos by the pose of their cameras: a Gaussian process with the Matern 3/2 kernel.

    Buffers: `log_gains` (V, 3); `positions` (V, 3) of the cameras, world units; `directions` (V, 3) unit, where they
    look; `coefficients` (V, 3) and `mean` (3,) of the process; `lengths` (2,) world units: what a direction's change by
    1 counts, and the kernel's length.
    """

    def __init__(
        self,
        log_gains: torch.Tensor,
        positions: torch.Tensor,
        directions: torch.Tensor,
        coefficients: torch.Tensor,
        mean: torch.Tensor,
        lengths: torch.Tensor,
    ) -> None:
        super().__init__()
        shapes = {
            "log_gains": (log_gains, ("V", 3)),
            "positions": (positions, ("V", 3)),
            "directions": (directions, ("V", 3)),
            "coefficients": (coefficients, ("V", 3)),
            "mean": (mean, (3,)),
            "lengths": (lengths, (2,)),
        }
        check_tensors(shapes)
        # Not persistent: they go with the surfels to another device, but are no part of their state.
        for name, (tensor, _) in shapes.items():
            self.register_buffer(name, tensor, persistent=False)

    @classmethod
    def of(cls, log_gains: torch.Tensor, cameras: Sequence[Camera]) -> "Exposures":
        """Exposures of photos with log gains (V, 3) that these V cameras took, V >= 1; float32 on the CPU.

        How far gains reach and how exact they are is what would have foretold each photo best from the others.
        """
        viewmats = torch.stack([camera.viewmat.cpu().double() for camera in cameras])
        every = -(-len(cameras) // MOST_PHOTOS)
        positions, directions = (x[::every] for x in _poses(viewmats))
        gains = log_gains.double()[::every]
        size = (positions - positions.mean(0)).square().sum(1).mean().sqrt().clamp_min(1e-12)
        squares = torch.cdist(*[torch.cat([positions, size * directions], 1)] * 2).square()
        fits = [(*_fit(squares, gains, length * size, noise), length * size) for length in LENGTHS for noise in NOISES]
        _, coefficients, mean, length = min(fits, key=lambda fit: fit[0])
        tensors = (gains, positions, directions, coefficients.round(decimals=5), mean, torch.stack([size, length]))
        return cls(*(x.float() for x in tensors))

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


def _matern(squares: torch.Tensor, length: torch.Tensor) -> torch.Tensor:
    """Matern 3/2 kernel of squared distances."""
    r = (3 * squares).sqrt() / length
    return (1 + r) * torch.exp(-r)


def _fit(
    squares: torch.Tensor, values: torch.Tensor, length: torch.Tensor, noise: float
) -> tuple[float, torch.Tensor, torch.Tensor]:
    """Fit a process to values (V, 3): its squared error on each from the others; coefficients (V, 3); mean (3,)."""
    inverse = torch.linalg.inv(_matern(squares, length) + noise * torch.eye(len(values), dtype=values.dtype))
    mean = inverse.sum(0) @ values / inverse.sum()
    coefficients = inverse @ (values - mean)
    error = (coefficients / inverse.diagonal()[:, None]).square().sum().item()
    return round(error, 9), coefficients, mean


def photo_gains(
    cameras: Sequence[Camera],
    photos: Sequence[torch.Tensor],
    points: Sequence[torch.Tensor],
    masks: Sequence[torch.Tensor | None] | None = None,
) -> np.ndarray:
    """Estimate log gains (V, 3) float64, mean 0, of photos from the sparse points that they share.

    A point's colour in a photo is its own times the photo's gain. Least squares over the logarithms, reweighted so that
    highlights and occluders do not count; a photo with few points stays near the mean.

    Args:
        cameras: of the V photos.
        photos: (H, W, 3) uint8 each.
        points: (M, 3) each, world positions that were triangulated from the photo; the same point has the same bits.
        masks: (H, W) bool each, True where the photo counts; None where all of it does.
    """
    from scipy.sparse import coo_array, csc_array, diags_array, eye_array
    from scipy.sparse.linalg import spsolve

    count = len(cameras)
    views, places, colors = [], [], []
    masks = [None] * count if masks is None else masks
    for index, (camera, photo, seen, mask) in enumerate(zip(cameras, photos, points, masks, strict=True)):
        pixels, depths = camera.project(seen)
        inside = (depths > 0) & (pixels >= 0).all(1)
        inside &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        column, row = pixels[inside].long().unbind(1)
        color = photo[row, column]
        usable = (color >= CLIPPED[0]).all(1) & (color <= CLIPPED[1]).all(1)
        if mask is not None:
            usable &= mask[row, column]
        colors.append(color[usable].double().div(255).log().numpy())
        places.append(seen[inside][usable].numpy())
        views.append(np.full(len(colors[-1]), index))
    view, color = np.concatenate(views), np.concatenate(colors)
    gains = np.zeros((count, 3))
    if len(view) == 0:
        return gains
    _, point = np.unique(np.concatenate(places), axis=0, return_inverse=True)
    point = point.reshape(-1)
    weights = np.ones(color.shape)
    for _ in range(ROUNDS):
        for channel in range(3):
            # The points' own colours, eliminated, leave a Laplacian of the photos.
            w, observed = weights[:, channel], color[:, channel]
            totals = 1 / np.bincount(point, w).clip(1e-9)
            shared = coo_array((w, (view, point)), shape=(count, len(totals))).tocsr()
            normal = diags_array(np.bincount(view, w, count)) - shared @ diags_array(totals) @ shared.T
            right = np.bincount(view, w * observed, count) - shared @ (totals * np.bincount(point, w * observed))
            found = spsolve(csc_array(normal + PRIOR * eye_array(count)), right)
            gains[:, channel] = found - found.mean()
            plain = totals * np.bincount(point, w * (observed - gains[view, channel]))
            left = observed - gains[view, channel] - plain[point]
            weights[:, channel] = 1 / (1 + (left / NOISE) ** 2)
    return gains.round(DECIMALS)


def _poses(viewmats: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and viewing directions (..., 3) of world-to-camera matrices (..., 4, 4)."""
    rotation, shift = viewmats[..., :3, :3], viewmats[..., :3, 3:]
    return -(rotation.mT @ shift)[..., 0], rotation[..., 2, :]
