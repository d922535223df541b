"""Camera paths for videos."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from nexwarp.camera import Camera
from nexwarp.ops.checks import check_range

DEGENERATE = 1e-6  # below this share of a comparable length, a length counts as zero


def ellipse(cameras: Sequence[Camera], count: int = 120) -> list[Camera]:
    """Return `count` cameras on a closed ellipse through the region of the given ones.

    The ellipse lies in the plane of the camera centres (through their mean, along their two main axes).
    Along each axis it spans 90 % of them, from the 5th to the 95th percentile; it starts beside the first
    camera. All its cameras look at `focus(cameras)`, with the mean up direction, and have intrinsics, size,
    near, dtype and device of the first one. Centres on one line give a path to and fro along it. A rigid
    motion and scaling of all cameras does the same to the path.

    Raises:
        ValueError: fewer than two distinct centres, parallel optical axes, no common up direction, or a path
            that meets the focus or passes straight above or below it; `count` < 1.
    """
    check_range("count", count, 1)
    viewmats, centres = _poses(cameras)
    target, up = focus(cameras), -viewmats[:, 1, :3].mean(0)
    if (centres - centres.mean(0)).norm(dim=1).max() <= DEGENERATE * (centres - target).norm(dim=1).max():
        raise ValueError(f"cameras: expected at least two distinct centres, got {len(cameras)} cameras at one place")
    centre, axes, semi = _fit_ellipse(viewmats, centres)
    x, y = ((axes @ (centres[0] - centre)) / semi.clamp(min=DEGENERATE * semi.max().item())).tolist()
    angles = math.atan2(y, x) + torch.arange(count, dtype=torch.float64) * (2.0 * math.pi / count)
    offsets = torch.stack([torch.cos(angles), torch.sin(angles)], dim=1) * semi @ axes
    first = cameras[0]
    viewmats = [look_at(centre + offset, target, up).to(first.viewmat) for offset in offsets]
    return [replace(first, viewmat=viewmat) for viewmat in viewmats]


def focus(cameras: Sequence[Camera]) -> torch.Tensor:
    """(3,) float64, the world point with the least sum of squared distances to the optical axes.

    Raises:
        ValueError: the axes are parallel, as a single camera's are.
    """
    viewmats, centres = _poses(cameras)
    axes = viewmats[:, 2, :3]
    # Each matrix takes off the part of a vector that is along its axis.
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None, :]
    if torch.linalg.eigvalsh(across.mean(0))[0] < DEGENERATE**2:
        raise ValueError(f"cameras: expected two or more with axes that are not parallel, got {len(cameras)}")
    return torch.linalg.solve(across.mean(0), (across @ centres[:, :, None]).mean(0)[:, 0])


def look_at(position: torch.Tensor, target: torch.Tensor, up: torch.Tensor) -> torch.Tensor:
    """(4, 4) world-to-camera matrix at `position` looking at `target`, `up` being up in the image; (3,) each.

    Raises:
        ValueError: `target` is at `position`, or `up` is zero or along the line between them.
    """
    forward = target - position
    right = torch.linalg.cross(forward, up)
    if right.norm() <= DEGENERATE * forward.norm() or forward.norm() == 0:
        raise ValueError("up: expected a direction across the line from position to target, got none or one along it")
    forward, right = forward / forward.norm(), right / right.norm()
    viewmat = torch.eye(4, dtype=position.dtype, device=position.device)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return viewmat


def _poses(cameras: Sequence[Camera]) -> tuple[torch.Tensor, torch.Tensor]:
    """World-to-camera matrices (n, 4, 4) and centres (n, 3), float64 on the CPU."""
    if not cameras:
        raise ValueError("cameras: expected at least one, got none")
    viewmats = torch.stack([camera.viewmat.detach().double().cpu() for camera in cameras])
    return viewmats, -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]


def _fit_ellipse(viewmats: torch.Tensor, centres: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Centre (3,), unit axes (2, 3) and semi-axes (2,) of the ellipse, counter-clockwise from above."""
    mean = centres.mean(0)
    axes = torch.linalg.svd(centres - mean)[2][:2]
    # The axes come with arbitrary signs. The cameras' down or, in an upright plane, forward direction settles
    # the sense of rotation; the start at the first camera makes the rest irrelevant.
    normal = torch.linalg.cross(axes[0], axes[1])
    if max((viewmats[:, 1:3, :3].mean(0) @ normal).tolist(), key=abs) > 0.0:
        axes = axes * axes.new_tensor([[1.0], [-1.0]])
    low, high = torch.quantile((centres - mean) @ axes.T, axes.new_tensor([0.05, 0.95]), dim=0)
    return mean + (low + high) / 2.0 @ axes, axes, (high - low) / 2.0
