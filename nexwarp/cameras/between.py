"""Random cameras between given ones."""

from collections.abc import Sequence

import torch

from nexwarp.camera import Camera
from nexwarp.cameras.paths import (
    ALIKE,
    BEYOND,
    NEIGHBORS,
    _placed,
    _poses,
)


def between(cameras: Sequence[Camera], reaches: Sequence[float], generator: torch.Generator) -> list[Camera]:
    """Return for each camera one on the way from it to a neighbour, or at most half as far beyond either end.

    The neighbour is drawn from the 4 nearest whose optical axes are within 60 degrees of the camera's; without any,
    the camera stays where it is. Position and rotation go along evenly; all else is the camera's. A rigid motion and
    scaling of all cameras does the same to the result.

    Args:
        cameras: at least one.
        reaches: for each, how far from it the new one may be, world units, >= 0.
        generator: for neighbours and places, on the CPU.
    """
    from scipy.spatial.transform import Rotation

    viewmats, centres = _poses(cameras)
    drawn, places = torch.rand(2, len(cameras), generator=generator, dtype=torch.float64)
    distances = torch.cdist(centres, centres, compute_mode="donot_use_mm_for_euclid_dist")
    axes = viewmats[:, 2, :3]
    distances = distances.where(axes @ axes.mT >= ALIKE, torch.inf).fill_diagonal_(torch.inf)
    nearest = distances.topk(min(NEIGHBORS, len(cameras)), largest=False)
    choices = nearest.values.isfinite().sum(dim=1)
    chosen = (drawn * choices).long()[:, None]
    others = nearest.indices.gather(1, chosen)[:, 0].where(choices > 0, torch.arange(len(cameras)))
    limits = (torch.tensor(reaches, dtype=torch.float64) / nearest.values.gather(1, chosen)[:, 0]).nan_to_num(0.0)
    places = (places * (1 + 2 * BEYOND) - BEYOND).clamp(-limits, limits)
    turned = Rotation.from_matrix(viewmats[:, :3, :3].numpy())
    turns = (turned[others.numpy()] * turned.inv()).as_rotvec() * places[:, None].numpy()
    rotations = torch.from_numpy((Rotation.from_rotvec(turns) * turned).as_matrix())
    positions = torch.lerp(centres, centres[others], places[:, None])
    return [_placed(*each) for each in zip(cameras, rotations, positions, strict=True)]
