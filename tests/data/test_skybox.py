import dataclasses
import math

import pytest
import torch

import nexwarp as nw
from nexwarp.data import Scene, skybox
from nexwarp.data.skybox import directions, skybox_points
from nexwarp.train.initial import initial_surfels
from tests.reference.collect import rotations
from tests.trainer_support import small


def centre_of(scene: Scene) -> torch.Tensor:
    return torch.stack([view.camera.position for view in scene.train]).mean(0)


def farthest_camera(scene: Scene) -> torch.Tensor:
    return torch.stack([(view.camera.position - centre_of(scene)).norm() for view in scene.train]).max()


def few(scene: Scene) -> torch.Tensor:
    """A cloud that leaves gaps nearly everywhere."""
    return scene.points[::200]


def seen_places(scene: Scene, point: torch.Tensor) -> dict[int, tuple[float, float]]:
    """Column and row at which training views show a point, by their index and the definition of a pinhole."""
    found = {}
    for index, view in enumerate(scene.train):
        c = view.camera
        x, y, z = (c.viewmat[:3, :3].double() @ point.double() + c.viewmat[:3, 3].double()).tolist()
        if z > c.near:
            column, row = c.fx * x / z + c.cx, c.fy * y / z + c.cy
            if 0 <= column < c.width and 0 <= row < c.height:
                found[index] = (column, row)
    return found


def seen_pixels(scene: Scene, point: torch.Tensor) -> list[tuple[int, int, int]]:
    """View, row and column of the pixels at which training views show a point."""
    return [(index, int(row), int(column)) for index, (column, row) in seen_places(scene, point).items()]


def test_directions_are_even() -> None:
    found = directions(500)
    torch.testing.assert_close(found.norm(dim=1), torch.ones(500, dtype=torch.float64))
    nearest = torch.cdist(found, found).fill_diagonal_(9.0).min(dim=1).values
    spacing = math.sqrt(4 * math.pi / 500)
    assert nearest.min() > 0.7 * spacing and nearest.max() < 1.2 * spacing and found.mean(0).norm() < 0.01


def test_points_are_where_photos_show_the_sphere(scene: Scene) -> None:
    cloud = few(scene)
    points = skybox_points(scene.train, cloud, 200)
    centre = centre_of(scene)
    reach = (cloud - centre).norm(dim=1).sort().values[int(0.99 * (len(cloud) - 1))]
    radius = 2 * max(reach, farthest_camera(scene))
    assert 150 < len(points.means) <= 200
    torch.testing.assert_close((points.means - centre).norm(dim=1), radius.expand(len(points.means)), rtol=1e-5, atol=0)
    torch.testing.assert_close(points.normals, (centre - points.means) / radius, rtol=0, atol=1e-5)
    nearest = torch.cdist(points.means, points.means).fill_diagonal_(9e9).min(dim=1).values
    torch.testing.assert_close(2 * points.scales, nearest, rtol=0.3, atol=0)
    for point, color in list(zip(points.means, points.colors, strict=True))[::10]:
        places = seen_pixels(scene, point)
        pixels = [scene.train[view].image[row, column].double() / 255 for view, row, column in places]
        assert pixels, "no photo shows it"
        torch.testing.assert_close(color.double(), torch.stack(pixels).mean(0), rtol=0, atol=1e-6)


def test_none_is_where_photos_show_points(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the photos that show one of the sphere, more than half have no point of the cloud within 3 % there."""
    cloud = scene.points[:: len(scene.points) // 40]
    monkeypatch.setattr(skybox, "GAP", 0.0)
    every = skybox_points(scene.train, cloud, 200).means
    monkeypatch.undo()
    shown = [seen_places(scene, point) for point in cloud]
    gap = 0.03 * math.hypot(scene.train[0].camera.width, scene.train[0].camera.height)
    expected = []
    for point in every:
        places = seen_places(scene, point)
        near = [any(i in other and math.dist(other[i], place) < gap for other in shown) for i, place in places.items()]
        expected.append(2 * sum(near) < len(near))
    assert 20 < sum(expected) < len(every) - 20
    torch.testing.assert_close(skybox_points(scene.train, cloud, 200).means, every[torch.tensor(expected)])


def test_cameras_are_inside(scene: Scene) -> None:
    """With points near the cameras' mean alone, the cameras decide how large the sphere is."""
    centre = centre_of(scene)
    points = skybox_points(scene.train, centre + 1e-3 * torch.randn(50, 3), 100)
    expected = (2 * farthest_camera(scene)).expand(len(points.means))
    torch.testing.assert_close((points.means - centre).norm(dim=1), expected)


def test_masked_pixels_show_nothing(scene: Scene) -> None:
    def masked(row: int) -> list[nw.View]:
        views = []
        for view in scene.train:
            mask = torch.ones(view.image.shape[:2], dtype=torch.bool)
            mask[row:] = False
            views.append(dataclasses.replace(view, mask=mask))
        return views

    half = scene.train[0].camera.height // 2
    points = skybox_points(masked(half), few(scene), 100)
    assert 0 < len(points.means) <= 100
    assert all(any(row < half for _, row, _ in seen_pixels(scene, point)) for point in points.means)
    assert len(skybox_points(masked(0), few(scene), 100).means) == 0
    alone = scene.train[:1]
    assert len(skybox_points(alone, alone[0].camera.position[None], 100).means) == 0, "a sphere without extent"


@pytest.mark.parametrize(("skybox", "expected"), [(20, 20), (1000, 33)])
def test_some_initial_surfels_face_the_scene_a_sixth_at_most(scene: Scene, skybox: int, expected: int) -> None:
    config = small(max_surfels=400, skybox=skybox)
    configs = config, dataclasses.replace(config, skybox=0)
    surfels, without = (initial_surfels(scene, c, torch.Generator().manual_seed(0)) for c in configs)
    sky = skybox_points(scene.train, scene.points, expected)
    count = len(sky.means)
    assert 0 < count < expected, "some are near points of the cloud"
    assert len(surfels) == min(200, len(without) + count)
    torch.testing.assert_close(surfels.means[-count:], sky.means)
    torch.testing.assert_close(surfels.scales[-count:], sky.scales[:, None].expand(-1, 2))
    assert (rotations(surfels.quats)[-count:, :, 2] * sky.normals).sum(-1).abs().min() > 1 - 1e-4
    torch.testing.assert_close(surfels.means[:-count], without.means[: len(surfels) - count])
    behind = dataclasses.replace(scene, background=(1.0, 1.0, 1.0))
    transparent = initial_surfels(behind, config, torch.Generator().manual_seed(0))
    assert torch.equal(transparent.means, without.means), "behind transparent photos there is nothing"
