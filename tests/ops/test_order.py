import pytest
import torch

import nexwarp as nw
from nexwarp.errors import FormatError
from nexwarp.export.web.scene_file import scene_arrays
from nexwarp.model import graphs as frames
from nexwarp.ops.tiles import Order
from tests import scenes
from tests.tolerances import assert_close

ORDERS: tuple[Order, ...] = ("depth", "distance")


def test_turning_the_camera_changes_no_ray(device):
    """A camera of one pixel, turned until it looks along a pixel's ray, sees what that pixel shows, by distance."""
    scene = scenes.named_scene("wide", torch.float64, device)
    camera = scenes.make_camera(scene)
    surfels = scenes.make_surfels(scene)
    whole, by_depth = (nw.render(surfels, None, camera, order=order) for order in ("distance", "depth"))
    changed = ((whole.image - by_depth.image).abs().amax(-1) > 0.01).nonzero()
    assert len(changed)
    for row, column in changed[:: max(len(changed) // 6, 1)].tolist():
        x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
        forward = torch.nn.functional.normalize(torch.tensor([x, y, 1.0]).to(camera.viewmat), dim=0)
        right = torch.nn.functional.normalize(torch.tensor([1.0, 0.0, -x]).to(camera.viewmat), dim=0)
        turn = torch.eye(4).to(camera.viewmat)
        turn[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        K = torch.tensor([[camera.fx, 0, 0.5], [0, camera.fy, 0.5], [0, 0, 1]]).to(camera.K)
        single = nw.render(surfels, None, nw.Camera(turn @ camera.viewmat.detach(), K, 1, 1, 0.0), order="distance")
        assert torch.equal(single.ids[0, 0], whole.ids[row, column])
        for name in ("image", "weights", "alpha"):
            assert_close(getattr(single, name)[0, 0], getattr(whole, name)[row, column], kind="value", name=name)


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
        scene_arrays(model)
