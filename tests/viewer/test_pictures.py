import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.io.pictures import to_uint8
from nexwarp.viewer.modes import BY_SLOT, MODES, TEXTURED, Picture, Settings, draw
from nexwarp.viewer.world import Viewpoint, camera_to_world, vertical_fov
from tests.scenes import make_surfels, make_texture, random_scene
from tests.viewer.support import OPTIONS


def drawn(model: nw.Model, bands: Sequence[nw.Camera], settings: Settings) -> Picture:
    """The picture; none is given up."""
    picture = draw(model, bands, settings)
    assert picture is not None
    return picture


@pytest.mark.parametrize("mode", ["image", "plain", "textured"])
def test_colour_modes_are_the_buffers(model, camera, mode):
    with torch.no_grad():
        out = model.render(camera, max_hits=3, sh_degree=1)
    picture = drawn(model, [camera], Settings(mode, max_hits=3, sh_degree=1))
    assert picture.span is None
    np.testing.assert_array_equal(picture.pixels, to_uint8(getattr(out, mode)).numpy())


@pytest.mark.parametrize("falloff", [None, (-0.2, -0.1, 0.3)])
def test_colours_are_at_the_exposure_of_the_photos_or_the_mean(camera, falloff):
    model = nw.Model(make_surfels(random_scene(60, width=64, height=48)), make_texture(), options=OPTIONS)
    mean = {mode: drawn(model, [camera], Settings(mode)).pixels for mode in MODES}
    model.exposures = nw.Exposures.of(torch.tensor([[0.4, 0.0, -0.5]]), [camera], falloff)
    for mode in MODES:
        exposed = drawn(model, [camera], Settings(mode)).pixels
        assert np.array_equal(exposed, mean[mode]) == (mode not in ("image", "plain", "textured")), mode
        again = drawn(model, [camera], Settings(mode, photo_exposure=False)).pixels
        np.testing.assert_allclose(again.astype(int), mean[mode].astype(int), atol=1, err_msg=mode)


def test_buffer_modes_tell_what_the_buffers_hold(model, camera):
    with torch.no_grad():
        out = model.bare(max_hits=8).render(camera)
    pictures = {mode: drawn(model, [camera], Settings(mode, slot=2)) for mode in MODES}
    there = (out.ids[..., 1] >= 0).numpy()
    assert 0.1 < there.mean() < 0.99
    for mode in BY_SLOT:
        np.testing.assert_array_equal(pictures[mode].pixels.any(axis=2), there, err_msg=mode)
    ids = out.ids[..., 1].numpy()[there]
    colours = {i: {tuple(c) for c in pictures["ids"].pixels[there][ids == i]} for i in np.unique(ids)}
    assert all(len(c) == 1 for c in colours.values()), "one surfel, one colour"
    assert len(set.union(*colours.values())) == len(colours), "two surfels, two colours"
    # Scales: equal values have equal colours, and more is more of green, which viridis never takes back.
    for mode, values in (("depth", out.depths[..., 1]), ("weights", out.weights[..., 1]), ("alpha", out.alpha)):
        where = there if mode != "alpha" else np.ones_like(there)
        order = np.argsort(values.numpy()[where], kind="stable")
        assert (np.diff(pictures[mode].pixels[where][order][:, 1].astype(int)) >= 0).all(), mode
    span = pictures["depth"].span
    assert span is not None
    low, high = span
    assert float(out.depths[..., 1].numpy()[there].min()) <= low < high <= float(out.depths.max())


def test_normals_face_the_camera_and_belong_to_their_surfel(camera):
    to_world = torch.from_numpy(camera_to_world(camera)).float()
    centre, one = to_world[:3, 3] + 3.0 * to_world[:3, 2], torch.ones(1, 2)
    for quat in ((0.6, 0.5, -0.2, 0.4), (-0.5, 0.6, 0.4, 0.2)):  # the other side
        shape = (centre[None], torch.tensor([quat]), 2 * one, 0.9 * one[:, 0], one, torch.zeros(1, 1, 3))
        surfels = nw.Surfels.from_activated(*shape)
        picture = drawn(nw.Model(surfels, None, options=OPTIONS), [camera], Settings("normal"))
        normal = surfels.normals[0].detach()
        assert (normal @ to_world[:3, 2] < 0) == (quat[0] < 0)
        expected = normal if normal @ to_world[:3, 2] < 0 else -normal
        np.testing.assert_allclose(picture.pixels[24, 32] / 127.5 - 1.0, expected, atol=1.01 / 127)


@pytest.mark.parametrize("mode", MODES)
def test_bands_make_the_same_picture(model, camera, mode):
    here = Viewpoint(camera_to_world(camera), vertical_fov(camera), 64, 48)
    like = model.surfels.means
    whole, parts = here.bands(1.0, 0.01, like), here.bands(1.0, 0.01, like, count=3)
    assert [(c.height, c.cy) for c in parts] == [(16, 24.0), (16, 8.0), (16, -8.0)] and whole[0].height == 48
    assert draw(model, parts, Settings(mode), stale=lambda: True) is None, "a stale picture is given up"
    one, many = (drawn(model, bands, Settings(mode)).pixels.astype(int) for bands in (whole, parts))
    assert (abs(one - many) <= 1).mean() > 0.995 and one.std() > 1


def test_photo_detail_limits_the_texture_alone(model, camera):
    """Not the surfels, which are as wide as the picture's own pixels show them."""
    farthest = torch.full((len(model.surfels),), 3.5 / (3 * camera.focal))
    limits = nw.DetailLimits(torch.zeros_like(farthest), farthest)
    model = nw.Model(model.surfels, model.texture, detail_limits=limits, options=OPTIONS)
    here = Viewpoint(camera_to_world(camera), vertical_fov(camera), 256, 192)
    free, limited = (here.bands(1.0, 0.01, model.surfels.means, focal_limit=f) for f in (math.inf, camera.focal))
    assert limited[0].focal == pytest.approx(camera.focal) and free[0].focal == pytest.approx(4 * camera.focal)
    one, other = (drawn(model, bands, Settings("image")).pixels for bands in (free, limited))
    assert (one != other).any()
    for mode in ("plain", "ids", "depth"):
        one, other = (drawn(model, bands, Settings(mode)).pixels for bands in (free, limited))
        np.testing.assert_array_equal(one, other)


def test_no_surfels_and_no_texture_can_be_looked_at(camera, model):
    none = make_surfels({k: v[:0] if torch.is_tensor(v) and v.ndim else v for k, v in random_scene(3).items()})
    for mode in MODES:
        pixels = drawn(nw.Model(none, None, options=OPTIONS), [camera], Settings(mode)).pixels
        assert pixels.shape == (48, 64, 3) and (mode in ("image", "alpha") or not pixels.any())
    assert drawn(model.bare(), [camera], Settings(max_hits=0)).pixels.any() and set(TEXTURED) == {"image", "textured"}
