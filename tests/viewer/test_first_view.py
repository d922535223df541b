"""The first view of the viewer: a camera that few frustums stand in front of, and frustums that stay apart."""

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.viewer.world import LARGEST_FRUSTUM, SMALLEST_FRUSTUM, clearest, frustum_size

K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])


def camera_at(x: float, z: float) -> nw.Camera:
    """A camera that looks along z."""
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor([x, 0.0, z])
    return nw.Camera(viewmat, K, 64, 48)


def test_the_first_view_has_the_other_cameras_behind_it() -> None:
    row = [camera_at(0.01 * z, float(z)) for z in (0, 3, 1, 2)]
    assert clearest(row) is row[1]
    # Of cameras side by side, none sees another: the first one.
    beside = [camera_at(float(x), 0.0) for x in range(4)]
    assert clearest(beside) is beside[0]
    far = [camera_at(0.0, 0.0), camera_at(0.0, 50.0), camera_at(40.0, 0.0), camera_at(40.0, 1.0)]
    assert clearest([far[2], far[0], far[1], far[3]]) is far[1]


@pytest.mark.parametrize("spacing", [0.1, 0.2, 1.0])
def test_frustums_of_neighbours_stay_apart(spacing: float) -> None:
    places = spacing * np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0), [0.0]), axis=-1).reshape(-1, 3)
    assert frustum_size(places) == pytest.approx(min(0.4 * spacing, LARGEST_FRUSTUM))
    assert frustum_size(np.zeros((9, 3))) == SMALLEST_FRUSTUM
    assert frustum_size(np.zeros((1, 3))) == LARGEST_FRUSTUM
