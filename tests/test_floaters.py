"""What counts as a floater, and what does not."""

import math

import pytest
import torch

import nexwarp as nw
from nexwarp import floaters as module
from nexwarp.floaters import floaters


def looking_ahead(z: float, width: int = 64, focal: float = 80.0) -> nw.Camera:
    """At (0, 0, z), along z."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = -z
    K = torch.tensor([[focal, 0, width / 2], [0, focal, 24], [0, 0, 1]])
    return nw.Camera(viewmat, K, width, 48, near=0.01)


# Centres (x, y, z) and sizes of squares that face the cameras.
NEAR = (0.0, 0.0, 0.5), 0.3
SMALL = (0.3, 0.3, 0.4), 0.02
BEHIND = (0.0, 0.0, 3.0), 1.0
ASIDE = (3.4, 0.0, 2.0), 0.5


def facing(squares: list[tuple[tuple[float, float, float], float]], device: torch.device) -> nw.Surfels:
    count = len(squares)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    means = torch.tensor([place for place, _ in squares])
    scales = torch.tensor([[size, size] for _, size in squares])
    surfels = nw.Surfels.from_activated(
        means, quats, scales, torch.full((count,), 0.95), torch.full((count, 2), 1.5), torch.zeros(count, 1, 3)
    )
    return surfels.to(device)


@pytest.fixture
def seen_between(monkeypatch: pytest.MonkeyPatch) -> list[nw.Camera]:
    """What `between` returns in the test."""
    cameras: list[nw.Camera] = []
    monkeypatch.setattr(module, "between", lambda *_: cameras)
    return cameras


def found(surfels: nw.Surfels, cameras: list[nw.Camera], max_hits: int = 2) -> list[bool]:
    return floaters(surfels, cameras, [1.0] * len(cameras), torch.Generator(), options={"max_hits": max_hits}).tolist()


@pytest.mark.parametrize("max_hits", [0, 1, 2])
def test_floaters_are_large_and_nearer_than_any_training_view_shows_them(
    max_hits: int, device: torch.device, seen_between: list[nw.Camera]
) -> None:
    """From z = -4 and, between, from -1: at depths 4.5 and 1.5, 4.4 and 1.4, 7 and 4; the last one only between."""
    surfels = facing([NEAR, SMALL, BEHIND, ASIDE], device)
    seen_between.append(looking_ahead(-1.0, width=256))
    assert found(surfels, [looking_ahead(-4.0)], max_hits) == [True, False, False, False]
    # A training view that shows it from no more than twice as far makes it a thing that is there.
    assert not any(found(surfels, [looking_ahead(-4.0), looking_ahead(-2.4)], max_hits))
    assert found(surfels, [looking_ahead(-4.0), looking_ahead(-2.6)], max_hits)[0]


def test_one_view_of_many_tells(device: torch.device, seen_between: list[nw.Camera]) -> None:
    surfels = facing([NEAR, BEHIND], device)
    seen_between += [looking_ahead(-3.0), looking_ahead(-1.0), looking_ahead(-3.5)]
    assert found(surfels, [looking_ahead(-4.0)]) == [True, False]
    seen_between.clear()
    assert not any(found(surfels, [looking_ahead(-4.0)]))


@pytest.mark.parametrize("height", [12, 48, 480])
def test_the_size_of_the_pictures_does_not_matter(height: int, seen_between: list[nw.Camera]) -> None:
    factor = height / 48
    K = torch.tensor([[80.0 * factor, 0, 32 * factor], [0, 80.0 * factor, 24 * factor], [0, 0, 1]])
    cameras = [nw.Camera(looking_ahead(z).viewmat, K, round(64 * factor), height, 0.01) for z in (-4.0, -1.0)]
    seen_between.append(cameras[1])
    assert found(facing([NEAR, SMALL, BEHIND], torch.device("cpu")), cameras[:1]) == [True, False, False]


def test_a_wall_as_near_as_the_nearest_points_is_none(device: torch.device) -> None:
    """All that the cameras see is beyond twice their reach: no view between is nearer to it than the law allows."""
    ring = []
    for i in range(8):
        angle = 2 * math.pi * i / 8
        ring.append(looking_ahead(0.0))
        ring[-1].viewmat[:2, 3] = torch.tensor([math.cos(angle), math.sin(angle)])
        ring[-1].viewmat[2, 3] = 0.8 * math.sin(3 * angle)
    wall = [((x / 2, y / 2, 2.6), 0.4) for x in range(-6, 7) for y in range(-6, 7)]
    surfels = facing(wall, device)
    for seed in range(20):
        chosen = floaters(surfels, ring, [0.8] * 8, torch.Generator().manual_seed(seed), options={"max_hits": 2})
        assert not chosen.any()
