import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree

from nexwarp.data import load_scene
from nexwarp.data.random_points import random_points
from tests.data.test_scene import make_scene, views_of
from tests.scene_writers import write_blender


@pytest.fixture
def transparent(tmp_path):
    """A Blender scene of a disc: red, half transparent at its rim, nothing around it."""
    path = make_scene(tmp_path / "colmap", params=(40.0, 40.0, 24.0, 18.0), points=np.zeros((1, 3)))
    y, x = np.mgrid[:36, :48]
    radius = np.hypot(x + 0.5 - 24, y + 0.5 - 18)
    alpha = np.where(radius < 8, 255, np.where(radius < 12, 100, 0)).astype(np.uint8)
    rgba = np.zeros((36, 48, 4), np.uint8)
    rgba[..., 0], rgba[..., 1], rgba[..., 3] = 200, 30, alpha
    for file in (path / "images").iterdir():
        Image.fromarray(rgba).save(file)
    return write_blender(path, tmp_path / "blender", centred=True, points=False), rgba


@pytest.mark.parametrize(("given", "color"), [(None, (1, 1, 1)), ("black", (0, 0, 0)), ((0.2, 0.4, 0.6),) * 2])
def test_transparent_photos_lie_on_the_background(transparent, given, color):
    path, rgba = transparent
    scene = load_scene(path, background=given)
    a = rgba[..., 3:].astype(float) / 255
    expected = a * rgba[..., :3] + (1 - a) * 255 * np.array(color)
    assert scene.background == tuple(map(float, color))
    for view in views_of(scene):
        assert np.abs(view.image.numpy() - expected).max() <= 0.5 + 1e-3
        assert np.array_equal(view.alpha.numpy(), rgba[..., 3]) and view.mask is None


def test_random_backgrounds_are_for_training_alone(transparent):
    path, _ = transparent
    white, random = load_scene(path), load_scene(path, background="random")
    assert random.random_background and not white.random_background
    assert random.background == white.background and torch.equal(random.train[0].image, white.train[0].image)


def test_alpha_as_mask(transparent):
    path, rgba = transparent
    scene = load_scene(path, masks="alpha", downscale=2)
    blocks = (rgba[..., 3] >= 128).reshape(18, 2, 24, 2).all(axis=(1, 3))
    for view in views_of(scene):
        assert np.array_equal(view.mask.numpy(), blocks)
        assert view.alpha.shape == (18, 24) and view.image.shape == (18, 24, 3)


def test_other_scenes_drop_alpha_unless_asked(transparent, tmp_path):
    path = tmp_path / "colmap"
    _, rgba = transparent
    scene = load_scene(path)
    assert scene.background is None and scene.train[0].alpha is None
    assert np.array_equal(scene.train[0].image.numpy(), rgba[..., :3])
    scene = load_scene(path, background="white")
    alpha = scene.train[0].alpha
    assert scene.background == (1.0, 1.0, 1.0) and alpha is not None and np.array_equal(alpha.numpy(), rgba[..., 3])
    assert scene.train[0].image[0, 0].tolist() == [255, 255, 255]


def test_random_points_lie_where_the_cameras_look(demo, tmp_path, transparent):
    scene = load_scene(write_blender(demo, tmp_path / "opaque", points=False))
    assert len(scene.points) == 4000 and torch.equal(scene.points, load_scene(tmp_path / "opaque").points)
    seen = torch.zeros(len(scene.points))
    for view in scene.train:
        pixels, depth = view.camera.project(scene.points)
        seen += (depth > 0) & (pixels > -0.1).all(dim=1) & (pixels < torch.tensor([96.1, 72.1])).all(dim=1)
    assert seen.min() >= 2
    # The room's points, which the demo has, are among them: some lie near nearly each.
    gaps, _ = cKDTree(scene.points.numpy()).query(load_scene(demo).points.numpy())
    assert np.quantile(gaps, 0.9) < 0.15 * scene.scale
    path, _ = transparent
    hull = load_scene(path)
    for view in hull.train:  # the disc's rim is 12 pixels from the image's centre
        pixels, depth = view.camera.project(hull.points)
        inside = (depth > 0.1) & (pixels > 0).all(dim=1) & (pixels < torch.tensor([48.0, 36.0])).all(dim=1)
        assert (pixels[inside] - torch.tensor([24.0, 18.0])).norm(dim=1).max() < 13 and inside.any()
    assert hull.colors[:, 0].float().min() >= 200 and len(hull.points) > 100


def test_random_points_of_parallel_and_of_blind_cameras(transparent):
    path, _ = transparent
    views = load_scene(path).train
    forward = [type(v)(v.camera, v.image, None, v.name, None) for v in views[:1]] * 3
    cloud = random_points(forward, 2.0, count=500)
    depth = cloud.positions @ views[0].camera.viewmat[2, :3].double().numpy() + views[0].camera.viewmat[2, 3].item()
    assert len(cloud.positions) == 500 and depth.min() >= 1.99 and depth.max() <= 60.1
    blind = [type(v)(v.camera, v.image, None, v.name, torch.zeros(36, 48, dtype=torch.uint8)) for v in views]
    assert len(random_points(blind, 2.0, count=50).positions) == 50
