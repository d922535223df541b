from typing import Any

import numpy as np
import pytest
import torch

from nexwarp.data import load_scene
from nexwarp.data.lens import Intrinsics, Lens, undistortion
from tests.data.inputs import room
from tests.data.inputs.support import assert_same_cameras
from tests.data.test_scene import make_scene
from tests.scene_writers import write_nerfstudio

FOCAL, CENTRE = 40.0, (31.0, 24.5)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_a_lens_is_the_same_in_nerfstudios_words(distorted, tmp_path, model):
    scene = load_scene(write_nerfstudio(distorted[model], tmp_path / "scene"))
    assert_same_cameras(scene, load_scene(distorted[model]))


def radial(angle_terms=(), numerator=(), denominator=(), tangential=(0.0, 0.0)):
    """Positions (N, 2) in a photo, in focal lengths, of directions at depth 1: OpenCV's and Brown's formulas."""

    def bend(flat: np.ndarray) -> np.ndarray:
        squared = (flat**2).sum(axis=1, keepdims=True)
        if angle_terms:
            angle = np.arctan(np.sqrt(squared))
            return flat * angle / np.sqrt(squared) * np.polyval([*angle_terms[::-1], 1.0], angle**2)
        factor = np.polyval([*numerator[::-1], 1.0], squared) / np.polyval([*denominator[::-1], 1.0], squared)
        x, y = flat.T[:, :, None]
        p1, p2 = tangential
        shift = np.hstack([2 * p1 * x * y + p2 * (squared + 2 * x * x), 2 * p2 * x * y + p1 * (squared + 2 * y * y)])
        return flat * factor + shift

    return bend


def rays_through(bend, focal: float = FOCAL) -> np.ndarray:
    """Directions (H, W, 3) of a photo's pixels, by fixed-point steps, which need no derivative."""
    wanted = (room.pinhole_rays((focal, focal, *CENTRE))[..., :2]).reshape(-1, 2)
    flat = wanted.copy()
    for _ in range(400):
        flat = flat + 0.5 * (wanted - bend(flat))
    return np.concatenate([flat, np.ones((len(flat), 1))], axis=1).reshape(room.HEIGHT, room.WIDTH, 3)


# camera_model and coefficients in transforms.json; the closed form; a COLMAP camera of the same
BARREL_K = {"k1": -0.18, "k2": 0.08}
BROWN = {**BARREL_K, "k3": 0.02, "k4": 0.15, "p1": 0.01}
BENT, TURNED = (-0.18, 0.08), (0.01, -0.006)
RATIONAL = {"camera_model": "FULL_OPENCV", **BARREL_K, "k4": 0.15}
FISH = {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k4": -0.01}
LENSES: dict[str, Any] = {
    "OPENCV": ({**BARREL_K, "p1": 0.01, "p2": -0.006}, radial((), BENT, (), TURNED), "OPENCV -0.18 0.08 0.01 -0.006"),
    "no model named": ({"camera_model": None, **BARREL_K}, radial((), (-0.18, 0.08)), "RADIAL -0.18 0.08"),
    "k3": ({**BARREL_K, "k3": 0.1}, radial((), (-0.18, 0.08, 0.1)), None),
    "Brown's k4": (BROWN, radial((), (-0.18, 0.08, 0.02, 0.15), (), (0.01, 0.0)), None),
    "rational": (RATIONAL, radial((), BENT, (0.15,)), "FULL_OPENCV -0.18 0.08 0 0 0 0.15 0 0"),
    "k5": ({**BARREL_K, "k4": 0.15, "k5": 0.05}, radial((), BENT, (0.15, 0.05)), None),
    "fisheye": (FISH, radial((0.05, 0.0, 0.0, -0.01)), "OPENCV_FISHEYE 0.05 0 0 -0.01"),
    "older words": ({"camera_model": None, "is_fisheye": True, "k1": 0.05}, radial((0.05,)), "RADIAL_FISHEYE 0.05 0"),
}


@pytest.mark.parametrize("kind", LENSES)
def test_photos_of_a_lens_show_the_room(tmp_path, kind):
    keys, bend, colmap = LENSES[kind]
    names = room.write_photos(tmp_path / "images", rays=rays_through(bend))
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": CENTRE[0], "cy": CENTRE[1], "camera_model": "OPENCV"}
    data = room.transforms([f"images/{name}" for name in names], **lens | keys)
    assert room.color_error(load_scene(room.write_transforms(tmp_path, data))) < room.RIGHT
    if colmap is not None:
        model, *coefficients = colmap.split()
        focal = [FOCAL] if "RADIAL" in model else [FOCAL, FOCAL]
        camera = " ".join(map(str, [model, room.WIDTH, room.HEIGHT, *focal, *CENTRE, *coefficients]))
        room.write_colmap(tmp_path, names, camera)
        assert room.color_error(load_scene(tmp_path, format="colmap")) < room.RIGHT


@pytest.mark.parametrize("degrees", [120, 170, 190, 240])
def test_a_wide_fisheye_keeps_its_view(tmp_path, degrees):
    """At twice the photo's size, the most that an undistorted image has, it is as wide as that allows."""
    focal = room.WIDTH / np.radians(degrees)
    flat = room.pinhole_rays((focal, focal, *CENTRE))[..., :2]
    angle = np.linalg.norm(flat, axis=-1, keepdims=True)
    rays = np.concatenate([flat / angle * np.sin(angle), np.cos(angle)], axis=-1)
    names = [f"images/{name}" for name in room.write_photos(tmp_path / "images", rays=rays)]
    lens = {"fl_x": focal, "fl_y": focal, "cx": CENTRE[0], "cy": CENTRE[1], "camera_model": "OPENCV_FISHEYE"}
    scene = load_scene(room.write_transforms(tmp_path, room.transforms(names, **lens)))
    camera = scene.train[0].camera
    nearest = CENTRE[0] - 0.5  # the distance of the nearer side
    most = min(focal * np.tan(nearest / focal) / CENTRE[0], 2.0) * room.WIDTH if degrees < 180 else 2 * room.WIDTH
    assert camera.width == int(most) and camera.fx == pytest.approx(focal)
    assert room.color_error(scene) < 3 * room.RIGHT  # the photo has few pixels for so wide a view


def test_a_lens_that_turns_back_is_masked_from_there(tmp_path):
    """r - 0.5 r^3 turns back at r = 0.82: what lies beyond would show the inner part again."""
    lens = Lens("OPENCV", (40.0, 40.0, *CENTRE, -0.5, 0.0, 0.0, 0.0), room.WIDTH, room.HEIGHT)
    valid = undistortion(lens, Intrinsics(20.0, 20.0, 40.0, 30.0, 80, 60), None).valid
    assert valid is not None
    radius = np.linalg.norm(room.pinhole_rays((20.0, 20.0, 40.0, 30.0), 80, 60)[..., :2], axis=-1)
    turn = np.sqrt(2 / 3)
    assert not valid.numpy()[radius > turn].any() and valid.numpy()[radius < turn - 0.02].all()


def test_a_panorama_becomes_six_views(tmp_path):
    path = make_scene(tmp_path / "scene", model="EQUIRECTANGULAR", params=(48.0, 36.0), names=["a.png", "b.png"])
    scene = load_scene(path)
    faces = ("front", "right", "back", "left", "up", "down")
    assert [view.name for view in scene.test] == [f"a_{face}.png" for face in faces]
    assert len(scene.train) == 6 and all(v.image.shape == (15, 15, 3) for v in scene.train)
    centres = torch.stack([v.camera.position for v in scene.train])
    torch.testing.assert_close(centres, centres[:1].expand(6, 3), rtol=0, atol=1e-6)
    forward = torch.stack([v.camera.viewmat[2, :3] for v in scene.train])
    torch.testing.assert_close(forward.sum(dim=0), torch.zeros(3), rtol=0, atol=1e-6)
