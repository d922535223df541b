import json
import math
import unicodedata
from pathlib import Path
from typing import Any

import pytest

from nexwarp.data import load_scene
from tests.data.inputs import room
from tests.data.test_scene import views_of

FX, FY, CX, CY = room.PINHOLE
SQUARE = (40.0, 40.0, 32.0, 24.0)
ANGLE_X, ANGLE_Y = 2 * math.atan(32.0 / 40.0), 2 * math.atan(24.0 / 40.0)
NONE = dict.fromkeys(("fl_x", "fl_y", "cx", "cy"))  # null counts as absent


def write(path: Path, pinhole=room.PINHOLE, names=None, encoding="utf-8", frame=(), **keys) -> Path:
    """Write photos of a pinhole camera, and a file with keys for all frames and for each frame."""
    rays = room.pinhole_rays(pinhole)
    names = [f"images/{index}.png" for index in range(room.VIEWS)] if names is None else names
    data: dict[str, Any] = room.transforms(names, **keys)
    for entry, photo in zip(data["frames"], room.photos(rays=rays), strict=True):
        file = path / unicodedata.normalize("NFC", entry["file_path"]).replace("\\", "/")
        file.parent.mkdir(parents=True, exist_ok=True)
        room.save_png(file, photo)
        entry |= dict(frame)
    (path / "transforms.json").write_text(json.dumps(data, ensure_ascii=False), encoding=encoding)
    return path


INTRINSICS: dict[str, Any] = {
    # pinhole of the photos, keys of each frame, keys of the file
    "the frame's angle, the file's focal length": (SQUARE, {"camera_angle_x": ANGLE_X}, {"cx": 32, "cy": 24}),
    "the frame's fl_x, the file's fl_y": (SQUARE, {"fl_x": 40.0}, {"fl_y": 99.0, "cx": 32, "cy": 24}),
    "the frame's fl_y, the file's angle": (SQUARE, {"fl_y": 40.0}, {**NONE, "camera_angle_x": 1.0}),
    "a vertical angle alone": (SQUARE, {}, {**NONE, "camera_angle_y": ANGLE_Y}),
    "two angles": (SQUARE, {}, {**NONE, "camera_angle_x": ANGLE_X, "camera_angle_y": ANGLE_Y}),
    "fl_x before an angle": (SQUARE, {}, {**NONE, "fl_x": 40.0, "camera_angle_x": 1.0}),
    "null in the frame": (room.PINHOLE, {"fl_x": None, "camera_angle_x": None, "cx": None}, {}),
    "the frame's cx, the file's cy": (room.PINHOLE, {"cx": CX}, {"cx": 9.0}),
    "the frame's own size": (SQUARE, {"w": 64, "h": 48, "cx": 32.0, "cy": 24.0, "fl_x": 40.0}, {"w": 640, "h": 480}),
    "sizes of the photos": (room.PINHOLE, {}, {"w": None, "h": None}),
}  # fmt: skip


@pytest.mark.parametrize("kind", INTRINSICS)
def test_intrinsics_of_frames_and_files(tmp_path, kind):
    pinhole, frame, keys = INTRINSICS[kind]
    path = write(tmp_path, pinhole, frame=frame, **keys)
    scene = load_scene(path)
    assert room.color_error(scene) < room.RIGHT
    for view in views_of(scene):
        camera = view.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(pinhole, rel=1e-6)


def bare(path: Path) -> Path:
    """As ScanNet++ names photos, and holds some out."""
    names = [f"{index}.png" for index in range(room.VIEWS)]
    data: dict[str, Any] = room.transforms(names)
    room.write_photos(path / "images")
    data["test_frames"] = data["frames"][:2]
    return room.write_transforms(path, {**data, "frames": data["frames"][2:]})


WRITERS = {
    "absolute paths": lambda path: write(path, names=[str(path / f"images/{i}.png") for i in range(room.VIEWS)]),
    "bare names and test_frames": bare,
    "backslashes": lambda path: write(path, names=[rf".\images\a\{index}.png" for index in range(room.VIEWS)]),
    "another Unicode form": lambda path: write(
        path, names=[unicodedata.normalize("NFD", f"images/\u00e9/{index}\u00fc.png") for index in range(room.VIEWS)]
    ),
    "a byte order mark": lambda path: write(path, encoding="utf-8-sig"),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_names_and_encodings(tmp_path, kind):
    scene = load_scene(WRITERS[kind](tmp_path))
    assert room.color_error(scene) < room.RIGHT and len(views_of(scene)) == room.VIEWS
    if kind == "bare names and test_frames":
        assert [view.name for view in scene.test] == ["0.png", "1.png"]


def test_without_its_test_frames_a_scene_is_split_as_others(tmp_path):
    path = bare(tmp_path)
    for name in ("0.png", "1.png"):
        (path / "images" / name).unlink()
    with pytest.warns(UserWarning, match="2 of 6"):
        assert [view.name for view in load_scene(path, skip_missing=True).test] == ["2.png"]


def test_lists_name_photos_in_any_form(tmp_path):
    names = [unicodedata.normalize("NFD", f"images/\u00e9{index}.png") for index in range(room.VIEWS)]
    listed = [unicodedata.normalize("NFC", name) for name in names]
    test = [listed[1], str(tmp_path / listed[2])]
    path = write(tmp_path, names=names, test_filenames=test, train_filenames=listed[3:])
    scene = load_scene(path)
    assert [view.name for view in scene.test] == [name[7:] for name in listed[1:3]] and len(scene.train) == 3


def test_photos_that_no_frame_has_are_named(tmp_path):
    path = write(tmp_path)
    room.save_png(path / "images/other.png", room.photos(1)[0])
    with pytest.warns(UserWarning, match=r"images: 1 of 7 photos are not used, as .*transforms.json .*: other.png"):
        load_scene(path)


@pytest.mark.parametrize(
    "keys",
    [
        {"k7": 0.1}, {"p3": 0.1}, {"b1": 1.0}, {"s1": 0.01}, {"k": -0.1}, {"K": [[40, 0, 32], [0, 40, 24], [0, 0, 1]]},
        {"rolling_shutter": [0.0, 0.0, 0.02, 0.0]}, {"ftheta_p0": 0.1}, {"lens_mode": "f_theta"}, {"skew": 0.1},
        {"distortion": {"k1": 0.1}}, {"distortion_params": [0.1]},
        {"camera_model": "FISHEYE624"}, {"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, {"is_fisheye": True},
        {"camera_model": "EQUIRECTANGULAR", "k1": 0.1}, {"camera_model": "OPENCV_FISHEYE", "k5": 0.1},
        {"transform_matrix_end": [[1.0]]}, {"latlong": True}, {"x_fov": 60.0},
    ],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("level", ["frame", "file"])
def test_a_lens_that_is_not_known_is_refused(tmp_path, keys, level):
    path = write(tmp_path, frame=keys if level == "frame" else {}, **(keys if level == "file" else {}))
    with pytest.raises(ValueError, match=rf"frame 0 .*({'|'.join(keys)}): expected"):
        load_scene(path)


def test_the_files_centre_is_not_taken_for_a_frame_of_another_size(tmp_path):
    path = write(tmp_path, frame={"w": 128, "h": 96})
    with pytest.raises(ValueError, match="cx: expected one of the frame's own, as its w is not the file's"):
        load_scene(path)
