"""Rigid corrections of the training cameras, learned with the scene. Not in the paper."""

import copy
import math
from collections.abc import Sequence

import torch
from torch import nn

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import camera_poses
from nexwarp.errors import check_range, check_tensors
from nexwarp.machine import torch_threads

# Terms of the series of sin(x) / x and the like: exact in double precision for angles of up to pi.
TERMS = 14
# Directions of the gauge that are this much smaller than the largest do not exist, as the scale of a single camera.
LEAST_SINGULAR = 1e-6


def rigid_motion(twist: torch.Tensor) -> torch.Tensor:
    """Return exp(twist) (..., 4, 4), the rigid motion of a twist (..., 6); differentiable everywhere, at 0 too.

    A twist is a rotation vector in radians, of at most pi in length, and a velocity in world units.
    """
    w, v = twist[..., :3], twist[..., 3:]
    square = (w * w).sum(-1)[..., None, None]
    # sin(x) / x, (1 - cos x) / x^2 and (x - sin x) / x^3 are series in x^2, so that nothing is divided by 0.
    first, second, third = (_series(square, lowest) for lowest in (1, 2, 3))
    zero = torch.zeros_like(w[..., 0])
    x, y, z = w.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    twice, eye = skew @ skew, torch.eye(3, dtype=twist.dtype, device=twist.device)
    rotation = eye + first * skew + second * twice
    shift = (eye + second * skew + third * twice) @ v[..., None]
    # Assigning a number would copy it from the CPU, which a CUDA graph cannot capture.
    last_row = nn.functional.pad(twist.new_ones(1, 1), (3, 0, 3, 0))
    return nn.functional.pad(torch.cat([rotation, shift], dim=-1), (0, 0, 0, 1)) + last_row


def _series(square: torch.Tensor, lowest: int) -> torch.Tensor:
    """Sum over k of (-square)^k / (2 k + lowest)!."""
    total = torch.zeros_like(square)
    for k in reversed(range(TERMS)):
        total = total * -square + 1 / math.factorial(2 * k + lowest)
    return total


def corrected(viewmat: torch.Tensor, twist: torch.Tensor, pivot: torch.Tensor) -> torch.Tensor:
    """Return a viewmat (4, 4) after a small motion (6,) about the point at z-depth `pivot` on its optical axis.

    Differentiable. About a point of the scene, a turn and a shift change an image in different ways. About the camera's
    own centre both move the image sideways, which gradient descent cannot tell apart.
    """
    motion = rigid_motion(twist)
    ahead = torch.cat([torch.zeros_like(twist[:2]), pivot[None]])
    shift = motion[:3, 3] + ahead - motion[:3, :3] @ ahead
    return torch.cat([torch.cat([motion[:3, :3], shift[:, None]], 1), motion[3:]]) @ viewmat


class PoseCorrections(nn.Module):
    """Rigid corrections of V cameras, about points of the scene that they see; see `corrected`.

    The photos determine poses up to a similarity of the world: a common rotation, shift and scale of all cameras and
    surfels changes no rendering (the gauge). `keep_gauge` removes from the corrections what is such a common motion, to
    first order, so that the corrected cameras stay where the given ones are, and with them the test cameras.

    The parameter `corrections` (V, 6) has radians, and shifts in units of `scale`, along the axes of the cameras.
    """

    gauge: torch.Tensor  # (6 V, G) orthonormal directions that change no rendering, G <= 7; not saved
    pivots: torch.Tensor  # (V,) z-depths of the points about which the corrections turn, world units; not saved

    def __init__(self, cameras: Sequence[Camera], scale: float, depths: Sequence[float] | None = None) -> None:
        """Start with no correction; `depths` are V typical z-depths of what the cameras see, None is `scale`."""
        super().__init__()
        check_range("scale", scale, 1e-30, 1e30)
        self.scale = scale
        self.corrections = nn.Parameter(torch.zeros(len(cameras), 6))
        pivots = torch.tensor([scale] * len(cameras) if depths is None else list(depths), dtype=torch.float64)
        self.register_buffer("gauge", _gauge_directions(cameras, pivots, scale).float().contiguous(), persistent=False)
        self.register_buffer("pivots", pivots.float().contiguous(), persistent=False)

    def camera(self, given: Camera, view: int | torch.Tensor) -> Camera:
        """Return the corrected camera of a view, a number or a (1,) int64 tensor; differentiable.

        Its image may have been cropped or reduced.
        """
        turn, shift = _row(self.corrections, view).split(3)
        twist = torch.cat([turn, self.scale * shift])
        camera = copy.copy(given)  # of its own class: a staged camera has its focal length on the device
        vars(camera)["viewmat"] = corrected(given.viewmat, twist, _row(self.pivots, view))
        return camera

    @torch.no_grad()
    def cameras(self, given: Sequence[Camera]) -> list[Camera]:
        """Return the corrected cameras of all views, without a gradient."""
        return [self.camera(camera, index) for index, camera in enumerate(given)]

    def prior(self, view: torch.Tensor) -> torch.Tensor:
        """Return the squared length of a view's correction, a scalar: what keeps it small."""
        return self.corrections.index_select(0, view).square().sum()

    @torch.no_grad()
    def keep_gauge(self) -> None:
        """Remove from the corrections, in place, what moves all cameras as one."""
        flat = self.corrections.view(-1)
        flat -= self.gauge @ (self.gauge.T @ flat)

    def load(self, corrections: torch.Tensor) -> None:
        """Overwrite the corrections, in place; ValueError where their shape is another."""
        check_tensors({"corrections": (corrections, tuple(self.corrections.shape))})
        self.corrections.data.copy_(corrections)


def _row(values: torch.Tensor, view: int | torch.Tensor) -> torch.Tensor:
    """Return the values of a view, whose index is a number or a (1,) tensor."""
    return values[view] if isinstance(view, int) else values.index_select(0, view)[0]


def _gauge_directions(cameras: Sequence[Camera], pivots: torch.Tensor, scale: float) -> torch.Tensor:
    """Orthonormal basis (6 V, G) of the corrections that a similarity of the world makes, to first order."""
    viewmats, centers = camera_poses(cameras)
    rotations = viewmats[:, :3, :3]
    offsets = centers - centers.mean(0)  # about the cameras' middle: turns and shifts are then of like size
    forward = torch.tensor([[0.0, 0.0, 1.0]], dtype=viewmats.dtype)
    columns = []
    for axis in torch.eye(3, dtype=viewmats.dtype):
        turned = rotations @ axis
        moved = (rotations @ torch.linalg.cross(axis.expand_as(offsets), offsets)[..., None])[..., 0]
        # The same motion, written about the pivots instead of the cameras' centres.
        moved = moved - torch.linalg.cross(pivots[:, None] * forward, turned)
        columns += [torch.cat([turned, moved / scale], -1), torch.cat([torch.zeros_like(turned), turned], -1)]
    outward = -(rotations @ offsets[..., None])[..., 0] / scale
    columns.append(torch.cat([torch.zeros_like(outward), outward], -1))
    with torch_threads(1):  # the same bits whatever the number of cores
        basis, sizes, _ = torch.linalg.svd(torch.stack(columns, -1).flatten(0, 1), full_matrices=False)
    return basis[:, sizes > LEAST_SINGULAR * sizes[0]]


def pose_differences(one: torch.Tensor, other: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the angles (V,) in degrees and distances of the centres (V,) in world units of viewmats (V, 4, 4)."""
    first, second = one.double(), other.double()
    turn = first[:, :3, :3] @ second[:, :3, :3].mT
    # From the chord, which is exact for small angles, where the cosine is not.
    chord = torch.linalg.matrix_norm(turn - torch.eye(3, dtype=turn.dtype, device=turn.device)) / 8**0.5
    centers = [-(x[:, :3, :3].mT @ x[:, :3, 3:])[..., 0] for x in (first, second)]
    return torch.rad2deg(2 * torch.asin(chord.clamp(max=1.0))), (centers[0] - centers[1]).norm(dim=-1)
