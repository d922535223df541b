import json

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.camera import Camera
from nexwarp.cameras.nerfstudio import load_camera_path
from nexwarp.cli import main as cli
from nexwarp.data import load_scene
from tests.cli.support import FLAGS
from tests.data.inputs import room
from tests.data.test_scene import views_of
from tests.scene_writers import write_points

OFFSET = (500_000.0, 4_600_000.0, 120.0)
UTM = np.array(OFFSET)
ANNOUNCED = "ignore:.*cameras and points are relative to:UserWarning"
SHIFTED = np.concatenate([np.eye(3), -UTM[:, None]], axis=1)  # the applied_transform of a local file
TURNED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]) @ np.vstack([SHIFTED, [0, 0, 0, 1]])


def colmap(path, names):
    return room.write_colmap(path, names, offset=OFFSET)


def world_transforms(path, names):
    data = room.transforms([f"images/{name}" for name in names])
    for frame in data["frames"]:
        for row, offset in zip(frame["transform_matrix"], UTM, strict=False):
            row[3] += offset
    return room.write_transforms(path, data)


def applied(matrix):
    """Write a file whose frame is local, while the world that applied_transform leads back to is not."""

    def write(path, names):
        world = np.vstack([matrix, [0, 0, 0, 1]]) @ np.vstack([np.c_[np.eye(3), UTM], [0, 0, 0, 1]])
        data = room.transforms([f"images/{name}" for name in names], world[:3])
        points = room.wall_points(300) @ world[:3, :3].T + world[:3, 3]
        write_points(path / "points.ply", points, np.round(room.paint(room.wall_points(300))))
        return room.write_transforms(path, data | {"applied_transform": matrix.tolist(), "ply_file_path": "points.ply"})

    return write


def command(*arguments: object) -> None:
    assert cli.main([*map(str, arguments)]) == 0


def world_viewmats() -> list[torch.Tensor]:
    viewmats = [torch.from_numpy(viewmat) for viewmat in room.poses()]
    for viewmat in viewmats:
        viewmat[:3, 3] -= viewmat[:3, :3] @ torch.from_numpy(UTM)
    return viewmats


def point_error(scene, world: np.ndarray) -> float:
    """Largest distance of the scene's points from those of the room, in its world."""
    return float(np.abs(scene.points.double().numpy() + scene.origin.numpy() - world).max())


@pytest.mark.filterwarnings(ANNOUNCED)
@pytest.mark.parametrize("write", [colmap, world_transforms, applied(SHIFTED), applied(TURNED)])
def test_photos_and_points_keep_their_pixels(tmp_path, write):
    scene = load_scene(write(tmp_path, room.write_photos(tmp_path / "images")))
    assert scene.origin.dtype == torch.float64 and (scene.origin.numpy() != 0).all()
    assert all(view.camera.origin == tuple(scene.origin.tolist()) for view in views_of(scene))
    assert room.color_error(scene, scene.origin.numpy() - UTM) < room.RIGHT
    if write is not world_transforms:
        assert point_error(scene, room.wall_points(300) + UTM) < 1e-5
    write_points(tmp_path / "other.ply", room.wall_points(50, seed=7) + UTM, np.zeros((50, 3)))
    assert point_error(load_scene(tmp_path, points=str(tmp_path / "other.ply")), room.wall_points(50, 7) + UTM) < 1e-5


def test_a_frame_of_its_own_is_announced_and_changes_nothing_else(tmp_path):
    """The local scene has no offset; the same at UTM coordinates has the same cameras, scale and depths."""
    names = room.write_photos(tmp_path / "images")
    local = load_scene(room.write_colmap(tmp_path, names))
    assert not local.origin.any()
    (tmp_path / "utm").mkdir()
    (tmp_path / "images").rename(tmp_path / "utm" / "images")
    with pytest.warns(UserWarning, match=r"cameras and points are relative to \(5000\d\d.*, the scene's `origin`"):
        utm = load_scene(colmap(tmp_path / "utm", names))
    assert utm.scale == pytest.approx(local.scale, rel=1e-6)
    shift = utm.origin - torch.from_numpy(UTM)
    for one, other in zip(views_of(local), views_of(utm), strict=True):
        torch.testing.assert_close(one.camera.position.double(), other.camera.position.double() + shift)


def test_tensors_in_float64_get_a_frame_and_those_in_float32_a_warning(tmp_path):
    photos = room.photos()
    K = np.array([[40.0, 0, 31], [0, 41, 24.5], [0, 0, 1]])
    cameras = [Camera(viewmat, torch.from_numpy(K), room.WIDTH, room.HEIGHT) for viewmat in world_viewmats()]
    points = room.wall_points(100) + UTM
    scene = nw.Scene.from_tensors(photos, cameras, points, np.zeros((100, 3), np.uint8))
    assert room.color_error(scene, scene.origin.numpy() - UTM) < room.RIGHT and point_error(scene, points) < 1e-5
    again = nw.Scene.from_tensors(photos, [v.camera for v in sorted(views_of(scene), key=lambda v: v.name)])
    assert torch.equal(again.origin, scene.origin)
    with pytest.warns(UserWarning, match="cameras: float32 rounds viewmats at .*; expected float64 there"):
        nw.Scene.from_tensors(photos, [camera.to(torch.float32) for camera in cameras])


@pytest.mark.filterwarnings(ANNOUNCED)
def test_a_model_says_its_frame_and_exports_cameras_of_the_world(tmp_path):
    names = room.write_photos(tmp_path / "images")
    scene, run = load_scene(colmap(tmp_path, names)), tmp_path / "run"
    command("train", tmp_path, "--run", run, *FLAGS, "--set", "texture.table_size=1024")
    model, origin = nw.load(run), tuple(scene.origin.tolist())
    assert model.origin == origin
    named = {**nw.load_cameras(run)["train"], **nw.load_cameras(run)["test"]}
    assert len(named) == len(names) and all(camera.origin == origin for camera in named.values())
    for form in ("cameras", "ply"):
        command("export", run, "--format", form)
    assert json.loads((run / "export" / "origin.json").read_text())["origin"] == list(origin)
    frames = json.loads((run / "export" / "transforms.json").read_text())["frames"]
    for frame, viewmat in zip(frames, room.poses(), strict=True):
        centre = UTM - viewmat[:3, :3].T @ viewmat[:3, 3]
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], centre, rtol=0, atol=1e-6)
    paths = load_camera_path(run / "export" / "camera_path.json", origin=origin).cameras
    for camera, one in zip((named[name] for name in names), paths, strict=True):
        torch.testing.assert_close(one.viewmat, camera.viewmat, rtol=0, atol=1e-6)
    local = named[names[1]]
    world = Camera(world_viewmats()[1], local.K.double(), room.WIDTH, room.HEIGHT, local.near, origin=(0.0, 0.0, 0.0))
    torch.testing.assert_close(model.render(world).image, model.render(local).image, rtol=0, atol=1e-4)
    command("render", run, "--path", run / "export" / "camera_path.json")
    assert len(list((run / "renders" / "path_camera_path").glob("*.png"))) == len(names)
