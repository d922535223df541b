"""Random cameras between the cameras of a scene."""

import math
from collections.abc import Sequence

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import camera_poses, with_pose

NEIGHBORS = 4  # nearest cameras of a similar direction, from which the neighbour is drawn
ALIKE = math.cos(math.radians(60.0))
BEYOND = 0.5  # how far beyond either camera a new one may lie, as a share of their distance


def between(cameras: Sequence[Camera], generator: torch.Generator) -> list[Camera]:
    """Draw for each camera a new one on the line through it and a neighbour.

    The new camera lies between the two or beyond either by at most half their distance. The neighbour is drawn from the
    4 nearest cameras whose optical axes are within 60 degrees of the camera's; without any, the pose stays. Position
    and rotation are interpolated linearly; intrinsics, size, near, dtype and device are the camera's. The result is
    equivariant under rigid motions and scaling of all cameras.

    Args:
        cameras: at least one.
        generator: CPU generator of all random numbers.

    Returns:
        One camera for each given one, in their order.

    Raises:
        ValueError: no cameras.
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
