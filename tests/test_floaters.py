"""What counts as a floater, and what does not."""

import math

import pytest
import torch

import nexwarp as nw
from nexwarp import floaters as module
from nexwarp.data import View
from nexwarp.floaters import floaters, reach


def looking_ahead(z: float, width: int = 64, focal: float = 80.0) -> nw.Camera:
    """At (0, 0, z), along z."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = -z
    K = torch.tensor([[focal, 0, width / 2], [0, focal, 24], [0, 0, 1]])
    return nw.Camera(viewmat, K, width, 48, near=0.01)


# Centres (x, y, z) and sizes of squares that face the cameras.
NEAR = (0.0, 0.0, 0.0), 0.3
SMALL = (0.3, 0.15, -0.1), 0.002
BEHIND = (0.0, 0.0, 0.5), 1.0


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
def between(monkeypatch: pytest.MonkeyPatch) -> list[nw.Camera]:
    """What `nexwarp.paths.between` returns in the test."""
    cameras: list[nw.Camera] = []
    monkeypatch.setattr(module, "between", lambda *_: cameras)
    return cameras


def found(surfels: nw.Surfels, reaches: list[float], max_hits: int = 2) -> list[bool]:
    cameras = [looking_ahead(-9.0)] * len(reaches)
    return floaters(surfels, cameras, reaches, torch.Generator(), options={"max_hits": max_hits}).tolist()


@pytest.mark.parametrize("max_hits", [0, 1, 2])
def test_floaters_are_large_and_nearer_than_the_reach(
    max_hits: int, device: torch.device, between: list[nw.Camera]
) -> None:
    """From z = -1, at depths of 1, 0.9 and 1.5, which are 0.75 of 1.33, 1.2 and 2."""
    surfels = facing([NEAR, SMALL, BEHIND], device)
    between.append(looking_ahead(-1.0))
    assert found(surfels, [1.34], max_hits) == [True, False, False]
    assert found(surfels, [1.32], max_hits) == [False, False, False]
    assert found(surfels, [2.1], max_hits) == [True, False, True]
    assert found(surfels, [0.0], max_hits) == [False, False, False]


def test_any_view_tells_by_its_own_reach(device: torch.device, between: list[nw.Camera]) -> None:
    """From z = -3, -1 and -3.5: the nearer square is at 3, 1 and 3.5."""
    surfels = facing([NEAR, BEHIND], device)
    between += [looking_ahead(-3.0), looking_ahead(-1.0), looking_ahead(-3.5)]
    assert found(surfels, [0.5, 1.5, 0.5]) == [True, False]
    assert found(surfels, [1.5, 0.5, 1.5]) == [False, False]
    assert found(surfels, [0.5, 0.5, 6.0]) == [True, True]


@pytest.mark.parametrize("height", [12, 48, 240])
def test_the_size_of_the_pictures_does_not_matter(height: int, between: list[nw.Camera]) -> None:
    factor = height / 48
    K = torch.tensor([[80.0 * factor, 0, 32 * factor], [0, 80.0 * factor, 24 * factor], [0, 0, 1]])
    between.append(nw.Camera(looking_ahead(-1.0).viewmat, K, round(64 * factor), height, 0.01))
    assert found(facing([NEAR, SMALL, BEHIND], torch.device("cpu")), [1.5]) == [True, False, False]


def test_sixty_views_are_looked_at_or_one_for_each_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    looks = []
    monkeypatch.setattr(module, "between", lambda cameras, *_: looks.append(len(cameras)) or cameras)
    for count in (1, 40, 130):
        looks.clear()
        found(facing([NEAR], torch.device("cpu")), [1.0] * count)
        assert looks == [count] * {1: 60, 40: 2, 130: 1}[count]


def test_a_wall_as_far_as_the_nearest_points_is_none(device: torch.device) -> None:
    """From twice the reach on, whatever the way between cameras: here at 2.1 times the reach, or more."""
    ring = []
    for i in range(8):
        angle = 2 * math.pi * i / 8
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([math.cos(angle), math.sin(angle), 0.3 * math.sin(3 * angle)])
        ring.append(nw.Camera(viewmat, looking_ahead(0.0).K, 64, 48, 0.01))
    wall = [((x / 2, y / 2, 2.4), 0.4) for x in range(-6, 7) for y in range(-6, 7)]
    surfels = facing(wall, device)
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        assert not floaters(surfels, ring, [1.0] * 8, generator, options={"max_hits": 2}).any()
        assert floaters(surfels, ring, [4.0] * 8, generator, options={"max_hits": 2}).any()


def test_reach_by_hand() -> None:
    """Half of the least depth; of 250 points the two nearest may be wrong; 19 are too few, and none is out of sight."""

    def reach_of(depths: torch.Tensor, aside: float = 0.0) -> float:
        pixels = torch.stack([torch.arange(len(depths)) % 16 * 4 + 2.0, torch.arange(len(depths)) // 16 * 3 + 1.5], 1)
        rays = (pixels - torch.tensor([32.0, 24.0])) / 80 + torch.tensor([aside, 0.0])
        points = torch.cat([rays, torch.ones(len(depths), 1)], 1) * depths[:, None]
        image = torch.zeros(48, 64, 3, dtype=torch.uint8)
        return reach(View(looking_ahead(0.0), image, None, "one", points=points))

    assert reach_of(torch.arange(30.0) + 4) == pytest.approx(2.0)
    depths = torch.arange(250.0) + 6
    depths[:2] = 0.02
    assert reach_of(depths[torch.randperm(250)]) == pytest.approx(4.0)
    assert reach_of(torch.ones(19)) == 0.0 and reach_of(torch.ones(20)) == pytest.approx(0.5)
    assert reach_of(torch.ones(20), aside=3.0) == 0.0
    assert reach(View(looking_ahead(0.0), torch.zeros(48, 64, 3, dtype=torch.uint8), None, "one")) == 0.0
