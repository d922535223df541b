"""The WebGPU renderer in Chromium, on SwiftShader, against `Model.render`; skipped without Chromium."""

import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.export.web.export import static_files
from nexwarp.export.web.scene_file import encode_scene
from nexwarp.model.options import RenderOptions
from nexwarp.viewer.modes import Settings, _values
from tests.export.web.support import CHROMIUM, URL, WEBGPU, Tab, entry_of, named_cameras, psnr, web_model
from tests.export.web.test_scene_file import damaged
from tests.scenes import make_camera, make_surfels, random_scene
from tests.tolerances import FLIPS, WEB_PSNR, assert_close, assert_same_ids

pytestmark = [pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine"), pytest.mark.timeout(300)]
PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<script type="importmap">{"imports": {"nexwarp/": "./"}}</script>
<script type="module">
import { Renderer } from "nexwarp/renderer.js";
import { SceneReader } from "nexwarp/scene.js";
window.nexwarp = { Renderer, SceneReader };
</script>"""
OPEN = """async ([file, settings]) => {
    window.stages = [];
    window.renderer?.destroy();
    window.target = document.createElement("canvas");
    window.renderer = await nexwarp.Renderer.create(target, { onStage: (stage) => stages.push(stage), ...settings });
    await renderer.load(file);
}"""
RENDER = """async ([camera, options, names]) => {
    Object.assign(target, {width: camera.width, height: camera.height});
    const frame = await renderer.render(camera, options);
    const buffers = {};
    for (const name of names) buffers[name] = Array.from(await renderer.read(name));
    return [frame.entries, buffers];
}"""
READ = """async (file) => {
    try {
        const reader = new nexwarp.SceneReader((await fetch(file)).body);
        await reader.readHeader();
        await reader.readTo("grid");
        return "no error";
    } catch (error) {
        return `${error.name}: ${error.message}`;
    }
}"""
CASES: dict[str, dict[str, Any]] = {
    "default": {},
    "3 hits, clamped": {
        "features": 4,
        "residual": False,
        "options": RenderOptions(max_hits=3, clamp_texture=True, background=(0.5, 0.2, 0.1)),
    },
    "no hits": {"options": RenderOptions(max_hits=0)},
    "1 hit, degree 1": {"features": 1, "sh_degree": 1, "hidden_layers": 1, "options": RenderOptions(max_hits=1)},
    "no hidden layers, degree 2": {"features": 8, "hidden_layers": 0, "options": RenderOptions(sh_degree=2)},
    "no limits, mean exposure": {"options": RenderOptions(detail_limits=False, exposure="mean")},
}


class RendererTab(Tab):
    """A page with the renderer's modules."""

    def load(
        self, model: nw.Model, *, quality: str = "full", poster: bytes | None = None, **settings: Any
    ) -> nw.Camera:
        """Load a model into a new renderer; its file has the camera of `web_model`, which is returned."""
        camera = web_model()[1]
        file = encode_scene(model, named_cameras(camera), quality=quality, poster=poster)
        self.files["scene.nxw"] = file
        self.value(OPEN, ["scene.nxw", settings])
        return camera

    def render(self, camera: nw.Camera, *names: str, **options: Any) -> dict[str, torch.Tensor]:
        """Render; returns "image" and further buffers by name, (H, W, C), and the number of list "entries"."""
        entries, buffers = self.value(RENDER, [entry_of(camera), options, ["image", *names]])
        size = (camera.height, camera.width, -1)
        kinds = {name: torch.int32 if name == "ids" else torch.float32 for name, values in buffers.items() if values}
        tensors = {name: torch.tensor(buffers[name], dtype=kind).reshape(size) for name, kind in kinds.items()}
        return tensors | {"image": tensors["image"][..., :3].contiguous(), "entries": torch.tensor(entries)}


@pytest.fixture(scope="module")
def tab() -> Iterator[RendererTab]:
    api = pytest.importorskip("playwright.sync_api", reason="drives Chromium (extra `dev`)")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *WEBGPU])
        tab = RendererTab(browser, {**static_files(), "index.html": PAGE.encode()})
        tab.page.goto(URL)
        tab.page.wait_for_function("window.nexwarp")
        yield tab
        browser.close()


@pytest.fixture
def default(tab) -> tuple[nw.Model, nw.Camera]:
    """The default model, loaded bit for bit in single precision, and its camera."""
    model, _ = web_model()
    return model, tab.load(model, half=False)


@torch.no_grad()
def test_the_canvas_shows_the_model(tab):
    model, camera = web_model()
    expected = model.render(camera)
    tab.load(model, poster=b"picture")
    assert tab.value("renderer.textured") and tab.value("renderer.surfels") == len(model.surfels)
    assert tab.value("stages") == ["header", "geometry", "grid", "done"]
    out = tab.render(camera, "ids")
    assert psnr(out["image"], expected.image) > WEB_PSNR["full"]
    pixels = tab.value("[...target.getContext('2d').getImageData(0, 0, 37, 27).data]")
    shown = torch.tensor(pixels).reshape(camera.height, camera.width, 4)[..., :3] / 255
    assert (shown - out["image"].clip(0, 1)).abs().max() < 1.1 / 255
    picked = tab.value("renderer.pick(18, 13)")
    assert picked["id"] == out["ids"][13, 18, 0]
    assert picked["depth"] == pytest.approx(expected.depths[13, 18, 0].item(), rel=1e-4)
    tab.load(model, quality="quantised")
    assert psnr(tab.render(camera)["image"], expected.image) > WEB_PSNR["quantised"]
    assert tab.errors == []


@pytest.mark.parametrize(
    "case", [name if name == "default" else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
@torch.no_grad()
def test_all_buffers_are_those_of_the_model(tab, case):
    model, camera = web_model(**CASES[case])
    expected = model.render(camera)
    tab.load(model, half=False)
    out = tab.render(camera, "ids", "depths", "weights", "colors")
    buffers = {name: out[name] for name in ("image", "depths", "weights") if name in out}
    buffers["alpha"] = out["colors"][..., 3].contiguous()
    for mode in ("plain", "textured"):
        buffers[mode] = tab.render(camera, mode=mode)["image"]
    if model.options.max_hits:
        assert_same_ids(out["ids"], expected.ids, name="ids", allow_flips=FLIPS)
    for name, buffer in buffers.items():
        # Drivers may compute exp2 and log2 with a few units in the last place; opacities near 1 amplify them.
        assert_close(buffer, getattr(expected, name), kind="value", name=name, allow_flips=FLIPS)


@torch.no_grad()
def test_hits_before_the_near_plane_do_not_count(tab, default):
    """Surfels lie before the plane, behind it and across it."""
    model, camera = default
    depths = model.render(camera).depths[..., 0]
    cut = replace(camera, near=float(depths[depths > 0].median()))
    expected = model.render(cut).image
    assert (tab.render(camera)["image"] - expected).abs().max() > 0.1
    assert_close(tab.render(cut)["image"], expected, kind="value", name="image", allow_flips=FLIPS)


@torch.no_grad()
def test_of_equal_weights_the_nearer_hit_comes_first(tab):
    """Each pixel sees two surfels of its own, nearly of equal weights; some are equal to the bit."""
    side = 24
    near = torch.linspace(-1.2, -1.0, side**2)  # logits
    far = (near.sigmoid() / (1 - near.sigmoid())).logit()
    y, x = torch.meshgrid(*[(torch.arange(side) + 0.5) / side - 0.5] * 2, indexing="ij")
    rays = torch.stack([x.flatten(), y.flatten(), torch.ones(side**2)], 1)
    scene = random_scene(2 * side**2, width=side, height=side)
    scene |= {"means": torch.cat([2 * rays, rays]), "quats": torch.eye(4)[:1].expand(2 * side**2, 4)}
    scene |= {"scales": torch.full((2 * side**2, 2), 0.1 / side), "gammas": torch.ones(2 * side**2, 2)}
    scene |= {"viewmat": torch.eye(4), "K": torch.tensor([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]])}
    surfels, camera = make_surfels(scene), make_camera(scene)
    surfels.logit_opacities.copy_(torch.cat([far, near]))
    model = nw.Model(surfels, None, options=RenderOptions(max_hits=2))
    tab.load(model)
    out = tab.render(camera, "ids", "weights")
    equal = out["weights"][..., 0] == out["weights"][..., 1]
    assert equal.sum() > 10
    assert (out["ids"][equal][:, 0] >= side**2).all()


def test_lists_grow_and_pictures_repeat_bit_for_bit(tab, default):
    _, camera = default
    expected = tab.render(camera)
    assert expected["entries"] > 16
    tab.render(camera, mode="depth")
    assert torch.equal(tab.render(camera)["image"], expected["image"])
    tab.value("renderer.capacity = 16")
    again = tab.render(camera)
    assert tab.value("renderer.capacity") >= again["entries"]
    assert all(torch.equal(again[name], expected[name]) for name in ("image", "entries"))


@torch.no_grad()
def test_modes_show_the_buffers_of_the_heaviest_hit(tab, default):
    model, camera = default
    expected = model.render(camera)
    hit = expected.ids[..., :1] >= 0
    names = {"ids": "ids", "normals": "normal"}  # in the viewer
    pictures = {mode: _values(expected, model.surfels, camera, Settings(mode=name)) for mode, name in names.items()}
    for mode, picture in pictures.items():
        shown = tab.render(camera, mode=mode)["image"]
        assert_close(shown, picture.contiguous(), kind="value", name=mode, allow_flips=FLIPS)
    depth, shown = expected.depths[..., 0], tab.render(camera, mode="depth")["image"]
    low, high = depth[hit[..., 0]].quantile(torch.tensor([0.25, 0.75]))
    near, far = shown[hit[..., 0] & (depth <= low)], shown[hit[..., 0] & (depth >= high)]
    assert near[:, 1].mean() < far[:, 1].mean()  # violet to yellow


@torch.no_grad()
def test_ways_to_save_work_change_what_they_say(tab, default):
    model, camera = default
    exact, coarse = tab.render(camera)["image"], tab.render(camera, textureScale=0.5)["image"]
    # A pixel's own texel has 9,999 of 10,000 parts.
    assert (coarse[::2, ::2] - exact[::2, ::2]).abs().max() < 1e-3
    assert 1e-4 < (coarse - exact).abs().max()
    # Light second hits have their plain colours.
    out = model.render(camera)
    base = out.intermediates.projection.records[:, 3, :3][out.ids[..., 1].clamp_min(0).long()]
    factors = out.intermediates.factors
    assert factors is not None
    second = (base * factors - out.colors[..., 1, :]) * out.weights[..., 1:]
    expected = out.image + second * (out.ids[..., 1:] >= 0)
    image = tab.render(camera, leastWeight=1.0)["image"]
    assert_close(image, expected, kind="value", name="image", allow_flips=FLIPS)


def test_an_empty_scene_shows_the_background(tab):
    model, camera = web_model()
    empty = nw.Surfels({name: value[:0] for name, value in model.surfels.state_dict().items()})
    bare = nw.Model(empty, None, options=RenderOptions(background=(0.25, 0.5, 1.0)))
    tab.load(bare)
    out = tab.render(camera, "ids")
    assert out["entries"] == 0 and (out["ids"] == -1).all()
    assert torch.equal(out["image"], torch.tensor([0.25, 0.5, 1.0]).expand_as(out["image"]))


def test_damaged_files_give_one_line(tab):
    for name, content in damaged().items():
        tab.files["damaged.nxw"] = content
        message = tab.value(READ, f"damaged.nxw?{json.dumps(name)}")
        assert message.startswith("SceneError: scene file: ") and "\n" not in message, (name, message)
