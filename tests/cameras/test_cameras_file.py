"""Cameras on disk: what comes back is what went in, damage is one clear line."""

import json

import pytest
import torch

from nexwarp.cameras.cameras_file import load_cameras, save_cameras
from tests.model_file_support import refused
from tests.scenes import make_camera, random_scene


def test_cameras_come_back_exactly(tmp_path):
    cameras = {
        "train": {f"{i}.png": make_camera(random_scene(2, off_centre=i == 1), near=0.1 * i) for i in range(3)},
        "test": {"folder/a b.jpg": make_camera(random_scene(2, seed=5))},
    }
    file = tmp_path / "cameras.json"
    save_cameras(file, cameras)
    loaded = load_cameras(file)
    assert {group: list(members) for group, members in loaded.items()} == {g: list(m) for g, m in cameras.items()}
    for group, members in cameras.items():
        for name, camera in members.items():
            now = loaded[group][name]
            assert torch.equal(now.viewmat, camera.viewmat) and torch.equal(now.K, camera.K)
            assert (now.width, now.height, now.near) == (camera.width, camera.height, camera.near)
            assert now.viewmat.dtype == torch.float32


ROWS = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
K = [[9.0, 0.0, 4.0], [0.0, 9.0, 3.0], [0.0, 0.0, 1.0]]
CAMERA: dict[str, object] = {"viewmat": ROWS, "K": K, "width": 8, "height": 6}
NEAR = CAMERA | {"near": 0.1}
MATRICES = (ROWS[:3], "text", [[float("nan")] * 4] * 4)


@pytest.mark.parametrize(
    "content",
    [
        *("", "{", "[1, 2]", '{"train": [1]}', '{"train": {"a": 3}}'),
        json.dumps({"train": {"a": CAMERA}}),  # no near
        *(json.dumps({"train": {"a": NEAR | {"viewmat": matrix}}}) for matrix in MATRICES),
        *(json.dumps({"train": {"a": NEAR | {name: ROWS}}}) for name in ("near", "K", "width")),
        json.dumps({"train": {"a": NEAR | {"width": 0}}}),
        *(json.dumps({"train": {name: NEAR}}) for name in ("../a", "C:/a")),
        json.dumps({"validation": {"a": NEAR}}),
    ],
)
def test_malformed_cameras(tmp_path, content):
    file = tmp_path / "cameras.json"
    file.write_text(content)
    refused(ValueError, load_cameras, file, names=file, match="expected named cameras as JSON")


def test_missing_cameras(tmp_path):
    file = tmp_path / "cameras.json"
    refused(FileNotFoundError, load_cameras, file, names=file, match="expected the run's cameras")
