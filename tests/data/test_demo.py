import pytest
import torch

from nexwarp.data import Scene, demo_folder, load_scene
from nexwarp.data.scene import SceneSource
from tests.export.web.support import bilinear


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(demo_folder())


def test_the_demo_is_small_and_general(scene: Scene) -> None:
    assert sum(file.stat().st_size for file in demo_folder().rglob("*")) < 1.5e6
    assert len(scene.train) == 35 and len(scene.test) == 5 and 1500 < len(scene.points) <= 2000
    camera = scene.train[0].camera
    assert camera.fx != camera.fy and camera.cx != camera.width / 2 and camera.cy != camera.height / 2
    assert all(view.image.double().std() > 25.0 for view in scene.train + scene.test)
    named = SceneSource("demo").load()
    assert named.path == demo_folder() and torch.equal(named.points, scene.points)


def test_points_reproject_onto_their_colors(scene: Scene) -> None:
    errors = []
    for view in scene.train:
        pixels, depths = view.camera.project(scene.points)
        size = torch.tensor([view.camera.width, view.camera.height])
        inside = (pixels > 1).all(dim=1) & (pixels < size - 1).all(dim=1) & (depths > view.camera.near)
        error = torch.full((len(scene.points),), float("nan"))
        shown = bilinear(view.image.float(), pixels[inside] - 0.5)
        error[inside] = (shown - scene.colors[inside].float()).abs().mean(dim=1)
        errors.append(error)
    # A point is seen by a few of the views that have it in frame; in the best three of them it must match.
    best = torch.stack(errors).nan_to_num(nan=255.0).sort(dim=0).values[:3].amax(dim=0)
    assert best.median() < 12.0 and best.quantile(0.8) < 30.0
