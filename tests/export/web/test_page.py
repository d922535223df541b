import html
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import nexwarp as nw
from nexwarp.export.baked_scene import ATLAS_FILE, BAKED_FILE
from nexwarp.export.web.export import static_files
from nexwarp.export.web.scene_file import SCENE_FILE
from tests.export.web import support
from tests.export.web.support import CHROMIUM, FINISHED, POSE, URL, PageTab, psnr

DRAW = """async camera => {
    const renderer = nexwarp.renderer;
    nexwarp.state = "failed"; // stops the page's own frames
    Object.assign(nexwarp.canvas, {width: camera.width, height: camera.height});
    await renderer.render(camera);
    return [Array.from(await renderer.read("image")), await renderer.pick(32.5, 24.5)];
}"""
TARGET = "(p => p.eye.map((x, i) => x + p.distance * p.axes().forward[i]))(nexwarp.pose)"

pytestmark = [pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine"), pytest.mark.timeout(300)]


def test_the_baked_scene_in_the_page_is_the_one_of_python(tab, site, model, cameras, tmp_path):
    for name in (BAKED_FILE, ATLAS_FILE):
        (tmp_path / name).write_bytes(site[name])
    read = nw.load_baked(tmp_path)
    tab.open("?renderer=baked")
    picked = 0
    # Far away too: surfels are blurred beyond their detail limits.
    shift = torch.eye(4)
    shift[2, 3] = 6.0
    far = replace(cameras["2.png"], viewmat=shift @ cameras["2.png"].viewmat)
    # And with a near plane amid the surfels.
    depths = model.render(cameras["1.png"]).depths[..., 0].detach()
    cut = replace(cameras["1.png"], near=depths[depths > 0].median().item())
    for camera in (cameras["1.png"], cameras["3.png"], far, cut):
        drawn = tab.value(DRAW, support.entry_of(camera))
        image = torch.tensor(drawn[0]).reshape(camera.height, camera.width, 4)[..., :3]
        with torch.no_grad():
            expected = read.render(camera).clamp(0, 1)
            out = model.render(camera)
        # Pixels where the near plane cuts a surfel may differ; without the plane, the picture has under 20 dB.
        assert psnr(image, expected) > (35 if camera is cut else 46)
        if out.alpha[24, 32] > 0.11 and camera is not cut:
            assert drawn[1]["depth"] == pytest.approx(float(out.median_depth[24, 32]), rel=1e-3)
            picked += 1
    assert picked
    assert not tab.errors


def test_controls_modes_links_and_sizes(tab):
    tab.open("?renderer=baked")
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
    assert tab.value(TARGET) == pytest.approx(tab.value(TARGET.replace("(nexwarp.pose)", "(nexwarp.start_)")), abs=1e-4)
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
    own = [url for url in tab.requests if not url.startswith((URL, "data:", "blob:"))]
    assert not own, "no request leaves the page's own origin"


@pytest.mark.parametrize("renderer", ["baked", "webgpu"])
def test_each_renderer_turns_to_the_surfel_of_a_double_click(open_tab, renderer):
    tab = open_tab(webgpu=True)
    tab.open(f"?renderer={renderer}")
    assert {"baked": "baked", "webgpu": "neural"}[renderer] in tab.page.inner_text("#status")
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
    tab.wait(f"Math.hypot(...{TARGET}.map((x, i) => x - {position}[i])) < 0.01 * Math.hypot(...{position})")
    # Software draws the baked scene faster: without a wish, the page takes it.
    tab.open()
    assert "baked, WebGL · the default on this kind" in tab.page.inner_text("#status") and not tab.errors


def test_the_surfels_colours_are_shown_before_the_texture(tab):
    tab.page.add_init_script("""
        const request = window.fetch, wait = new Promise(done => (window.release = done));
        window.fetch = async (...all) => (String(all[0]).includes("atlas") && (await wait), request(...all));
    """)
    tab.page.goto(f"{URL}?renderer=baked")
    early = FINISHED.replace("ready", "preview")
    tab.wait(early)
    preview = tab.picture()
    tab.value("nexwarp.setMode('plain')")
    tab.wait(early)
    assert np.array_equal(tab.picture(), preview) and preview.std() > 0.05
    tab.value("nexwarp.setMode('image')")
    tab.value("release()")
    tab.wait(FINISHED)
    assert np.abs(tab.picture() - preview).mean() > 0.01 and not tab.errors


# The adapter calls itself a large GPU; its devices know better. A frame is said to take so long, and drawn once.
LARGE_GPU = """
    const request = navigator.gpu.requestAdapter.bind(navigator.gpu);
    const own = (real, name) => typeof real[name] === "function" ? real[name].bind(real) : real[name];
    const get = (real, name) => name === "info" ? {vendor: "nvidia", architecture: "lovelace"} : own(real, name);
    navigator.gpu.requestAdapter = async wish => new Proxy(await request(wish), {get});
"""
TIMED = """milliseconds => {
    const {renderer} = nexwarp, render = renderer.render.bind(renderer);
    let drawn = null;
    renderer.render = async (...all) => ({...(drawn ??= await render(...all)), milliseconds});
    Object.assign(nexwarp.pacing, {scale: 0.5, times: [], measured: 0});
}"""


def turn(tab: PageTab) -> None:
    """Turn the scene for some thirty frames, and the page's measurement is over."""
    tab.value("nexwarp.act('t')")
    tab.wait("nexwarp.pacing.framesPerSecond !== null && !nexwarp.measuring")
    tab.value("nexwarp.act('t')")


def test_the_frame_rate_chooses_the_renderer_unless_a_person_does(open_tab):
    tab = open_tab(webgpu=True, reduced_motion="no-preference")
    tab.page.add_init_script(LARGE_GPU)
    status = tab.page.locator("#status")
    for milliseconds, expected in ((20, "neural, WebGPU"), (200, "baked, WebGL · since the neural texture had")):
        tab.open()
        assert "neural" in status.text_content()
        pose = tab.value(POSE)
        tab.value(TIMED, milliseconds)
        turn(tab)
        tab.wait(f"document.getElementById('status').textContent.includes('{expected}')")
        tab.wait(FINISHED)
        assert tab.value(POSE) != pose
    assert tab.picture().std() > 0.05
    # A person's choice holds. Where it cannot be had, the page says so, and goes on.
    tab.page.click("#more")
    tab.page.get_by_label("Renderer").select_option("neural")
    tab.wait("document.getElementById('status').textContent.includes('neural, WebGPU')")
    tab.wait(FINISHED)
    assert not tab.value("nexwarp.measuring") and tab.page.input_value("#renderer") == "webgpu"
    files = tab.files
    tab.files = {name: data for name, data in files.items() if name != BAKED_FILE}
    tab.page.get_by_label("Renderer").select_option("baked")
    tab.wait(f"document.getElementById('announce').textContent.includes('{BAKED_FILE}')")
    tab.value("nexwarp.pose = nexwarp.pose.turned(0.1, 0, false)")
    tab.wait(FINISHED)
    assert "neural" in status.text_content()
    assert all("404" in error for error in tab.errors)
    # And when the page is loaded again.
    tab.files = files
    tab.page.get_by_label("Renderer").select_option("baked")
    tab.wait("document.getElementById('status').textContent.includes('baked, WebGL')")
    tab.page.reload()
    tab.wait(FINISHED)
    assert "baked" in status.text_content() and tab.page.input_value("#renderer") == "baked"
    assert not tab.value("nexwarp.measuring")


@pytest.mark.parametrize("renderer", ["baked", "webgpu"])
def test_pictures_embeds_and_turning(open_tab, renderer):
    tab = open_tab(webgpu=True, permissions=["clipboard-read", "clipboard-write"], reduced_motion="no-preference")
    page = tab.page
    page.goto(f"{URL}?renderer={renderer}&turn")
    tab.wait("globalThis.nexwarp?.state === 'ready' && nexwarp.frames > 0")
    pose = tab.value(POSE)
    tab.wait(f"Math.abs(nexwarp.pose.yaw - {pose[3]}) > 0.05")
    assert tab.value(TARGET) == pytest.approx(tab.value(TARGET.replace("(nexwarp.pose)", "(nexwarp.start_)")), abs=1e-3)
    page.get_by_role("button", name="Settings").click()
    assert page.get_by_label("Turn by itself").is_checked()
    page.get_by_label("Turn by itself").click()
    tab.wait(FINISHED)
    with page.expect_download() as download:
        page.get_by_role("button", name="Save a picture").click()
    saved = np.asarray(Image.open(download.value.path()).convert("RGB")) / 255
    assert download.value.suggested_filename == "nexwarp.png"
    assert np.abs(saved - tab.picture().clip(0, 1)).max() < 0.51 / 255 and saved.std() > 0.05
    page.get_by_role("button", name="Copy an embed").click()
    tab.wait("document.getElementById('announce').textContent === 'The HTML is copied.'")
    copied = tab.value("navigator.clipboard.readText()")
    address = re.fullmatch(r'<iframe src="([^"]+)" width=.*></iframe>', copied)
    assert address and html.unescape(address[1]) == tab.value("location.href")
    assert f"?renderer={renderer}&turn#eye=" in html.unescape(address[1]) and not tab.errors


def test_touch_on_a_phone(open_tab):
    tab = open_tab(360, 640, has_touch=True, is_mobile=True, device_scale_factor=1)
    tab.open()  # no WebGPU in this browser: the page chooses the baked scene
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


@pytest.mark.parametrize("size", [(390, 844), (1280, 800)])
def test_the_subject_fits_from_side_to_side(open_tab, site, size):
    """A narrow window shows the subject, or the photo if that is narrower, unless that takes more than 1 / 0.4 of its
    height; no window shows less than the photo's height."""
    tab = open_tab(*size)
    good = site[BAKED_FILE]
    header = support.header_of(good)
    wide = [{**camera, "width": 2 * camera["width"]} for camera in header["cameras"]]
    for camera in wide:
        camera["K"] = [*camera["K"][:2], 2 * camera["K"][2], camera["K"][3]]
    photo = wide[header["start"]]
    across, along = photo["width"] / 2 / photo["K"][0], photo["height"] / 2 / photo["K"][1]
    depth = np.array(photo["viewmat"]).reshape(4, 4)[2] @ [*header["center"], 1.0]
    for subject in (along / 2, along * 1.1, across * 2):
        tab.files = {**site, BAKED_FILE: support.rebuilt(good, cameras=wide, radius=depth * subject)}
        tab.open("?renderer=baked")
        pose = "nexwarp.pose.camera(nexwarp.canvas.width, nexwarp.canvas.height, 1)"
        width, height, fx, fy = tab.value(f"(c => [c.width, c.height, c.K[0], c.K[1]])({pose})")
        assert (width, height) == size
        half = min(max(subject, along), across)  # width to show, in tangents
        expected = max(along, min(half * height / width, along / 0.4))
        assert height / 2 / fy == pytest.approx(expected, rel=1e-5) and fx == pytest.approx(fy, rel=1e-5)
    assert not tab.errors


def inflated(content: bytes) -> bytes:
    """A baked scene whose sections promise 2^24 surfels of deflated zeros, 3 GB."""
    header = support.header_of(content)
    for section in header["sections"]:
        section["shape"] = [2**24 if n == header["surfels"] else n for n in section["shape"]]
        section["encoding"] = "deflate"
    return support.rebuilt(content, surfels=2**24, sections=header["sections"])


def test_damaged_files_give_one_line(tab, site):
    """What scenes have in common with baked ones is tried in test_webgpu.py."""
    good = site[BAKED_FILE]
    picture = {"file": "../x", "width": 4, "height": 4, "scale": 1}
    for file, content, words in (
        (BAKED_FILE, good[:50], "the file ends before"),
        (BAKED_FILE, b"GIF89a" + good[6:], "expected NXWBAKED at the start"),
        (BAKED_FILE, support.rebuilt(good, surfels=41), "expected the sections that the header describes"),
        (BAKED_FILE, support.rebuilt(good, atlas=picture), "atlas: expected a picture's file"),
        (BAKED_FILE, support.rebuilt(good, radius=0), "radius: expected a number above 0"),
        (BAKED_FILE, support.rebuilt(good, sh_ranges=[1]), "sh_ranges: expected three numbers"),
        (ATLAS_FILE, b"no picture", "expected a picture"),
        (BAKED_FILE, inflated(good), "expected sections that unpack to at most 134"),
        (BAKED_FILE, None, "WebGPU"),  # there is no baked scene: what is missing is WebGPU
    ):
        tab.files = {name: data for name, data in {**site, file: content}.items() if data is not None}
        tab.page.goto(URL)
        tab.wait("globalThis.nexwarp && nexwarp.state === 'failed'")
        assert words in tab.message and "\n" not in tab.message, (words, tab.message)
        assert not tab.page.is_visible("#loading")


def test_the_live_demo_of_the_documentation(tab):
    folder = Path(__file__).parents[3] / "docs" / "demo_page"
    files = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert sum(map(len, files.values())) < 3e6
    tab.files = {**static_files(), **files}
    tab.open("?renderer=baked")
    assert tab.picture().std() > 0.1 and not tab.errors
    header, _ = support.read_sections(files[SCENE_FILE])
    assert header["surfels"] == tab.value("nexwarp.renderer.surfels")
