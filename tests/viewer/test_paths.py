import asyncio
import math

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.nerfstudio import load_camera_path
from nexwarp.run.folder import keep_camera_path
from nexwarp.viewer import session as session_module
from nexwarp.viewer import world as world_module
from nexwarp.viewer.pacing import SMALLEST, Pace, Share
from nexwarp.viewer.world import Viewpoint, World, camera_to_world, clearest, frustum_size, vertical_fov
from tests.viewer.support import Client, ring, serving, session_of


def test_the_share_of_time_is_kept_whatever_pictures_cost():
    generator = np.random.default_rng(0)
    for share in (0.05, 0.2, 0.5):
        budget, now, spent = Share(share), 0.0, 0.0
        while now < 500.0:
            if budget.due(now):
                cost = generator.uniform(0.01, 0.5)
                now, spent = now + cost, spent + cost
                budget.spend(now, cost)
            now += 0.03
        assert 0.5 * share < spent / now <= share + 0.01


def test_pictures_are_sized_to_come_in_time():
    pace = Pace()
    assert pace.scale("a", 1280, 800, 0.1) == 0.25
    pace.observe("a", 1000, 2.0)  # compiles
    pace.observe("a", 1000, 0.001)
    for limit in (0.03, 0.1, 0.5, 2.0):
        scale = pace.scale("a", 1280, 800, limit)
        assert pace.seconds("a", 1280 * 800 * scale**2) <= limit
        assert scale == 1.0 or pace.seconds("a", 1280 * 800 * scale**2 * 2) > limit
    assert min(1280, 800) * pace.scale("a", 1280, 800, 1e-9) == pytest.approx(SMALLEST)
    assert pace.bands("a", 1e6) == 5 and pace.bands("b", 1e6) == 1


def test_the_browsers_frame_there_and_back():
    cameras = list(ring()["train"].values())
    world = World.around(cameras, torch.zeros(0, 3))
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(world.to_scene(world.to_browser(points)), points, atol=1e-12)
    centres = world.to_browser(np.stack([camera_to_world(c)[:3, 3] for c in cameras]))
    assert np.linalg.norm(centres, axis=1).max() == pytest.approx(3.0)
    assert all(camera_to_world(c)[:3, 1] @ world.up < 0 for c in cameras), "image down is not up"
    lone = World.around(cameras[:1], torch.randn(50, 3))
    assert np.isfinite(lone.focus).all() and lone.unit > 0


def test_a_browsers_camera_is_the_scenes():
    camera = ring()["train"]["3.png"]
    world = World.around(list(ring()["train"].values()), torch.zeros(0, 3))
    pose = camera_to_world(camera)
    w = np.sqrt(1 + np.trace(pose[:3, :3])) / 2
    v = np.array([pose[2, 1] - pose[1, 2], pose[0, 2] - pose[2, 0], pose[1, 0] - pose[0, 1]]) / (4 * w)
    here = Viewpoint.of((w, *v), world.to_browser(pose[:3, 3]), vertical_fov(camera), 64, 48, world)
    (back,) = here.bands(1.0, camera.near, torch.zeros(1))
    torch.testing.assert_close(back.viewmat, camera.viewmat, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.K, camera.K, atol=1e-4, rtol=0)


def test_a_path_is_played_and_kept_as_its_views_say(model, tmp_path, monkeypatch) -> None:
    """Views are added and removed; what the run keeps passes through them; their number is bounded."""
    monkeypatch.setattr(session_module, "MOST_VIEWS", 3)
    with serving(model, save_path=lambda path: keep_camera_path(tmp_path, path)) as viewer, Client(viewer) as client:
        client.look()
        session = session_of(viewer)
        editor = session.path
        editor.keep()
        assert "not saved" in editor.note.content
        for name in [*session.cameras, "train/0.png"]:
            session.viewpoint = Viewpoint.of_camera(session.cameras[name])
            editor.add()
        editor._set_views(editor.views[:-1])
        assert len(editor.views) == 2
        editor.keep()
        kept = load_camera_path(tmp_path / "camera_path_1.json")
        assert f"--path {tmp_path / 'camera_path_1.json'}" in editor.note.content
        assert len(kept.cameras) == 180 and kept.fps == 30
        for camera, name in ((kept.cameras[0], "train/0.png"), (kept.cameras[-1], "train/1.png")):
            expected = session.cameras[name]
            torch.testing.assert_close(camera.viewmat, expected.viewmat, atol=1e-4, rtol=0)
            torch.testing.assert_close(camera.K, expected.K, atol=1e-3, rtol=0)
        editor.seconds.value = 0.1  # type: ignore[misc]
        asyncio.run(editor.play())
        last = viewer.world.to_scene(np.asarray(session.client.camera.position))
        np.testing.assert_allclose(last, camera_to_world(session.cameras["train/1.png"])[:3, 3], atol=1e-4)


def test_a_sphere_is_drawn_and_its_command_shown(model) -> None:
    commands: list[tuple[np.ndarray, float]] = []

    def command(centre: np.ndarray, radius: float) -> str:
        commands.append((centre, radius))
        return "crop it"

    with serving(model, crop_command=command) as viewer, Client(viewer) as client:
        client.look()
        session = session_of(viewer)
        editor, unit = session.crop, viewer.world.unit
        np.testing.assert_allclose(commands[-1][0], viewer.world.focus, atol=1e-6)
        assert not editor.ball.visible and editor.note.content == "`crop it`"
        editor.shown.value = True  # type: ignore[misc]
        editor.radius.value = 2.0  # type: ignore[misc]
        editor.centre.value = (1.0, math.nan, 1e9)  # type: ignore[misc]
        editor.update()
        assert editor.ball.visible and editor.ball.scale == 2.0
        np.testing.assert_allclose(editor.ball.position, (1.0, -100.0, 100.0))
        np.testing.assert_allclose(commands[-1][0], viewer.world.to_scene(np.array([1.0, -100.0, 100.0])))
        assert commands[-1][1] == pytest.approx(2.0 * unit)


# The first view: a camera that few frustums stand in front of, and frustums that stay apart

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
    assert frustum_size(places) == pytest.approx(min(0.4 * spacing, world_module.LARGEST_FRUSTUM))
    assert frustum_size(np.zeros((9, 3))) == world_module.SMALLEST_FRUSTUM
    assert frustum_size(np.zeros((1, 3))) == world_module.LARGEST_FRUSTUM
