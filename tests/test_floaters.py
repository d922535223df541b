"""What counts as a floater, and what does not."""

import math

import pytest
import torch

import nexwarp as nw
from nexwarp.cameras import between as ways
from nexwarp.data import View
from nexwarp.train import floaters as module
from nexwarp.train.floaters import floaters, nearest_depth


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


def facing(
    squares: list[tuple[tuple[float, float, float], float]], device: torch.device, max_hits: int = 2
) -> nw.Model:
    count = len(squares)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    means = torch.tensor([place for place, _ in squares])
    scales = torch.tensor([[size, size] for _, size in squares])
    surfels = nw.Surfels.from_activated(
        means, quats, scales, torch.full((count,), 0.95), torch.full((count, 2), 1.5), torch.zeros(count, 1, 3)
    )
    return nw.Model(surfels.to(device), None, options=nw.RenderOptions(max_hits=max_hits))


@pytest.fixture(autouse=True)
def between(monkeypatch: pytest.MonkeyPatch) -> list[nw.Camera]:
    """What `nexwarp.cameras.between.between` returns in the test; the cameras themselves when empty."""
    cameras: list[nw.Camera] = []
    monkeypatch.setattr(module, "between", lambda given, *_: cameras or given)
    return cameras


def found(model: nw.Model, cameras: list[nw.Camera], nearest: list[float]) -> list[bool]:
    return floaters(model, cameras, nearest, torch.Generator()).tolist()


@pytest.mark.parametrize("max_hits", [0, 1, 2])
def test_floaters_are_large_and_much_nearer_than_the_nearest_points(max_hits: int, device: torch.device) -> None:
    """From z = -1, at depths of 1, 0.9 and 1.5, which are 0.6 of 1.67, 1.5 and 2.5."""
    model = facing([NEAR, SMALL, BEHIND], device, max_hits)
    ahead = [looking_ahead(-1.0)]
    assert found(model, ahead, [1.68]) == [True, False, False]
    assert found(model, ahead, [1.65]) == [False, False, False]
    assert found(model, ahead, [2.55]) == [True, False, True]
    assert found(model, ahead, [0.0]) == [False, False, False]


def test_the_last_ones_cover_three_thousandths_of_a_picture(device: torch.device) -> None:
    """Two, four and far more, of 3,072 pixels at 80 a unit."""
    two, four = (((0.2 * side, 0.1, -0.01), size) for side, size in ((-1, 0.014), (1, 0.02)))
    model, ahead = facing([two, four, NEAR], device), [looking_ahead(-1.0)]
    shares = module._shares(model.bare(), ahead[0], 2.0).tolist()
    assert 1e-3 < shares[0] < 2.5e-3 and 3.5e-3 < shares[1] < 6e-3 and shares[2] > 0.2
    for last, expected in ((False, [True, True, True]), (True, [False, True, True])):
        assert floaters(model, ahead, [2.0], torch.Generator(), last=last).tolist() == expected


def test_a_view_between_may_be_nearer_by_the_way_to_it(device: torch.device, between: list[nw.Camera]) -> None:
    """From z = -1, 2 ahead of the training camera: depths of 1 and 1.5 are 0.6 of 3.67 and 4.5, less those 2."""
    model = facing([NEAR, BEHIND], device)
    between.append(looking_ahead(-1.0))
    for nearest, expected in ((3.6, [False, False]), (3.7, [True, False]), (4.6, [True, True])):
        assert found(model, [looking_ahead(-3.0)], [nearest]) == expected


def test_any_view_tells_by_its_own_points(device: torch.device) -> None:
    """From z = -3, -1 and -3.5: the nearer square is at 3, 1 and 3.5."""
    model = facing([NEAR, BEHIND], device)
    cameras = [looking_ahead(-3.0), looking_ahead(-1.0), looking_ahead(-3.5)]
    assert found(model, cameras, [0.5, 1.7, 0.5]) == [True, False]
    assert found(model, cameras, [1.7, 0.5, 1.7]) == [False, False]
    assert found(model, cameras, [0.5, 0.5, 7.0]) == [True, True]


@pytest.mark.parametrize("height", [12, 48, 240])
def test_the_size_of_the_pictures_does_not_matter(height: int) -> None:
    factor = height / 48
    K = torch.tensor([[80.0 * factor, 0, 32 * factor], [0, 80.0 * factor, 24 * factor], [0, 0, 1]])
    cameras = [nw.Camera(looking_ahead(-1.0).viewmat, K, round(64 * factor), height, 0.01)]
    assert found(facing([NEAR, SMALL, BEHIND], torch.device("cpu")), cameras, [1.8]) == [True, False, False]


def test_sixty_views_between_are_looked_at_or_one_for_each_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last time it is 240."""
    looks = []

    def look(cameras: list[nw.Camera], *_: object) -> list[nw.Camera]:
        looks.append(len(cameras))
        return cameras

    monkeypatch.setattr(module, "between", look)
    for count in (1, 40, 130):
        looks.clear()
        found(facing([NEAR], torch.device("cpu")), [looking_ahead(-9.0)] * count, [1.0] * count)
        assert looks == [count] * {1: 60, 40: 2, 130: 1}[count]
        looks.clear()
        cameras = [looking_ahead(-9.0)] * count
        floaters(facing([NEAR], torch.device("cpu")), cameras, [1.0] * count, torch.Generator(), last=True)
        assert looks == [count] * {1: 240, 40: 6, 130: 2}[count]


def test_a_wall_as_far_as_the_nearest_points_is_none(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the way between cameras, which look along z from z = -0.3 to 0.3; the wall is at z = 2.4."""
    monkeypatch.setattr(module, "between", ways.between)
    monkeypatch.setattr(module, "NEARER", 0.999)
    ring = []
    for i in range(8):
        angle = 2 * math.pi * i / 8
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([math.cos(angle), math.sin(angle), 0.3 * math.sin(3 * angle)])
        ring.append(nw.Camera(viewmat, looking_ahead(0.0).K, 64, 48, 0.01))
    wall = [((x / 2, y / 2, 2.4), 0.4) for x in range(-6, 7) for y in range(-6, 7)]
    model = facing(wall, device)
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        nearest = [2.4 - camera.position[2].item() for camera in ring]
        assert not floaters(model, ring, nearest, generator).any()
        assert floaters(model, ring, [1.1 * x for x in nearest], generator).any()


def test_nearest_depth_by_hand() -> None:
    """The least; of 250 points the two nearest may be wrong; 19 are too few, and none is out of sight."""

    def view(own: torch.Tensor | None) -> View:
        return View(looking_ahead(0.0), torch.zeros(48, 64, 3, dtype=torch.uint8), None, "one", points=own)

    def depth_of(depths: torch.Tensor, aside: float = 0.0) -> float:
        pixels = torch.stack([torch.arange(len(depths)) % 16 * 4 + 2.0, torch.arange(len(depths)) // 16 * 3 + 1.5], 1)
        rays = (pixels - torch.tensor([32.0, 24.0])) / 80 + torch.tensor([aside, 0.0])
        points = torch.cat([rays, torch.ones(len(depths), 1)], 1) * depths[:, None]
        for own in (None, points[:0]):
            assert nearest_depth(view(own), points) == 0.0
        return nearest_depth(view(points[-1:]), points)

    assert depth_of(torch.arange(30.0) + 4) == pytest.approx(4.0)
    depths = torch.arange(250.0) + 6
    depths[:2] = 0.02
    assert depth_of(depths[torch.randperm(250)]) == pytest.approx(8.0)
    assert depth_of(torch.ones(19)) == 0.0 and depth_of(torch.ones(20)) == pytest.approx(1.0)
    assert depth_of(torch.ones(20), aside=3.0) == 0.0
