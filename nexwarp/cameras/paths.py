"""Cameras made of others: paths for videos, random cameras between those of a scene, and a ring around points."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.errors import check_range

DEGENERATE = 1e-6  # below this share of a comparable length, a length counts as zero
WINDOW = 2.0  # standard deviation, in cameras, of the window of `interpolate`
COMMON = 0.9  # least share of the cameras that see the subject of an ellipse
WIDEST_GAP = math.radians(120.0)  # between neighbours around that subject

LEAST_UP = 1e-3  # length of a mean of upward directions that counts as one
MEAN_UP_SHARE = 0.01  # weight of that mean beside the right axes

NEIGHBORS = 4  # nearest cameras of a similar direction, from which the neighbour of `between` is drawn
ALIKE = math.cos(math.radians(60.0))
BEYOND = 0.5  # how far beyond either camera a new one may lie, as a share of their distance

RING_WIDTH, RING_HEIGHT = 1280, 720  # pixels, of `surrounding`
RING_FOV = 0.9  # vertical, radians
RING_DISTANCE = 3.0  # of the cameras from the middle, in median distances of the points from there
RING_RISE = 0.3  # height of the ring above the middle, as a fraction of its radius
UP = (0.0, -1.0, 0.0)  # of most COLMAP models


def ellipse(cameras: Sequence[Camera], count: int = 120) -> list[Camera]:
    """Return `count` cameras on a closed ellipse through the region of the given ones.

    The ellipse lies in the plane of the two principal axes of the camera centres. Along each axis it spans the 5th to
    the 95th percentile of the centres. It starts at the angle of the first camera. All its cameras look at
    `focus(cameras)`, upright as `up_direction`; all else is that of the first camera. If the centres lie on a line, the
    path runs back and forth along it.

    Raises:
        ValueError: fewer than two distinct centres, parallel optical axes, no common up direction, a path that meets
            the focus or passes vertically above or below it, or `count` < 1.
    """
    check_range("count", count, 1)
    viewmats, centres = camera_poses(cameras)
    target, up = focus(cameras), up_direction(cameras)
    if (centres - centres.mean(0)).norm(dim=1).max() <= DEGENERATE * (centres - target).norm(dim=1).max():
        raise ValueError(f"cameras: expected at least two distinct centres, got {len(cameras)} cameras at one place")
    mean = centres.mean(0)
    axes = torch.linalg.svd(centres - mean)[2][:2]
    # The signs of the axes are arbitrary. The cameras' mean down direction, or forward direction for a vertical plane,
    # decides the sense of rotation. The signs have no other effect, as the path starts at the first camera.
    normal = torch.linalg.cross(axes[0], axes[1])
    if max((viewmats[:, 1:3, :3].mean(0) @ normal).tolist(), key=abs) > 0.0:
        axes = axes * axes.new_tensor([[1.0], [-1.0]])
    low, high = torch.quantile((centres - mean) @ axes.T, axes.new_tensor([0.05, 0.95]), dim=0)
    centre, semi = mean + (low + high) / 2.0 @ axes, (high - low) / 2.0
    x, y = ((axes @ (centres[0] - centre)) / semi.clamp(min=DEGENERATE * semi.max().item())).tolist()
    angles = math.atan2(y, x) + torch.arange(count, dtype=torch.float64) * (2.0 * math.pi / count)
    offsets = torch.stack([torch.cos(angles), torch.sin(angles)], dim=1) * semi @ axes
    return [_looking(cameras[0], centre + offset, target, up) for offset in offsets]


def through(cameras: Sequence[Camera], count: int = 120) -> list[Camera]:
    """Return `count` cameras on a smooth path that passes through all of the given ones, from the first to the last.

    The time between two cameras is proportional to their distance and rotation. Centres follow a cubic spline,
    rotations one of continuous angular acceleration. All else is that of the first camera. ValueError: fewer than two
    distinct cameras, or `count` < 1.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    check_range("count", count, 1)
    viewmats, centres = camera_poses(cameras)
    turned = Rotation.from_matrix(viewmats[:, :3, :3].mT.numpy())
    turns = (turned[:-1].inv() * turned[1:]).magnitude() if len(cameras) > 1 else np.zeros(0)
    times, distinct = _times((centres[1:] - centres[:-1]).norm(dim=1).numpy(), turns)
    at = np.linspace(0.0, times[-1], count)
    positions = CubicSpline(times, centres.numpy()[distinct], bc_type="natural")(at)
    rotations = RotationSpline(times, turned[distinct])(at).inv().as_matrix()
    placed = zip(torch.from_numpy(rotations), torch.from_numpy(positions), strict=True)
    return [with_pose(cameras[0], rotation, position) for rotation, position in placed]


def interpolate(cameras: Sequence[Camera], count: int = 120) -> list[Camera]:
    """Return `count` cameras on a smooth path along the given ones, as someone walked who held the camera by hand.

    Centres and viewing directions are means of those of neighbours in the list, under a Gaussian window of 2 cameras
    (a tenth of the list if that is less). The path takes time in proportion to distance and turn. Its cameras are
    upright as `up_direction`; all else is that of the first camera. ValueError: fewer than two distinct cameras, a path
    that looks straight up or down, or `count` < 1.
    """
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import gaussian_filter1d

    check_range("count", count, 1)
    viewmats, centres = camera_poses(cameras)
    up = up_direction(cameras)
    poses = torch.cat([centres, viewmats[:, 2, :3]], dim=1).numpy()
    smoothed = gaussian_filter1d(poses, min(WINDOW, len(cameras) / 10), axis=0, mode="nearest")
    times, distinct = _times(*(np.linalg.norm(np.diff(x, axis=0), axis=1) for x in np.split(smoothed, 2, axis=1)))
    at = np.linspace(0.0, times[-1], count)
    path = torch.from_numpy(CubicSpline(times, smoothed[distinct], bc_type="natural")(at))
    return [_looking(cameras[0], pose[:3], pose[:3] + pose[3:], up) for pose in path]


def _times(ways: np.ndarray, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times of the distinct poses among n, and which these are (n,), from the n - 1 distances and rotations."""
    # Equal poses in sequence become one; otherwise the path would stop there.
    spans = np.zeros(len(ways))
    for lengths in (ways, turns):
        spans += lengths / lengths.mean() if lengths.sum() > 0.0 else 0.0
    distinct = np.concatenate([[True], spans > DEGENERATE])
    if distinct.sum() < 2:
        raise ValueError(f"cameras: expected at least two distinct ones, got {len(distinct)} that are the same")
    return np.concatenate([[0.0], spans.cumsum()])[distinct], distinct


def suited_path(cameras: Sequence[Camera]) -> str:
    """Return "ellipse" for cameras that look at a common subject from all around it, otherwise "interpolate"."""
    return "ellipse" if _surround(cameras, 1.0) else "interpolate"


def subject(cameras: Sequence[Camera]) -> tuple[torch.Tensor, float] | None:
    """Return a ball around what cameras all around have in the middle of their images; None for other cameras.

    Its centre (3,) float64 is their focus, its radius half the longer side of what an image shows there (the median).
    """
    if not _surround(cameras, 0.5):
        return None
    target, _ = focus_ahead(cameras)
    depths = [camera.viewmat[2].double().cpu() @ torch.cat([target, target.new_ones(1)]) for camera in cameras]
    sides = [max(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras]
    return target, float(np.median([depth * side / 2 for depth, side in zip(depths, sides, strict=True)]))


def _surround(cameras: Sequence[Camera], middle: float) -> bool:
    """Whether nine of ten images have the focus in their middle, a share of either side.

    And no angle about it of more than 120 degrees is without a camera.
    """
    target, share = focus_ahead(cameras)
    if share < COMMON:
        return False
    viewmats, centres = camera_poses(cameras)
    seen = torch.stack([each.K.detach().double().cpu() for each in cameras]) @ (
        viewmats[:, :3, :3] @ target + viewmats[:, :3, 3]
    ).unsqueeze(2)
    places = seen[:, :2, 0] / seen[:, 2:, 0] / torch.tensor([[each.width, each.height] for each in cameras])
    inside = ((seen[:, 2, 0] > 0.0) & ((places - 0.5).abs() < middle / 2).all(dim=1)).double().mean()
    level = torch.linalg.svd(up_direction(cameras)[None])[2][1:]
    angles = torch.atan2(*((centres - target) @ level.T).unbind(1)).sort().values
    gaps = torch.cat([angles, angles[:1] + 2.0 * math.pi]).diff()
    return bool(inside >= COMMON and gaps.max() <= WIDEST_GAP)


def between(cameras: Sequence[Camera], generator: torch.Generator) -> list[Camera]:
    """Draw for each camera a new one on the line through it and a neighbour.

    The new camera lies between the two or beyond either by at most half their distance. The neighbour is drawn from the
    4 nearest cameras whose optical axes are within 60 degrees of the camera's; without any, the pose stays. Position
    and rotation are interpolated linearly; all else is the camera's.
    """
    from scipy.spatial.transform import Rotation

    viewmats, centres = camera_poses(cameras)
    drawn, places = torch.rand(2, len(cameras), generator=generator, dtype=torch.float64)
    distances = torch.cdist(centres, centres, compute_mode="donot_use_mm_for_euclid_dist")
    axes = viewmats[:, 2, :3]
    distances = distances.where(axes @ axes.mT >= ALIKE, torch.inf).fill_diagonal_(torch.inf)
    nearest = distances.topk(min(NEIGHBORS, len(cameras)), largest=False)
    choices = nearest.values.isfinite().sum(dim=1)
    chosen = (drawn * choices).long()[:, None]
    others = nearest.indices.gather(1, chosen)[:, 0].where(choices > 0, torch.arange(len(cameras)))
    places = places * (1 + 2 * BEYOND) - BEYOND
    turned = Rotation.from_matrix(viewmats[:, :3, :3].numpy())
    turns = (turned[others.numpy()] * turned.inv()).as_rotvec() * places[:, None].numpy()
    rotations = torch.from_numpy((Rotation.from_rotvec(turns) * turned).as_matrix())
    positions = torch.lerp(centres, centres[others], places[:, None])
    return [with_pose(*each) for each in zip(cameras, rotations, positions, strict=True)]


def surrounding(points: torch.Tensor, near: float, count: int = 12) -> list[Camera]:
    """Return cameras on a ring around the median of points (N, 3), which they look at, with up direction -y.

    The radius is three times the median distance of the points from their median. The cameras have 1280 x 720 pixels, a
    vertical field of view of 0.9 rad and the near depth `near`, float32 on the CPU.
    """
    positions = points.detach().double().cpu()
    middle = positions.median(dim=0).values if len(positions) else torch.zeros(3, dtype=torch.float64)
    spread = (positions - middle).norm(dim=1).median().item() if len(positions) else 1.0
    radius = RING_DISTANCE * (spread or 1.0)
    up = torch.tensor(UP, dtype=torch.float64)
    focal = 0.5 * RING_HEIGHT / math.tan(0.5 * RING_FOV)
    K = torch.tensor([[focal, 0.0, RING_WIDTH / 2], [0.0, focal, RING_HEIGHT / 2], [0.0, 0.0, 1.0]])
    turns = [2.0 * math.pi * index / count for index in range(count)]
    ways = [torch.tensor([math.sin(x), 0.0, -math.cos(x)], dtype=torch.float64) + RING_RISE * up for x in turns]
    viewmats = [look_at(middle + radius * way, middle, up).float() for way in ways]
    return [Camera(viewmat, K, RING_WIDTH, RING_HEIGHT, near) for viewmat in viewmats]


def focus(cameras: Sequence[Camera]) -> torch.Tensor:
    """(3,) float64, the world point closest to all optical axes; ValueError without cameras or with parallel axes."""
    viewmats, centres = camera_poses(cameras)
    axes = viewmats[:, 2, :3]
    # Each matrix projects a vector onto the plane orthogonal to its axis.
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None, :]
    if torch.linalg.eigvalsh(across.mean(0))[0] < DEGENERATE**2:
        raise ValueError(f"cameras: expected two or more with axes that are not parallel, got {len(cameras)}")
    return torch.linalg.solve(across.mean(0), (across @ centres[:, :, None]).mean(0)[:, 0])


def look_at(position: torch.Tensor, target: torch.Tensor, up: torch.Tensor) -> torch.Tensor:
    """(4, 4) world-to-camera matrix at `position` looking at `target`, with `up` upwards in the image; (3,) each."""
    forward = target - position
    right = torch.linalg.cross(forward, up)
    if right.norm() <= DEGENERATE * forward.norm() or forward.norm() == 0:
        raise ValueError("up: expected a direction across the line from position to target, got none or one along it")
    forward, right = forward / forward.norm(), right / right.norm()
    viewmat = torch.eye(4, dtype=position.dtype, device=position.device)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return viewmat


def _looking(camera: Camera, position: torch.Tensor, target: torch.Tensor, up: torch.Tensor) -> Camera:
    return replace(camera, viewmat=look_at(position, target, up).to(camera.viewmat))


def with_pose(camera: Camera, rotation: torch.Tensor, position: torch.Tensor) -> Camera:
    """Return `camera` with another world-to-camera rotation (3, 3) and centre (3,), both float64 on the CPU."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    return replace(camera, viewmat=viewmat.to(camera.viewmat))


def up_direction(cameras: Sequence[Camera]) -> torch.Tensor:
    """Upward direction of a scene in its world, (3,) float64 of length 1.

    People tilt cameras more than they roll them, so it is the direction most perpendicular to the cameras' right axes.
    The mean of their upward directions counts a little: it decides where all right axes are alike. -y if that mean is
    zero, and without cameras.
    """
    fallback = torch.tensor(UP, dtype=torch.float64)
    if not cameras:
        return fallback
    viewmats, _ = camera_poses(cameras)
    mean_up = -viewmats[:, 1, :3].mean(0)
    if mean_up.norm() < LEAST_UP:
        return fallback
    mean_up = mean_up / mean_up.norm()
    rights = viewmats[:, 0, :3]
    across = torch.eye(3, dtype=torch.float64) - mean_up[:, None] * mean_up
    up = torch.linalg.eigh(rights.mT @ rights / len(cameras) + MEAN_UP_SHARE * across).eigenvectors[:, 0]
    return up if up @ mean_up > 0.0 else -up


def camera_poses(cameras: Sequence[Camera]) -> tuple[torch.Tensor, torch.Tensor]:
    """World-to-camera matrices (n, 4, 4) and centres (n, 3), float64 on the CPU; ValueError without cameras."""
    if not cameras:
        raise ValueError("cameras: expected at least one, got none")
    viewmats = torch.stack([camera.viewmat.detach().double().cpu() for camera in cameras])
    return viewmats, -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]


def focus_ahead(cameras: Sequence[Camera]) -> tuple[torch.Tensor, float]:
    """Return `focus(cameras)` and the share of the cameras that it lies in front of; 0 where there is no focus."""
    try:
        target = focus(cameras)
    except ValueError:
        return torch.zeros(3, dtype=torch.float64), 0.0
    viewmats, _ = camera_poses(cameras)
    ahead = (viewmats[:, :3, :3] @ target + viewmats[:, :3, 3])[:, 2] > 0.0
    return target, ahead.double().mean().item()


PATHS = {"ellipse": ellipse, "interpolate": interpolate}
