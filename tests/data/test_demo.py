"""The demo scene: the ray tracer against closed forms, and the photos and points against each other."""

from pathlib import Path

import numpy as np
import pytest
import torch

from nexwarp.data import demo as demo_module
from nexwarp.data import demo_folder, initial_points, load_scene, write_demo
from nexwarp.data.demo import demo_cameras
from nexwarp.data.demo_room import LAMP, build_room
from nexwarp.data.raytrace import Rectangle, first_hits, render, sample_texture, visible

SIZE = {"width": 96, "height": 72, "views": 24, "points": 1500}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_demo(tmp_path_factory.mktemp("demo") / "demo", **SIZE)


@pytest.fixture(scope="module")
def scene(folder):
    return load_scene(folder)


def square(color: float, depth: float = 2.0, side: float = 1.0) -> Rectangle:
    """A flat square that faces a camera at the origin, which looks along z; texture upright."""
    origin = np.array([-side / 2, -side / 2, depth])
    texture = np.full((2, 2, 3), color, np.float32)
    return Rectangle(origin, np.array([side, 0.0, 0.0]), np.array([0.0, side, 0.0]), texture)


def pinhole(focal: float, width: int, height: int) -> np.ndarray:
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def bilinear(image: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """(P, 3) image values in [0, 255] at pixel coordinates (P, 2), pixel centres at +0.5."""
    values = sample_texture(
        image.numpy().astype(np.float32),
        pixels[:, 0].numpy() / image.shape[1],
        pixels[:, 1].numpy() / image.shape[0],
    )
    return torch.from_numpy(values)


def project(camera, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixel coordinates (P, 2), and which points lie inside the image and ahead."""
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = local @ camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    inside = (pixels > 1).all(dim=1) & (pixels[:, 0] < camera.width - 1) & (pixels[:, 1] < camera.height - 1)
    return pixels, inside & (local[:, 2] > camera.near)


def test_pixels_average_their_area():
    """A white square of 5.5 x 5.5 pixels: borders are covered by 3/4, corners by 9/16."""
    image = render([square(1.0, 2.0, 1.1)], np.eye(4), pinhole(10.0, 12, 12), (12, 12), LAMP, samples=8)
    pixels = image[..., 0] / 255.0
    assert pixels.sum() == pytest.approx(5.5**2, rel=0.01)
    # The square covers 3.25 to 8.75 of 12 in both directions.
    cover = np.array([0, 0, 0, 0.75, 1, 1, 1, 1, 0.75, 0, 0, 0])
    np.testing.assert_allclose(pixels, np.outer(cover, cover), atol=0.01)


def test_nearest_rectangle_wins_and_backs_are_invisible():
    near, far = square(0.25, 1.0), square(0.75, 2.0, 4.0)
    rays = np.array([[0.0, 0.0, 1.0], [0.8, 0.0, 1.0], [0.0, 0.0, -1.0]])
    for order, expected in (((near, far), [0, 1, -1]), ((far, near), [1, 0, -1])):
        hits = first_hits(order, np.zeros(3), rays)
        assert hits.ids.tolist() == expected
    np.testing.assert_allclose(1.0 / hits.nearness[:2], [1.0, 2.0])
    assert first_hits([near], np.array([0.0, 0.0, 5.0]), np.array([[0.0, 0.0, -1.0]])).ids.tolist() == [-1]


def test_visibility_is_blocked_only_between():
    blocker = square(0.5, 1.0)
    points = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 0.5], [3.0, 0.0, 2.0], [0.1, 0.2, 1.0]])
    assert visible([blocker], np.zeros(3), points).tolist() == [False, True, True, True]


def test_texture_is_not_mirrored_and_keeps_its_mean():
    texture = np.random.default_rng(0).random((8, 8, 3)).astype(np.float32)
    plane = Rectangle(np.array([-1.0, -1.0, 2.0]), np.array([2.0, 0, 0]), np.array([0, 2.0, 0]), texture)
    image = render([plane], np.eye(4), pinhole(8.0, 8, 8), (8, 8), LAMP, samples=16)
    # Texels coincide with pixels, and the mean of a bilinear patch is 1/8, 3/4, 1/8 along each axis.
    kernel = np.eye(8) * 0.75 + np.eye(8, k=1) * 0.125 + np.eye(8, k=-1) * 0.125
    kernel[0, 0] = kernel[7, 7] = 0.875
    expected = np.einsum("ij,jkc,lk->ilc", kernel, texture, kernel)
    np.testing.assert_allclose(image / 255.0, expected, atol=0.004)


def test_photos_have_no_holes_and_no_blank_frames(scene):
    rig = demo_cameras(SIZE["width"], SIZE["height"], SIZE["views"])
    room = build_room(SIZE["width"])
    rays = np.random.default_rng(0).standard_normal((2000, 3))
    for centre in rig.centres[::5]:
        assert (first_hits(room, centre, rays).ids >= 0).all()
    for view in scene.train + scene.test:
        assert view.image.double().std() > 25.0


def test_cameras_are_general_and_come_back_as_written(scene):
    rig = demo_cameras(SIZE["width"], SIZE["height"], SIZE["views"])
    camera = scene.train[0].camera
    assert camera.fx != camera.fy and camera.cx != camera.width / 2 and camera.cy != camera.height / 2
    np.testing.assert_allclose(camera.K.numpy(), rig.K, rtol=1e-6)
    assert len(scene.train) == 21 and len(scene.test) == 3
    written = {view.name: view.camera.viewmat.numpy() for view in scene.train + scene.test}
    for index, viewmat in enumerate(rig.viewmats):
        np.testing.assert_allclose(written[f"view_{index:03d}.png"], viewmat, atol=1e-6)


def test_two_views_of_a_surface_agree(scene):
    """Light is baked, so a surface point has one colour, up to what a pixel averages and the glossy crate."""
    rig, room = demo_cameras(SIZE["width"], SIZE["height"], SIZE["views"]), build_room(SIZE["width"])
    rng = np.random.default_rng(1)
    views = {view.name: view for view in scene.train + scene.test}
    errors, shuffled = [], []
    for first, second in ((0, 1), (4, 16), (9, 21)):
        one, other = views[f"view_{first:03d}.png"], views[f"view_{second:03d}.png"]
        pixels = rng.uniform(2, (94, 70), (2000, 2))
        local = np.concatenate([(pixels - rig.K[:2, 2]) / rig.K[[0, 1], [0, 1]], np.ones((2000, 1))], axis=1)
        start = rig.centres[first]
        hits = first_hits(room, start, local @ rig.viewmats[first, :3, :3])
        points = start + (local @ rig.viewmats[first, :3, :3]) / hits.nearness[:, None]
        projected, inside = project(other.camera, torch.from_numpy(points).float())
        seen = inside.numpy() & visible(room, rig.centres[second], points)
        assert seen.sum() > 300
        here = bilinear(one.image, torch.from_numpy(pixels[seen]))
        there = bilinear(other.image, projected[torch.from_numpy(seen)])
        errors.append((here - there).abs().mean(dim=1))
        shuffled.append((here - there.roll(1, dims=0)).abs().mean(dim=1))
    assert torch.cat(errors).median() < 12.0
    assert torch.cat(errors).median() < 0.3 * torch.cat(shuffled).median()


def test_points_reproject_onto_their_colors(scene):
    errors = []
    for view in scene.train:
        pixels, inside = project(view.camera, scene.points)
        found = bilinear(view.image, pixels[inside])
        error = torch.full((len(scene.points),), float("nan"))
        error[inside] = (found - scene.colors[inside].float()).abs().mean(dim=1)
        errors.append(error)
    # A point is seen by a few of the views that have it in frame; in the best three of them it must match.
    best = torch.stack(errors).nan_to_num(nan=255.0).sort(dim=0).values[:3].amax(dim=0)
    assert best.median() < 12.0 and best.quantile(0.8) < 30.0


def test_points_are_honest(scene):
    """On a surface but for the noise, a few gross outliers, and errors and tracks that say so."""
    room = build_room(SIZE["width"])
    distance = np.full(len(scene.points), np.inf)
    for rectangle in room:
        local = scene.points.numpy() - rectangle.origin
        a, b = (np.clip(local @ edge / (edge @ edge), 0.0, 1.0) for edge in (rectangle.u, rectangle.v))
        distance = np.minimum(distance, np.linalg.norm(scene.points.numpy() - rectangle.at(a, b), axis=1))
    assert 1200 <= len(scene.points) <= SIZE["points"]
    # |normal noise| has its median at 0.674 sigma; near edges another face may be the nearest.
    assert np.median(distance) == pytest.approx(0.674 * 0.005 * 3.0, rel=0.25)
    gross = distance > 0.1
    assert 0.005 < gross.mean() < 0.06
    tracks, errors = scene.track_lengths.numpy(), scene.reprojection_errors.numpy()
    assert tracks.min() == 2 and 0.002 < (tracks == 2).mean() < 0.03 and np.median(errors) < 1.5
    kept = initial_points(
        scene.points,
        scene.colors,
        10_000,
        track_lengths=scene.track_lengths,
        errors=scene.reprojection_errors,
    )
    planted = {tuple(point) for point in scene.points.numpy()[gross].tolist()}
    left = sum(tuple(point) in planted for point in kept.means.tolist())
    assert left < 0.35 * gross.sum() and len(kept.means) > 0.9 * (~gross).sum()


def test_written_twice_is_the_same_to_the_byte(tmp_path, folder):
    again = write_demo(tmp_path / "again", **SIZE)
    files = sorted(file.relative_to(folder) for file in folder.rglob("*") if file.is_file())
    assert files == sorted(file.relative_to(again) for file in again.rglob("*") if file.is_file())
    assert len(files) == SIZE["views"] + 5
    for file in files:
        assert (folder / file).read_bytes() == (again / file).read_bytes(), file
    assert [entry.name for entry in tmp_path.iterdir()] == ["again"]


def test_a_crash_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(demo_module, "render", lambda *_, **__: np.zeros((24, 32, 3), np.uint8))
    monkeypatch.setattr(demo_module, "_write_model", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_demo(tmp_path / "demo", width=32, height=24, views=4, points=10)
    assert list(tmp_path.iterdir()) == []


def test_demo_folder_is_made_once_where_the_user_says(tmp_path, monkeypatch):
    calls = []

    def write(folder):
        calls.append(folder)
        folder.mkdir(parents=True)

    monkeypatch.setattr(demo_module, "write_demo", write)
    monkeypatch.setenv("NEXWARP_CACHE", str(tmp_path / "one"))
    assert demo_folder() == demo_folder() == calls[0] and calls[0].parent == tmp_path / "one" and len(calls) == 1
    monkeypatch.delenv("NEXWARP_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "two"))
    assert demo_folder().parent == tmp_path / "two" / "nexwarp"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "three")
    assert demo_folder().parent == tmp_path / "three" / ".cache" / "nexwarp" and len(calls) == 3


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(FileExistsError, match="exists already, expected none or an empty one"):
        write_demo(tmp_path, **SIZE)
    with pytest.raises(ValueError, match="views: expected at least 4, got 3"):
        write_demo(tmp_path / "new", views=3)
