import dataclasses
import math

import pytest
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.data import initial_points
from nexwarp.train.initial import initial_surfels, quats_towards, texture_shape
from nexwarp.train.recipe import TextureConfig, preset
from tests.reference.collect import rotations
from tests.trainer_support import TEXTURE, small


def test_finest_cells_are_the_pixels_of_nearly_all_views(scene):
    """Against the definition, point by point: the 95th percentile of f / t over what the views see."""
    densities = []
    for view in scene.train:
        c = view.camera
        for point in scene.points.double():
            x, y, t = (c.viewmat[:3, :3].double() @ point + c.viewmat[:3, 3].double()).tolist()
            inside = 0 <= c.fx * x / t + c.cx < c.width and 0 <= c.fy * y / t + c.cy < c.height
            if t > c.near and inside:
                densities.append(math.sqrt(c.fx * c.fy) / t)
    shape = texture_shape(scene, small())
    expected = torch.tensor(densities).double().quantile(0.95).item()
    assert shape["max_resolution"] == pytest.approx(expected, rel=1e-3)
    assert shape["min_resolution"] == pytest.approx(min(64 / scene.scale, expected / 4), rel=1e-3)


@pytest.mark.parametrize(
    ("pixels", "photos", "power"),
    [(21e6, 44, 16), (33e7, 44, 20), (1e3, 1, 12), (1e12, 44, 20), (21e6, 45, 18), (82e6, 45, 19), (33e7, 45, 20)],
)
def test_the_table_is_as_large_as_the_photos_can_fill(scene, pixels, photos, power):
    """A tenth of a number a pixel, 32 an entry, at most the paper's size; of 45 photos four times, up to half of it."""
    scene = dataclasses.replace(scene, train=[scene.train[0]] * photos)
    each = int(pixels) // photos
    camera = Camera(torch.eye(4), torch.eye(3), 1000, each // 1000) if each >= 1000 else scene.train[0].camera
    sized = dataclasses.replace(scene, train=[dataclasses.replace(view, camera=camera) for view in scene.train])
    shape = texture_shape(sized, small(texture=TextureConfig(max_resolution=64.0)))
    assert shape["table_size"] == 2**power and texture_shape(sized, small())["table_size"] == TEXTURE.table_size


@pytest.mark.parametrize("case", ["random", "aligned", "opposite", "square"])
def test_surfels_turn_to_their_normals_by_the_least_angle(case):
    quats, random = torch.randn(200, 4), torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    axes = rotations(quats)[:, :, 2]
    square = torch.nn.functional.normalize(torch.linalg.cross(axes, random), dim=-1)
    normals = {"random": random, "aligned": axes, "opposite": -axes, "square": square}[case]
    turned = quats_towards(normals, quats)
    torch.testing.assert_close(turned.norm(dim=-1), torch.ones(len(turned)), rtol=0, atol=1e-5)
    z = rotations(turned)[:, :, 2]
    torch.testing.assert_close((z * normals).sum(-1).abs(), torch.ones(len(z)), rtol=0, atol=1e-5)
    # The rotation between both has the angle that the axis had from the nearer of +-normal.
    unit = torch.nn.functional.normalize(quats, dim=-1).double()
    half = (unit * turned.double()).sum(-1).abs()
    between = (rotations(unit)[:, :, 2] * normals.double()).sum(-1).abs()
    torch.testing.assert_close(2 * half.square() - 1, between, rtol=0, atol=1e-5)


@pytest.mark.parametrize("orient", [True, False])
@pytest.mark.parametrize("budget", [16, 101, 100_000])
def test_initial_surfels(scene, budget, orient):
    """Half the budget at most, opacity 0.1, gamma 1 + e^-5, colours of the points, on fitted planes or at random."""
    config = small(max_surfels=budget, orient_points=orient, skybox=0)
    surfels = initial_surfels(scene, config, torch.Generator().manual_seed(0))
    points = initial_points(
        scene.points, scene.colors, budget // 2, track_lengths=scene.track_lengths, errors=scene.reprojection_errors
    )
    count = len(surfels)
    assert count == len(points.means) and count <= budget // 2 and torch.equal(surfels.means, points.means)
    full = torch.full
    torch.testing.assert_close(surfels.opacities, full((count,), 0.1))
    torch.testing.assert_close(surfels.gammas, full((count, 2), 1 + math.exp(-5)))
    torch.testing.assert_close(surfels.scales, points.scales[:, None].expand(-1, 2))
    torch.testing.assert_close(0.5 + 0.28209479177387814 * surfels.sh[:, 0], points.colors)
    assert not surfels.sh[:, 1:].any() and surfels.sh.shape == (count, 16, 3)
    assert bool(((rotations(surfels.quats)[:, :, 2] * points.normals).sum(-1).abs() > 1 - 1e-4).all()) == orient


def test_paper_takes_all_points(scene):
    """No filter and no planes: the preset's surfels may sit on points that the default leaves out."""
    config = dataclasses.replace(preset("paper"), max_surfels=100_000)
    surfels = initial_surfels(scene, config, torch.Generator().manual_seed(0))
    assert len(surfels) == len(scene.points.unique(dim=0))
    default = initial_surfels(scene, dataclasses.replace(config, filter_points=True), torch.Generator().manual_seed(0))
    assert len(default) < len(surfels)
