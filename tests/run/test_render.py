"""Projections of `nexwarp render`, and what of its options is refused."""

import pytest
import torch

import nexwarp as nw
from nexwarp.errors import SettingError
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.run.render import RenderOrder, projected
from tests import scenes

pytestmark = pytest.mark.usefixtures("one_torch_thread")


@torch.no_grad()
def test_an_orthographic_picture_shows_the_middle_depth_as_a_pinhole_does():
    surfels = scenes.make_surfels(scenes.random_scene(60, width=40, height=30))
    model = Model(surfels, None, options=RenderOptions(max_hits=2))
    camera = scenes.make_camera(scenes.random_scene(60, width=40, height=30))
    taken = projected(RenderOrder(camera="orthographic"), model, camera)
    assert isinstance(taken, nw.RayCamera)
    depths = model.render(camera).median_depth
    assert taken.focal == pytest.approx(camera.focal / depths[depths > 0].median().item())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": "cube"}, "--camera: expected pinhole, panorama"),
        ({"fov": 0.0, "camera": "fisheye"}, "--fov: expected 1 to 360"),
        ({"fov": 90.0}, "--fov: expected together with --camera fisheye"),
        ({"buffers": True, "camera": "panorama"}, "--buffers: expected together with --camera pinhole"),
    ],
)
def test_options_that_do_not_fit_are_named(options, message):
    with pytest.raises(SettingError, match=message):
        RenderOrder(**options).check()
