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
SHARPNESS = 0.5  # reach of a photo's gains over the usual distance to the next one
CHUNK = 1024


class Exposures(nn.Module):
    """Gains of photos by the pose of their cameras.

    Buffers: `log_gains` (V, 3); `positions` (V, 3) of the cameras, world units; `directions` (V, 3) unit, where they
    look; `lengths` (2,) world units: what a direction's change by 1 counts, and how far a photo's gains reach.
    """

    def __init__(
        self, log_gains: torch.Tensor, positions: torch.Tensor, directions: torch.Tensor, lengths: torch.Tensor
    ) -> None:
        super().__init__()
        shapes = {
            "log_gains": (log_gains, ("V", 3)),
            "positions": (positions, ("V", 3)),
            "directions": (directions, ("V", 3)),
            "lengths": (lengths, (2,)),
        }
        check_tensors(shapes)
        # Not persistent: they go with the surfels to another device, but are no part of their state.
        for name, (tensor, _) in shapes.items():
            self.register_buffer(name, tensor, persistent=False)

    @classmethod
    def of(cls, log_gains: torch.Tensor, cameras: Sequence[Camera]) -> "Exposures":
        """Exposures of photos with log gains (V, 3) that these V cameras took, V >= 1; float32 on the CPU."""
        viewmats = torch.stack([camera.viewmat.cpu().double() for camera in cameras])
        positions, directions = _poses(viewmats)
        size = (positions - positions.mean(0)).square().sum(1).mean().sqrt()
        lengths = torch.stack([size, SHARPNESS * _usual_distance(torch.cat([positions, size * directions], 1))])
        return cls(*(x.float() for x in (log_gains, positions, directions, lengths)))

    def tensors(self) -> dict[str, torch.Tensor]:
        """Its buffers by name; `Exposures(**tensors)` makes it again."""
        return dict(self.named_buffers())

    @torch.no_grad()
    def gains(self, camera: Camera) -> torch.Tensor:
        """Gains (3,) for the colours of a rendering: the mean of the photos around, the nearest counting most."""
        position, direction = _poses(camera.viewmat.to(self.positions))
        turned = self.lengths[0] * (self.directions - direction)
        squares = (self.positions - position).square().sum(1) + turned.square().sum(1)
        reach = (2 * self.lengths[1].square()).clamp_min(torch.finfo(squares.dtype).tiny)
        return (torch.softmax(-squares / reach, 0) @ self.log_gains).exp()


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


def _usual_distance(poses: torch.Tensor) -> torch.Tensor:
    """Median over poses (V, 6) of the distance to the nearest other one; 0 where there is none."""
    if len(poses) < 2:
        return poses.new_zeros(())
    nearest = []
    for chunk, first in ((poses[i : i + CHUNK], i) for i in range(0, len(poses), CHUNK)):
        distances = torch.cdist(chunk, poses, compute_mode="donot_use_mm_for_euclid_dist")
        distances[torch.arange(len(chunk)), torch.arange(first, first + len(chunk))] = torch.inf
        nearest.append(distances.amin(1))
    return torch.cat(nearest).median()
