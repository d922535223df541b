"""Similarities: rotations, uniform scalings and shifts of all coordinates of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import up_direction


@dataclass(frozen=True)
class Similarity:
    """A motion to other coordinates: a point x goes to scale * rotation @ x + shift."""

    rotation: np.ndarray  # (3, 3) float64, with determinant 1
    shift: np.ndarray  # (3,) float64, in the new units
    scale: float = 1.0  # new units in an old one, > 0

    @property
    def is_identity(self) -> bool:
        """Whether it moves nothing."""
        return self.scale == 1.0 and not self.shift.any() and bool((self.rotation == np.eye(3)).all())

    def then(self, other: "Similarity") -> "Similarity":
        """Return this motion followed by another one."""
        rotation = other.rotation @ self.rotation
        return Similarity(rotation, other.scale * other.rotation @ self.shift + other.shift, other.scale * self.scale)

    def inverse(self) -> "Similarity":
        """Return the motion back."""
        return Similarity(self.rotation.T, -self.rotation.T @ self.shift / self.scale, 1 / self.scale)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Move points (..., 3); the result is float64."""
        return self.scale * points.astype(np.float64) @ self.rotation.T + self.shift

    def directions(self, directions: np.ndarray) -> np.ndarray:
        """Turn directions (..., 3), such as normals; the dtype stays."""
        return (directions @ self.rotation.T).astype(directions.dtype)

    def camera(self, camera: Camera) -> Camera:
        """Return the camera that shows the moved scene as `camera` the one before; it has no `origin` any more.

        Depths in its picture are `scale` times those of the other one.
        """
        if self.is_identity:
            return camera
        viewmat = camera.viewmat.detach().double().cpu().numpy().copy()
        viewmat[:3, :3] = viewmat[:3, :3] @ self.rotation.T
        viewmat[:3, 3] = self.scale * viewmat[:3, 3] - viewmat[:3, :3] @ self.shift
        moved = torch.from_numpy(viewmat).to(camera.viewmat)
        return replace(camera, viewmat=moved, near=camera.near * self.scale, origin=None)


IDENTITY = Similarity(np.eye(3), np.zeros(3))


def upright(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the rotation (3, 3) float64 that turns the cameras' common upward direction to +y, by the least angle.

    Where that direction points to -y, as of most COLMAP models, y and z change their signs before.
    """
    up = up_direction(cameras).numpy()
    flip = np.diag([1.0, -1.0, -1.0]) if up[1] < 0 else np.eye(3)
    x, y, z = flip @ up
    across = np.array([[0.0, -x, 0.0], [x, 0.0, z], [0.0, -z, 0.0]])  # of the cross product with (x, y, z) x +y
    return (np.eye(3) + across + across @ across / (1 + y)) @ flip
