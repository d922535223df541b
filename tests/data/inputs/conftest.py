"""The demo as a scene in other forms."""

from functools import partial

import pytest

import nexwarp.data.scene
from nexwarp.data.random_points import random_points
from tests.data.inputs.support import SIZE
from tests.scene_writers import BARREL, FISHEYE, demo_lens, write_demo, write_distorted


@pytest.fixture(autouse=True)
def few_random_points(monkeypatch):
    monkeypatch.setattr(nexwarp.data.scene, "random_points", partial(random_points, count=4000))


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return write_demo(tmp_path_factory.mktemp("demo") / "demo", **SIZE)


@pytest.fixture(scope="module")
def distorted(demo, tmp_path_factory):
    folder = tmp_path_factory.mktemp("distorted")
    lenses = {"OPENCV": BARREL, "OPENCV_FISHEYE": FISHEYE}.items()
    return {name: write_distorted(demo, folder / name, demo_lens(demo, name, lens)) for name, lens in lenses}
