"""A model and a camera to draw, and a run to view."""

from pathlib import Path

import pytest

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.train import recipe
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from tests.scene_writers import write_demo
from tests.scenes import intrinsics, make_camera, make_surfels, make_texture, random_scene
from tests.viewer.support import OPTIONS


@pytest.fixture(scope="module")
def model() -> nw.Model:
    return nw.Model(make_surfels(random_scene(60, width=64, height=48)), make_texture(), options=OPTIONS)


@pytest.fixture(scope="module")
def camera() -> nw.Camera:
    scene = random_scene(1)
    return make_camera(scene | {"K": intrinsics(48.0, 48.0, 32.0, 24.0).float(), "width": 64, "height": 48})


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A tiny finished run."""
    folder = tmp_path_factory.mktemp("viewer")
    scene = write_demo(folder / "tiny", width=48, height=36, views=10, points=200)
    small = Config(texture=TextureConfig(levels=4, table_size=2**10, width=16), densify=DensifyConfig(every=3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(recipe.PRESETS, "default", small)
        flags = ["--iterations", "20", "--max-surfels", "100", "--device", "cpu"]
        assert cli.main(["train", str(scene), "--run", str(folder / "run"), *flags]) == 0
    return folder / "run"
