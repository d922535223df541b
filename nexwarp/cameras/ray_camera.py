"""Cameras that are no pinholes: a ray for each pixel, of a fisheye lens or a panorama."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from nexwarp.cameras.camera import LARGEST_DISTANCE, Camera
from nexwarp.errors import check_finite, check_integer, check_range, check_tensors

MAX_SIDE = 32768  # pixels
MAX_PARAMETER = 1e3  # of a fisheye lens
SAMPLES = 2**16 + 1  # of a lens, between which its inverse is linear: it misses by less than 1e-9 of a radius


@dataclass(frozen=True)
class RayCamera:
    """A camera with one ray for each pixel, all from its centre, for rendering; not differentiable.

    `panorama` and `fisheye` make one. Its pictures are resampled from pinhole pictures, the faces of a cube, which have
    twice the resolution up to 4,096 pixels a side. A hit's depth is in units of its pixel's ray: the distance from the
    camera for panoramas and fisheye lenses.

    Attributes:
        viewmat: (4, 4) float, world to camera, a rigid motion; x right, y down, z forward.
        rays: (H, W, 3) float, camera frame, directions of any length; a pixel whose ray is 0 sees nothing.
        near: hits are ignored whose z-depth in the picture of their face is at most this.
        focal: pixels in a world unit at depth 1: f of paper Eq. 4; at most 16,384.

    Raises:
        TypeError, ValueError: a type, shape, device or value does not fit; the message names the field.
    """

    viewmat: torch.Tensor
    rays: torch.Tensor
    near: float
    focal: float

    def __post_init__(self) -> None:
        check_tensors({"viewmat": (self.viewmat, (4, 4)), "rays": (self.rays, ("H", "W", 3))})
        height, width, _ = self.rays.shape
        check_range("width", width, 1, MAX_SIDE)
        check_range("height", height, 1, MAX_SIDE)
        check_range("near", self.near, 0, LARGEST_DISTANCE)
        check_range("focal", self.focal, 1e-16, MAX_SIDE / 2)
        # The pose is checked as that of any camera.
        Camera(self.viewmat, torch.eye(3).to(self.viewmat), width, height, self.near)
        check_finite("rays", self.rays)

    @property
    def width(self) -> int:
        """Image width in pixels."""
        return self.rays.shape[1]

    @property
    def height(self) -> int:
        """Image height in pixels."""
        return self.rays.shape[0]

    @property
    def pixel_focal(self) -> float:
        """`focal`: what `Camera.pixel_focal` is for rays."""
        return self.focal

    @property
    def device(self) -> torch.device:
        """Device of `viewmat`."""
        return self.viewmat.device

    @property
    def position(self) -> torch.Tensor:
        """(3,) centre of the camera in the world frame."""
        return -(self.viewmat[:3, :3] * self.viewmat[:3, 3:]).sum(0)  # not a product: see `Camera.position`

    def to(self, *args: Any, **kwargs: Any) -> "RayCamera":
        """Return a copy with `viewmat` and `rays` moved or converted; arguments as of `torch.Tensor.to`."""
        return replace(self, viewmat=self.viewmat.to(*args, **kwargs), rays=self.rays.to(*args, **kwargs))

    @classmethod
    def panorama(cls, viewmat: torch.Tensor, width: int, height: int | None = None, near: float = 0.01) -> "RayCamera":
        """Return an equirectangular panorama of the whole sphere.

        Columns are longitudes, from behind over left, forward (the middle of the image) and right to behind; rows are
        latitudes from straight up (-y) to straight down.

        Args:
            viewmat: (4, 4) world to camera.
            width: pixels around the sphere, at least 4.
            height: pixels from top to bottom; None is half the width.
            near: hits no farther than this are ignored, world units.
        """
        check_integer("width", width, 4, MAX_SIDE)
        height = width // 2 if height is None else height
        check_integer("height", height, 1, MAX_SIDE)
        x, y = _pixel_centers(width, height)
        longitude, latitude = (x / width - 0.5) * 2 * math.pi, (y / height - 0.5) * math.pi
        across = latitude.cos()
        rays = torch.stack([longitude.sin() * across, latitude.sin(), longitude.cos() * across], -1)
        return cls(viewmat, rays.to(viewmat), near, width / (2 * math.pi))

    @classmethod
    def fisheye(
        cls,
        viewmat: torch.Tensor,
        K: torch.Tensor,
        distortion: Sequence[float],
        width: int,
        height: int,
        near: float = 0.01,
        max_angle: float = math.pi,
    ) -> "RayCamera":
        """Return a fisheye camera of Kannala and Brandt's model, as OpenCV and COLMAP's OPENCV_FISHEYE have it.

        A ray at the angle t to the optical axis falls on the radius f (t + k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9). Pixels
        beyond `max_angle`, or beyond the angle up to which the radius grows, see nothing.

        Args:
            viewmat: (4, 4) world to camera.
            K: (3, 3) intrinsics in pixels, without skew.
            distortion: k1 to k4.
            width: image width in pixels.
            height: image height in pixels.
            near: hits no farther than this are ignored, world units.
            max_angle: largest angle to the optical axis, radians, at most pi.
        """
        check_integer("width", width, 1, MAX_SIDE)
        check_integer("height", height, 1, MAX_SIDE)
        checked = Camera(viewmat, K, width, height, near)
        terms = [float(k) for k in distortion]
        if len(terms) != 4:
            raise ValueError(f"distortion: expected k1, k2, k3 and k4, got {len(terms)} numbers")
        for k in terms:
            check_range("distortion", k, -MAX_PARAMETER, MAX_PARAMETER)
        check_range("max_angle", max_angle, 1e-3, math.pi)
        x, y = _pixel_centers(width, height)
        x, y = (x - checked.cx) / checked.fx, (y - checked.cy) / checked.fy
        radius = torch.hypot(x, y)
        angle, valid = _angle_of(radius, terms, max_angle)
        outward = angle.sin() / radius.clamp_min(1e-300)
        rays = torch.stack([x * outward, y * outward, angle.cos()], -1) * valid[..., None]
        return cls(viewmat, rays.to(viewmat), near, checked.focal)


def _pixel_centers(width: int, height: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the x and y (H, W) float64 of the pixels' centres."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=torch.float64) + 0.5, torch.arange(width, dtype=torch.float64) + 0.5, indexing="ij"
    )
    return x, y


def _angle_of(radius: torch.Tensor, terms: Sequence[float], largest: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the angles at which a lens has the given radii, and where there are such angles of at most `largest`.

    The lens is inverted where its radius grows, from the optical axis on.
    """
    angles = np.linspace(0.0, largest, SAMPLES)
    radii = np.polyval([*terms[::-1], 1.0], angles**2) * angles
    falling = np.flatnonzero(np.diff(radii) <= 0)
    end = int(falling[0]) + 1 if len(falling) else SAMPLES
    angle = np.interp(radius.numpy(), radii[:end], angles[:end])
    return torch.from_numpy(angle), radius <= radii[end - 1]
