"""The WGSL renderer on wgpu against `Model.render`; skipped without wgpu or a Vulkan driver."""

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.errors import OutOfMemoryError
from nexwarp.export.web.renderer import Renderer
from nexwarp.export.web.scene_data import SceneData
from nexwarp.export.web.scene_file import encode_scene
from nexwarp.export.web.scene_reader import decode_scene
from nexwarp.model.options import RenderOptions
from nexwarp.viewer.modes import _id_colours, _normals
from tests.export.web.support import named_cameras, psnr, web_model
from tests.tolerances import FLIPS, WEB_PSNR, assert_close, assert_same_ids

wgpu = pytest.importorskip("wgpu", reason="the WGSL renderer in Python (extra `wgpu`)")
if not [a for a in wgpu.gpu.enumerate_adapters_sync() if a.info["backend_type"] in ("Vulkan", "Metal", "D3D12")]:
    pytest.skip("no Vulkan, Metal or D3D12 driver, such as mesa-vulkan-drivers", allow_module_level=True)

pytestmark = pytest.mark.timeout(300)
CASES: dict[str, dict[str, Any]] = {
    "default": {},
    "3 hits, low-pass, clamped": {
        "features": 4,
        "residual": False,
        "options": RenderOptions(max_hits=3, low_pass=True, clamp_texture=True, background=(0.5, 0.2, 0.1)),
    },
    "no hits": {"options": RenderOptions(max_hits=0)},
    "1 hit, degree 1": {"features": 1, "texture_degree": 1, "hidden_layers": 1, "options": RenderOptions(max_hits=1)},
    "no hidden layers, degree 2": {"features": 8, "hidden_layers": 0, "options": RenderOptions(sh_degree=2)},
    "degree 6": {"sh_degree": 6, "options": RenderOptions(sh_degree=6)},
    "no limits, mean exposure": {"options": RenderOptions(detail_limits=False, exposure="mean")},
}


@cache
def default() -> tuple[nw.Model, nw.Camera, Renderer]:
    model, camera = web_model()
    return model, camera, Renderer(model)


@pytest.mark.parametrize(
    "case", [name if name in ("default", "degree 6") else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_all_buffers_are_those_of_the_model(case):
    model, camera = web_model(**CASES[case])
    with torch.no_grad():
        expected = model.render(camera)
    renderer = Renderer(model)
    out = renderer.render(camera)
    assert_same_ids(torch.from_numpy(out.ids), expected.ids, name="ids", allow_flips=FLIPS)
    buffers = {"image": out.image, "alpha": out.alpha, "depths": out.depths, "weights": out.weights}
    for mode in ("plain", "textured"):
        buffers[mode] = renderer.render(camera, mode=mode).image
    for name, buffer in buffers.items():
        if buffer.size:
            # Drivers may compute exp2 and log2 with a few units in the last place; opacities near 1 amplify them.
            actual = torch.from_numpy(np.ascontiguousarray(buffer))
            assert_close(actual, getattr(expected, name), kind="value", name=name, allow_flips=FLIPS)


def test_a_quantised_file_is_within_its_bound():
    model, camera, _ = default()
    with torch.no_grad():
        expected = model.render(camera).image.numpy()
    scene = decode_scene(encode_scene(model, named_cameras(camera)))
    assert psnr(Renderer(scene).render(camera).image, expected) > WEB_PSNR["quantised"]


def test_lists_grow_and_the_picture_does_not_depend_on_their_capacity():
    _, camera, renderer = default()
    expected = renderer.render(camera)
    assert expected.entries > 16
    renderer._capacity = 16
    out = renderer.render(camera)
    assert renderer._capacity >= out.entries == expected.entries
    np.testing.assert_array_equal(out.image, expected.image)


def test_pictures_repeat_bit_for_bit():
    _, camera, renderer = default()
    first = renderer.render(camera).image
    renderer.render(camera, mode="depth")
    np.testing.assert_array_equal(renderer.render(camera).image, first)


def test_modes_show_the_buffers_of_the_heaviest_hit():
    model, camera, renderer = default()
    with torch.no_grad():
        expected = model.render(camera)
        ids = expected.ids[..., 0].long()
        hit = (ids >= 0)[..., None]
        normals = _normals(model.surfels, camera.position)[ids.clamp_min(0)]
        pictures = {"ids": _id_colours(ids) * hit, "normals": (0.5 + 0.5 * normals) * hit}
        pictures["alpha"] = expected.alpha[..., None].expand(*ids.shape, 3)
    for mode, picture in pictures.items():
        shown = torch.from_numpy(renderer.render(camera, mode=mode).image.copy())
        assert_close(shown, picture.contiguous(), kind="value", name=mode, allow_flips=FLIPS)
    near, far = (renderer.render(camera, mode="depth").image[mask] for mask in _by_depth(expected))
    assert near[:, 1].mean() < far[:, 1].mean()  # violet to yellow


def _by_depth(expected: nw.Rendering) -> tuple[np.ndarray, np.ndarray]:
    """Masks of the nearest and of the farthest quarter of the pixels with a hit."""
    depth, hit = expected.depths[..., 0].numpy(), expected.ids[..., 0].numpy() >= 0
    low, high = np.quantile(depth[hit], [0.25, 0.75])
    return hit & (depth <= low), hit & (depth >= high)


def test_coarser_texels_keep_the_pixels_that_were_evaluated():
    _, camera, renderer = default()
    exact, coarse = renderer.render(camera).image, renderer.render(camera, texel_step=2).image
    # Its own texel has 9,999 of 10,000 parts.
    assert np.abs(coarse[::2, ::2] - exact[::2, ::2]).max() < 1e-3
    assert 1e-4 < np.abs(coarse - exact).max()
    with pytest.raises(ValueError, match="texel_step: expected one of"):
        renderer.render(camera, texel_step=5)


def test_light_second_hits_keep_their_plain_colours():
    model, camera, renderer = default()
    with torch.no_grad():
        out = model.render(camera)
        base = out.intermediates.projection.records[:, 3, :3][out.ids[..., 1].clamp_min(0).long()]
        factors = out.intermediates.factors
        assert factors is not None
        second = (base * factors - out.colors[..., 1, :]) * out.weights[..., 1:]
        expected = out.image + second * (out.ids[..., 1:] >= 0)
    image = torch.from_numpy(renderer.render(camera, least_weight=1.0).image.copy())
    assert_close(image, expected, kind="value", name="image", allow_flips=FLIPS)


def test_an_empty_scene_shows_the_background():
    model, camera, _ = default()
    empty = nw.Surfels({name: value[:0] for name, value in model.surfels.state_dict().items()})
    scene = SceneData.of(nw.Model(empty, None, options=RenderOptions(background=(0.25, 0.5, 1.0))))
    out = Renderer(scene).render(camera)
    np.testing.assert_allclose(out.image, np.broadcast_to([0.25, 0.5, 1.0], out.image.shape))
    assert out.entries == 0 and (out.ids == -1).all()


def test_limits_of_the_device_are_checked_before_anything_is_allocated():
    _, camera, renderer = default()
    before = dict(renderer.gpu.limits)
    renderer.gpu.limits.update({"max-buffer-size": 10_000})
    try:
        with pytest.raises(OutOfMemoryError, match=r"expected at most 10,000 bytes in a buffer of this device"):
            renderer.render(nw.Camera(camera.viewmat, camera.K, 4000, 3000))
    finally:
        renderer.gpu.limits.update(before)
    np.testing.assert_array_equal(renderer.render(camera).image.shape, (camera.height, camera.width, 3))


def test_wrong_arguments_are_named():
    _, camera, renderer = default()
    with pytest.raises(TypeError, match=r"camera: expected a nexwarp\.Camera, got str"):
        renderer.render("front")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"mode: expected one of image, plain, "):
        renderer.render(camera, mode="picture")


@pytest.mark.slow
def test_other_forms_of_the_mlp_agree():
    model, camera, renderer = default()
    expected = renderer.render(camera).image
    for half, unrolled, uniform in ((False, True, True), (False, False, False), (True, False, True)):
        image = Renderer(model, half=half, unrolled=unrolled, uniform=uniform).render(camera).image
        assert psnr(image, expected) > (70 if half else 120), (half, unrolled, uniform)
