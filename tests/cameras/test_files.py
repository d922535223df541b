import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.cameras_file import load_cameras, save_cameras
from nexwarp.cameras.nerfstudio import load_camera_path, save_camera_path, save_transforms
from tests.model_file_support import refused
from tests.scenes import intrinsics, make_camera, random_scene, rigid

FAR = 1e-6


def cameras(count: int = 6, centred: bool = False) -> list[Camera]:
    out = []
    for i in range(count):
        quat = tuple(torch.randn(4, dtype=torch.float64).tolist())
        viewmat = rigid(quat, tuple((5 * torch.randn(3, dtype=torch.float64)).tolist()))
        K = intrinsics(50.0 + i, 50.0 + i, 32, 24) if centred else intrinsics(50.0 + i, 61.5, 20.25 + i, 30.0)
        out.append(Camera(viewmat.float(), K.float(), 64, 48, near=0.1))
    return out


def assert_same(mine: Camera, theirs: Camera) -> None:
    assert (mine.viewmat - theirs.viewmat).abs().max() <= FAR and (mine.K - theirs.K).abs().max() <= FAR * 64
    assert (mine.width, mine.height, mine.near) == (theirs.width, theirs.height, theirs.near)


def test_transforms_come_back(tmp_path: Path) -> None:
    before = {f"images/{i}.png": each for i, each in enumerate(cameras())}
    before["images/large.png"] = Camera(torch.eye(4), intrinsics(700, 690, 401.5, 299).float(), 800, 600, near=0.1)
    names = list(before)
    save_transforms(tmp_path / "new" / "transforms.json", before, train=names[1:], test=names[:1])
    data = json.loads((tmp_path / "new" / "transforms.json").read_text())
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    for frame, (name, camera) in zip(data["frames"], before.items(), strict=True):
        pose = torch.tensor(frame["transform_matrix"], dtype=torch.float64) @ flip
        assert frame["file_path"] == name and (torch.linalg.inv(pose) - camera.viewmat).abs().max() <= FAR
        assert [frame[key] for key in ("fl_x", "fl_y", "cx", "cy")] == [camera.fx, camera.fy, camera.cx, camera.cy]
        assert (frame["w"], frame["h"]) == (camera.width, camera.height)
    assert data["train_filenames"] == names[1:] and data["val_filenames"] == data["test_filenames"] == names[:1]
    save_transforms(tmp_path / "all.json", before)  # without a split: a reader's own holds
    assert json.loads((tmp_path / "all.json").read_text()).keys() == {"camera_model", "frames"}


@pytest.mark.parametrize("centred", [True, False])
def test_camera_path_comes_back(tmp_path: Path, centred: bool) -> None:
    before = cameras(centred=centred)
    save_camera_path(tmp_path / "path.json", before, fps=24)
    after = load_camera_path(tmp_path / "path.json", near=0.1)
    assert after.fps == 24
    for mine, theirs in zip(after.cameras, before, strict=True):
        assert_same(mine, theirs)
    data = json.loads((tmp_path / "path.json").read_text())
    assert (data["render_width"], data["render_height"], data["seconds"]) == (64, 48, 0.25)
    # nerfstudio's entries hold no more than these, and cannot say more.
    extra = set() if centred else {"fl_x", "fl_y", "cx", "cy"}
    assert set(data["camera_path"][0]) == {"camera_to_world", "fov", "aspect"} | extra


def written(tmp_path: Path, data: Any) -> Path:
    path = tmp_path / "in.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


FLAT = torch.eye(4).flatten().tolist()
ENTRY = {"camera_to_world": FLAT, "fov": 60.0, "aspect": 2.0}
PATH = {"render_width": 200, "render_height": 100, "fps": 30, "seconds": 1, "camera_path": [ENTRY, ENTRY]}


def test_a_file_of_nerfstudios_viewer(tmp_path: Path) -> None:
    """Keys that it writes and we have no use for are no obstacle; the field of view is the vertical one."""
    more = {"keyframes": [{"matrix": "[]"}], "camera_type": "perspective", "crop": None, "is_cycle": False}
    path = load_camera_path(written(tmp_path, PATH | more), near=0.5)
    assert path.fps == 30 and len(path.cameras) == 2
    one = path.cameras[0]
    assert (one.width, one.height, one.near, one.cx, one.cy) == (200, 100, 0.5, 100.0, 50.0)
    assert one.fx == one.fy == pytest.approx(50 / math.tan(math.radians(30)))
    assert one.viewmat.equal(torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))


def entry(**changes: Any) -> dict[str, Any]:
    return PATH | {"camera_path": [ENTRY, {k: v for k, v in (ENTRY | changes).items() if v is not None}]}


SINGULAR = torch.diag(torch.tensor([1.0, 1.0, 0.0, 1.0])).flatten().tolist()
BAD = [
    ("{", "expected JSON, could not parse it"),
    ("[]", "expected a JSON object, got list"),
    ({}, "expected the key camera_path, found none"),
    ({"poses": [], "fps": 3}, "expected the key camera_path, found fps, poses"),
    (PATH | {"camera_path": []}, "camera_path: expected a list of at least one camera"),
    (PATH | {"camera_path": [3]}, r"camera_path\[0\]: expected a JSON object, got 3"),
    (PATH | {"camera_type": "fisheye"}, "camera_type: expected perspective, got 'fisheye'"),
    (PATH | {"render_width": 0}, "render_width: expected a number above 0, got 0"),
    (PATH | {"render_width": 10**9}, "render_width: expected at most 65536 pixels, got 1e"),
    (PATH | {"render_height": 10.5}, "render_height: expected a whole number of pixels, got 10.5"),
    (PATH | {"fps": "fast"}, "fps: expected a number above 0, got 'fast'"),
    (entry(fov=None), r"camera_path\[1\]: expected the key fov, found none"),
    (entry(fov=180), r"camera_path\[1\]: fov: expected a number above 0 below 180, got 180"),
    (entry(camera_to_world=None), r"camera_path\[1\]: expected the key camera_to_world, found none"),
    (entry(camera_to_world=SINGULAR), r"camera_path\[1\]: camera_to_world: expected an invertible pose, got the sing"),
    (entry(camera_to_world=[0.0] * 16), r"camera_path\[1\]: camera_to_world: expected the last row 0, 0, 0, 1"),
    (entry(camera_to_world=[10**400, *FLAT[1:]]), r"camera_path\[1\]: camera_to_world: expected a 4x4 matrix of"),
    (entry(camera_to_world=[1.0] * 9), r"camera_path\[1\]: camera_to_world: expected a 4x4 matrix of numbers"),
    (entry(camera_to_world=[math.nan, *FLAT[1:]]), r"camera_path\[1\]: camera_to_world: expected finite numbers"),
    (entry(camera_to_world=[2.0, *FLAT[1:]]), r"camera_path\[1\]: viewmat: expected an orthonormal rotation"),
    (entry(camera_to_world=[-1.0, *FLAT[1:]]), r"camera_path\[1\]: viewmat: expected a rotation with determinant 1"),
]


@pytest.mark.parametrize(("data", "message"), BAD)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, data: Any, message: str) -> None:
    path = written(tmp_path, data)
    with pytest.raises(ValueError, match=message) as caught:
        load_camera_path(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_other_wrong_inputs(tmp_path: Path) -> None:
    one = cameras(1)[0]
    other = Camera(one.viewmat, one.K, 65, 48)
    with pytest.raises(FileNotFoundError, match=r"no\.json: no such file, expected cameras as JSON"):
        load_camera_path(tmp_path / "no.json")
    for save, given, message in (
        (save_camera_path, ([one, other],), "cameras: expected one size, got 64x48 and 65x48"),
        (save_camera_path, ([],), "cameras: expected at least one, got none"),
        (save_transforms, ({},), "cameras: expected at least one, got none"),
        (save_camera_path, ([one], 0), "fps: expected more than 0 frames a second, got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            save(tmp_path / "a.json", *given)
    assert not list(tmp_path.iterdir())


# The cameras of a run


def test_cameras_come_back_exactly(tmp_path):
    train = {f"{i}.png": make_camera(random_scene(2, off_centre=i == 1), near=0.1 * i) for i in range(3)}
    saved = {"train": train, "test": {"folder/a b.jpg": make_camera(random_scene(2, seed=5))}}
    file = tmp_path / "cameras.json"
    save_cameras(file, saved)
    loaded = load_cameras(file)
    assert {group: list(members) for group, members in loaded.items()} == {g: list(m) for g, m in saved.items()}
    for group, members in saved.items():
        for name, camera in members.items():
            now = loaded[group][name]
            assert torch.equal(now.viewmat, camera.viewmat) and torch.equal(now.K, camera.K)
            assert (now.width, now.height, now.near) == (camera.width, camera.height, camera.near)
            assert now.viewmat.dtype == torch.float32


EYE = torch.eye(4).tolist()
K = [[9.0, 0.0, 4.0], [0.0, 9.0, 3.0], [0.0, 0.0, 1.0]]
CAMERA: dict[str, object] = {"viewmat": EYE, "K": K, "width": 8, "height": 6}
NEAR = CAMERA | {"near": 0.1}
MATRICES = (EYE[:3], "text", [[float("nan")] * 4] * 4, [[10**400]])


@pytest.mark.parametrize(
    "content",
    [
        *("", "{", "[1, 2]", '{"train": [1]}', '{"train": {"a": 3}}'),
        json.dumps({"train": {"a": CAMERA}}),  # no near
        *(json.dumps({"train": {"a": NEAR | {"viewmat": matrix}}}) for matrix in MATRICES),
        *(json.dumps({"train": {"a": NEAR | {name: EYE}}}) for name in ("near", "K", "width")),
        json.dumps({"train": {"a": NEAR | {"width": 0}}}),
        *(json.dumps({"train": {name: NEAR}}) for name in ("../a", "C:/a")),
        json.dumps({"validation": {"a": NEAR}}),
    ],
)
def test_missing_and_malformed_cameras(tmp_path, content):
    file = tmp_path / "cameras.json"
    refused(FileNotFoundError, load_cameras, file, names=file, match="expected the run's cameras")
    file.write_text(content)
    refused(ValueError, load_cameras, file, names=file, match="expected named cameras as JSON")
