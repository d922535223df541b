"""The web page in a browser: loading, controls, links, touch, damaged files, and the baked scene against Python."""

import dataclasses
import functools
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.export.bake import bake as bake_model
from nexwarp.export.web import baked as baked_files
from nexwarp.export.web.export import page_files, static_files
from nexwarp.export.web.scene_file import SCENE_FILE
from nexwarp.model.detail_limits import DetailLimits
from nexwarp.model.exposures import Exposures
from tests.export.web.baked_support import ring
from tests.export.web.scene_reader import as_stored, read_sections
from tests.export.web.support import CHROMIUM, WEBGPU, Site
from tests.scenes import make_surfels, make_texture, random_scene

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
DRAWN = "nexwarp.state === 'ready' && nexwarp.frames > 0 && nexwarp.refined === 'full'"
FINISHED = f"{DRAWN} && !nexwarp.dirty && !nexwarp.drawing && !nexwarp.flight && !nexwarp.pacing.moving"
DRAW = """async camera => {
    const renderer = nexwarp.renderer;
    nexwarp.state = "failed"; // stops the page's own frames
    renderer.resize(camera.width, camera.height);
    await renderer.render(camera);
    return [Array.from(await renderer.read("image")), await renderer.pick(32.5, 24.5)];
}"""
POSE = "[...nexwarp.pose.eye, nexwarp.pose.yaw, nexwarp.pose.pitch, nexwarp.pose.distance]"

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine"),
    pytest.mark.usefixtures("one_torch_thread"),
    pytest.mark.timeout(300),
]


@pytest.fixture(scope="module")
def cameras() -> dict[str, nw.Camera]:
    return ring()


@pytest.fixture(scope="module")
def model(cameras) -> nw.Model:
    """A small model with everything that a page has to show: exposures, vignetting, detail limits."""
    surfels = make_surfels(random_scene(40, width=64, height=48, seed=3))
    gains = torch.linspace(-0.3, 0.3, len(cameras))[:, None].expand(-1, 3) * torch.tensor([1.0, 0.5, -0.5])
    exposures = Exposures.of(gains, list(cameras.values()), (-0.4, 0.1, 0.7))
    limits = DetailLimits(torch.full((40,), 0.01), torch.full((40,), 0.04))
    texture = make_texture(residual=True)
    with torch.no_grad():
        texture.grid.mul_(0.3)
    return nw.Model(surfels, texture, exposures, limits, nw.RenderOptions(background=(0.1, 0.2, 0.3)))


@pytest.fixture(scope="module")
def site(model, cameras) -> Iterator[Site]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baked_files, "bake_model", functools.partial(bake_model, steps=10))
        site = Site(page_files(model, cameras, title="Two & <three>"))
    with site:
        yield site


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


class Tab:
    """A page, and what it asked for and complained about."""

    def __init__(self, browser: Any, width: int = 200, height: int = 150, **options: Any) -> None:
        self.context = browser.new_context(viewport={"width": width, "height": height}, **options)
        self.page = self.context.new_page()
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))

    def wait(self, condition: str, seconds: float = 60.0) -> None:
        """Wait for a condition; the page's policy forbids what playwright's own wait needs."""
        for _ in range(int(seconds / 0.05)):
            if self.page.evaluate(condition):
                return
            self.page.wait_for_timeout(50)
        state = self.page.evaluate("globalThis.nexwarp ? nexwarp.state : 'no page'")
        raise AssertionError(f"{condition}: not within {seconds} s; {state}: {self.message} {self.errors}")

    def open(self, url: str) -> None:
        self.page.goto(url)
        self.wait(FINISHED)

    def value(self, expression: str) -> Any:
        return self.page.evaluate(expression)

    @property
    def message(self) -> str:
        return str(self.page.inner_text("#message"))

    def picture(self) -> np.ndarray:
        """The last frame (H, W, 3) in [0, 1]."""
        values = self.value(
            "nexwarp.renderer.read('image').then(x => [[nexwarp.canvas.height, nexwarp.canvas.width], Array.from(x)])"
        )
        return np.array(values[1], np.float32).reshape(*values[0], 4)[..., :3]


@pytest.fixture
def tab(browser) -> Iterator[Tab]:
    tab = Tab(browser)
    yield tab
    tab.context.close()


def test_the_baked_scene_in_the_page_is_the_one_of_python(tab, site, model, cameras):
    baked = as_stored(bake_model(model, list(cameras.values()), steps=10))
    tab.open(f"{site.url}?renderer=baked")
    picked = 0
    # Far away too: surfels are blurred beyond their detail limits.
    shift = torch.eye(4)
    shift[2, 3] = 6.0
    far = nw.Camera(shift @ cameras["2.png"].viewmat, cameras["2.png"].K, 64, 48)
    # And with a near plane amid the surfels.
    depths = model.render(cameras["1.png"]).depths[..., 0].detach()
    cut = dataclasses.replace(cameras["1.png"], near=depths[depths > 0].median().item())
    for camera in (cameras["1.png"], cameras["3.png"], far, cut):
        given = {
            "viewmat": camera.viewmat.flatten().tolist(),
            "K": [camera.fx, camera.fy, camera.cx, camera.cy],
            "width": camera.width,
            "height": camera.height,
            "near": camera.near,
        }
        drawn = tab.page.evaluate(DRAW, given)
        image = torch.tensor(drawn[0]).reshape(camera.height, camera.width, 4)[..., :3]
        with torch.no_grad():
            expected = (baked.render(camera) * model.exposures.factors(camera)).clamp(0, 1)
            psnr = -10 * (image - expected).square().mean().log10()
            out = model.render(camera)
        # Pixels where the near plane cuts a surfel may differ; without the plane, the picture has under 20 dB.
        assert psnr > (35 if camera is cut else 42), f"{psnr:.1f} dB"
        if out.alpha[24, 32] > 0.11 and camera is not cut:
            assert drawn[1]["depth"] == pytest.approx(float(out.median_depth[24, 32]), rel=1e-3)
            picked += 1
    assert picked
    assert not tab.errors


def test_controls_modes_links_and_sizes(tab, site):
    tab.open(f"{site.url}?renderer=baked")
    page = tab.page
    assert page.title() == "Two & <three>" and page.inner_text("h1") == "Two & <three>"
    start, image = tab.value(POSE), tab.picture()
    assert image.std() > 0.05, "something is drawn"
    page.mouse.move(100, 60)
    page.mouse.down()
    page.mouse.move(140, 50, steps=3)
    page.mouse.up()
    tab.wait(FINISHED)
    dragged = tab.value(POSE)
    assert np.abs(tab.picture() - image).mean() > 0.01, "dragging turns the scene"
    target = "(p => p.eye.map((x, i) => x + p.distance * p.axes().forward[i]))(nexwarp.pose)"
    assert tab.value(target) == pytest.approx(tab.value(target.replace("(nexwarp.pose)", "(nexwarp.start_)")), abs=1e-4)
    page.mouse.wheel(0, 200)
    tab.wait(f"nexwarp.pose.distance > {dragged[5]} * 1.2")
    page.keyboard.press("Home")
    tab.wait(f"!nexwarp.flight && Math.abs(nexwarp.pose.eye[0] - {start[0]}) < 1e-6")
    page.keyboard.press("v")
    before = tab.value(POSE)
    page.keyboard.press("w", delay=200)
    assert tab.value(POSE)[:3] != before[:3] and page.get_attribute("#fly", "aria-pressed") == "true"
    page.get_by_role("button", name="Next camera").click()
    tab.wait(FINISHED)
    assert tab.value("nexwarp.cameras[nexwarp.index].name") == "1.png"
    assert "1.png" in page.inner_text("#announce")

    page.get_by_role("button", name="Settings").click()
    image = tab.picture()
    page.get_by_label("Show").select_option("depth")
    tab.wait(FINISHED)
    assert np.abs(tab.picture() - image).mean() > 0.02, "the mode changes the picture"
    page.get_by_label("Show").select_option("image")
    page.get_by_label("Exposure of the photos").click()
    tab.wait(FINISHED)
    assert np.abs(tab.picture() - image).mean() > 0.01, "so does the exposure"
    page.set_viewport_size({"width": 150, "height": 180})
    tab.wait("nexwarp.canvas.width === 150 && nexwarp.canvas.height === 180")
    tab.wait(FINISHED)
    page.get_by_label("Show").select_option("normals")
    tab.wait("location.hash.includes('mode=normals')")
    pose = tab.value(POSE)
    page.reload()
    tab.wait(FINISHED)
    assert tab.value(POSE) == pytest.approx(pose, rel=1e-4, abs=1e-4), "a link keeps the camera"
    assert tab.value("nexwarp.mode") == "normals" and page.input_value("#mode") == "normals"

    assert not tab.errors
    own = [url for url in tab.requests if not url.startswith((site.url, "data:", "blob:"))]
    assert not own, "no request leaves the page's own origin"


@pytest.mark.parametrize("renderer", ["baked", "webgpu"])
def test_a_double_click_turns_to_the_surfel_there(browser, site, renderer):
    with browser.browser_type.launch(executable_path=CHROMIUM, args=[*FLAGS, *WEBGPU]) as other:
        tab = Tab(other)
        tab.open(f"{site.url}?renderer={renderer}")
        hits = tab.value("""(async () => {
            const {width, height} = nexwarp.canvas, hits = [];
            for (let y = 8; y < height; y += 16) for (let x = 8; x < width; x += 16) {
                const hit = await nexwarp.renderer.pick(x, y);
                if (hit) hits.push([x, y, ...hit.position]);
            }
            return hits;
        })()""")
        x, y, *position = max(hits, key=lambda hit: abs(hit[0] - 100) + abs(hit[1] - 75))
        tab.page.mouse.dblclick(x, y)
        # Picking waits for a frame, so the flight to the surfel may begin later.
        target = "(p => p.eye.map((x, i) => x + p.distance * p.axes().forward[i]))(nexwarp.pose)"
        tab.wait(f"Math.hypot(...{target}.map((x, i) => x - {position}[i])) < 0.01 * Math.hypot(...{position})")
        assert not tab.errors


def test_touch_on_a_phone(browser, site):
    tab = Tab(browser, 360, 640, has_touch=True, is_mobile=True, device_scale_factor=1)
    tab.open(site.url)  # no WebGPU in this browser: the page chooses the baked scene
    assert "baked" in tab.page.inner_text("#status")
    client = tab.context.new_cdp_session(tab.page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        at = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    start = tab.value(POSE)
    touch("touchStart", (150, 300))
    for x in (170, 200, 230):
        touch("touchMove", (x, 310))
    touch("touchEnd")
    turned = tab.value(POSE)
    assert turned[3] != start[3] and turned[5] == pytest.approx(start[5]), "one finger orbits"
    touch("touchStart", (150, 300), (210, 300))
    for x in (10, 20, 30):
        touch("touchMove", (150 - x, 300), (210 + x, 300))
    touch("touchEnd")
    assert tab.value(POSE)[5] == pytest.approx(start[5] / 2, rel=0.02), "two fingers zoom"
    tab.page.tap("#more")
    tab.wait(FINISHED)
    box = tab.page.locator("#settings").bounding_box()
    assert box["x"] >= 0 and box["x"] + box["width"] <= 360 and box["y"] > 0, "the settings fit on the screen"
    tools = tab.page.locator("#tools button:visible")
    assert all(tools.nth(i).bounding_box()["height"] >= 40 for i in range(tools.count()))
    assert not tab.errors
    tab.context.close()


def rebuilt(content: bytes, **changes: Any) -> bytes:
    """A baked scene with another header."""
    size = struct.unpack("<I", content[12:16])[0]
    text = json.dumps({**json.loads(content[16 : 16 + size]), **changes}).encode()
    return content[:12] + struct.pack("<I", len(text)) + text + content[16 + size :]


def inflated(content: bytes) -> bytes:
    """A baked scene whose sections promise 2^24 surfels of deflated zeros, 3 GB."""
    size = struct.unpack("<I", content[12:16])[0]
    header = json.loads(content[16 : 16 + size])
    for section in header["sections"]:
        section["shape"] = [2**24 if n == header["surfels"] else n for n in section["shape"]]
        section["encoding"] = "deflate"
    return rebuilt(content, surfels=2**24, sections=header["sections"])


def test_damaged_files_give_one_line(tab, site):
    """What scenes have in common with baked ones is tried in test_webgpu.py."""
    good = site.files[baked_files.BAKED_FILE]
    picture = {"file": "../x", "width": 4, "height": 4, "scale": 1}
    damaged: list[tuple[dict[str, bytes | None], str]] = [
        ({baked_files.BAKED_FILE: good[:50]}, "the file ends before"),
        ({baked_files.BAKED_FILE: b"GIF89a" + good[6:]}, "expected NXWBAKED at the start"),
        ({baked_files.BAKED_FILE: rebuilt(good, surfels=41)}, "expected the sections that the header describes"),
        ({baked_files.BAKED_FILE: rebuilt(good, atlas=picture)}, "atlas: expected a picture's file"),
        ({baked_files.BAKED_FILE: rebuilt(good, sh_ranges=[1])}, "sh_ranges: expected three numbers"),
        ({baked_files.ATLAS_FILE: b"no picture"}, "expected a picture"),
        ({baked_files.BAKED_FILE: inflated(good)}, "expected sections that unpack to at most 134"),
        ({baked_files.BAKED_FILE: None}, "WebGPU"),  # there is no baked scene: what is missing is WebGPU
    ]
    for files, words in damaged:
        kept = site.files
        site.files = {name: content for name, content in {**kept, **files}.items() if content is not None}
        tab.page.goto(site.url)
        tab.wait("globalThis.nexwarp && nexwarp.state === 'failed'")
        assert words in tab.message and "\n" not in tab.message, (words, tab.message)
        assert not tab.page.is_visible("#loading")
        site.files = kept


def test_the_live_demo_of_the_documentation(tab):
    folder = Path(__file__).parents[3] / "docs" / "demo_page"
    files = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert sum(map(len, files.values())) < 3e6
    with Site({**static_files(), **files}) as site:
        tab.open(f"{site.url}?renderer=baked")
        assert tab.picture().std() > 0.1 and not tab.errors
        header, _ = read_sections(files[SCENE_FILE])
        assert header["surfels"] == tab.value("nexwarp.renderer.info.surfels")


@pytest.mark.slow
def test_the_exact_renderer_in_the_page(browser, site):
    with browser.browser_type.launch(executable_path=CHROMIUM, args=[*FLAGS, *WEBGPU]) as other:
        tab = Tab(other, 160, 120)
        tab.open(f"{site.url}?renderer=webgpu")
        assert "exact" in tab.page.inner_text("#status")
        image = tab.picture()
        tab.page.keyboard.press("]")
        tab.wait(FINISHED)
        assert np.abs(tab.picture() - image).mean() > 0.01
        assert not tab.errors
        # Software draws the baked scene faster: without a wish, the page takes it.
        tab.open(site.url)
        assert "baked" in tab.page.inner_text("#status")
