"""A model and a camera to draw, and a run to view."""

from pathlib import Path

import pytest

import nexwarp as nw
from nexwarp.cli import main as cli
from tests.cli.support import FLAGS
from tests.scenes import intrinsics, make_camera, make_surfels, make_texture, random_scene
from tests.viewer.support import OPTIONS


@pytest.fixture(scope="module")
def model() -> nw.Model:
    return nw.Model(make_surfels(random_scene(60, width=64, height=48)), make_texture(), options=OPTIONS)


@pytest.fixture(scope="module")
def camera() -> nw.Camera:
    return make_camera(random_scene(1) | {"K": intrinsics(48.0, 48.0, 32.0, 24.0).float(), "width": 64, "height": 48})


@pytest.fixture(scope="module")
def run(tiny_folder, tmp_path_factory, small_preset) -> Path:
    folder = tmp_path_factory.mktemp("viewer") / "run"
    assert cli.main(["train", str(tiny_folder), "--run", str(folder), *FLAGS]) == 0
    return folder
