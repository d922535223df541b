"""The order of blending: by distance, what a pixel shows depends on its ray alone, not on where the camera points."""

import numpy as np
import pytest
import torch
from PIL import Image

import nexwarp as nw
from nexwarp.errors import FormatError, SettingError
from nexwarp.export.web.scene_file import SceneData
from nexwarp.io.pictures import to_uint8
from nexwarp.model import graphs as frames
from nexwarp.ops.tiles import Order
from nexwarp.run.render import PictureJob, RenderJob, RenderOrder
from tests import scenes
from tests.panorama_support import turned
from tests.render_support import (
    BUFFERS,
    assert_same,
    draw,
)
from tests.tolerances import assert_close, assert_same_ids

ORDERS: tuple[Order, ...] = ("depth", "distance")


def test_by_distance_another_surfel_is_in_front():
    scene = scenes.named_scene("wide", torch.float32, "cpu")
    by_depth, by_distance = (draw(scene, order=order) for order in ORDERS)
    assert (by_depth.image - by_distance.image).abs().max() > 0.01
    assert_same(draw(scene), by_depth)


def test_turning_the_camera_changes_no_ray(device):
    """A camera turned by 30 degrees and given the rays of the first one sees what the first one does, by distance."""
    scene = scenes.named_scene("wide", torch.float64, device)
    camera = scenes.make_camera(scene)
    texture = scenes.make_texture(dtype=torch.float64, device=device)
    texture.half_precision = False
    model = nw.Model(scenes.make_surfels(scene), texture, options=nw.RenderOptions(order="distance"))
    away = turned(camera.viewmat.detach(), 0.5, -0.2)
    rays = nw.RayCamera.pinhole(camera).rays @ camera.viewmat.detach()[:3, :3] @ away[:3, :3].T
    other = nw.RayCamera(away, rays.contiguous(), camera.near, camera.focal)
    with torch.no_grad():
        expected, found = model.render(camera), model.render(other)
        by_depth = model.render(camera, order="depth")
        same = model.render(nw.RayCamera.pinhole(camera))
    assert_same_ids(found.ids, expected.ids, name="ids")
    for name in BUFFERS:
        assert_close(getattr(found, name), getattr(expected, name), kind="value", name=name)
        assert_close(getattr(same, name), getattr(expected, name), kind="value", name=name)
    assert (by_depth.image - expected.image).abs().max() > 0.01


@pytest.mark.cuda
def test_captured_frames_keep_their_orders():
    scene = scenes.named_scene("wide", torch.float32, "cuda")
    model, camera = nw.Model(scenes.make_surfels(scene), None), scenes.make_camera(scene)
    with torch.no_grad(), frames.without_graphs():
        expected = {order: model.render(camera, order=order).image for order in ORDERS}
    assert not torch.equal(expected["depth"], expected["distance"])
    with torch.no_grad():
        for _ in range(3):
            for order in ORDERS:
                assert torch.equal(model.render(camera, order=order).image, expected[order])
    assert len(frames._graphs[model.surfels].frames) == 2


def test_the_order_is_kept_in_files_and_named_where_it_is_bad(tmp_path):
    scene = scenes.random_scene(4)
    model = nw.Model(scenes.make_surfels(scene), None, options=nw.RenderOptions(order="distance"))
    assert nw.load(model.save(tmp_path)).options.order == "distance"
    with pytest.raises(ValueError, match="order: expected depth or distance, got 1"):
        nw.render(model.surfels, None, scenes.make_camera(scene), order=1)  # type: ignore[arg-type]
    with pytest.raises(FormatError, match="order: expected depth, which the web page draws, got distance"):
        SceneData.of(model)


def test_the_command_renders_by_the_order_asked_for(tmp_path):
    scene = scenes.named_scene("wide", torch.float32, "cpu")
    model, camera = nw.Model(scenes.make_surfels(scene), None), scenes.make_camera(scene)
    camera = nw.Camera(camera.viewmat.detach(), camera.K, camera.width, camera.height, camera.near)
    for order in ORDERS:
        file = tmp_path / f"{order}.png"
        RenderJob([PictureJob(file, camera)], RenderOrder(set="test", order=order)).render(model)
        expected = to_uint8(model.render(camera, order=order).image.detach())
        assert (np.asarray(Image.open(file)) == expected.numpy()).all()
    with pytest.raises(SettingError, match="--order: expected depth or distance, got 'near'"):
        RenderOrder(set="test", order="near").check()
