"""The viewer in a browser."""

import io
import json
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from nexwarp.run.folder import keep_camera_path
from nexwarp.viewer.session import Session
from nexwarp.viewer.world import camera_to_world
from tests.viewer.support import serving, wait_for

pytestmark = pytest.mark.usefixtures("one_torch_thread", "few_places")


PAGE = b"<!doctype html><title>scene</title>"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def record_and_save(page: Any, session: Session, folder: Path) -> None:
    """Add two views to a path, save it and a screenshot; what the browser gets is what the run keeps."""
    assert session.viewpoint is not None
    page.get_by_role("tab", name="Record").click()
    page.get_by_role("button", name="Add this view").click()
    wait_for(lambda: len(session.keyframes) == 1)
    session.jump("train/4.png")
    expected = camera_to_world(session.cameras["train/4.png"])
    wait_for(lambda: session.viewpoint is not None and np.allclose(session.viewpoint.pose, expected, atol=1e-3))
    page.get_by_role("button", name="Add this view").click()
    wait_for(lambda: len(session.keyframes) == 2)
    with page.expect_download() as path:
        page.get_by_role("button", name="Save path").click()
    saved = json.loads(Path(path.value.path()).read_text())
    assert len(saved["camera_path"]) == 180 and (saved["render_width"], saved["render_height"]) == (64, 48)
    assert json.loads((folder / "camera_path_1.json").read_text()) == saved
    with page.expect_download() as shot:
        page.get_by_role("button", name="Save screenshot").click()
    with Image.open(shot.value.path()) as png:
        assert png.format == "PNG" and png.height == 1080
        assert png.width == pytest.approx(1080 * session.viewpoint.width / session.viewpoint.height, abs=1)
    with page.expect_download() as download:
        page.get_by_role("button", name="Download as web page").click()
    assert Path(download.value.path()).read_bytes() == PAGE and download.value.suggested_filename == "scene.html"


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
@pytest.mark.timeout(180)
def test_in_a_browser(model, tmp_path, monkeypatch):
    api = pytest.importorskip("playwright.sync_api")
    errors: list[str] = []
    with (
        serving(model, save_path=lambda content: keep_camera_path(tmp_path, content), make_page=lambda: PAGE) as viewer,
        api.sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": 900, "height": 700})
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(viewer.url)
        page.get_by_text("nexwarp · nexwarp").wait_for()
        wait_for(lambda: len(viewer.sessions) == 1)
        (session,) = viewer.sessions.values()

        sent: list[np.ndarray] = []
        show = session.client.scene.set_background_image

        def keep_and_show(pixels: np.ndarray, **arguments: Any) -> None:
            sent.append(pixels)
            show(pixels, **arguments)

        monkeypatch.setattr(session.client.scene, "set_background_image", keep_and_show)
        session._changed()  # one more picture: the first may have been sent before

        def differ(a: np.ndarray, b: np.ndarray) -> float:
            return float(np.abs(a - b).mean())

        def settled() -> np.ndarray:
            """The browser's picture left of the panel, once it is the finest that was sent; a busy browser is late."""
            end = time.monotonic() + 60.0
            while True:
                wait_for(lambda: session.drawn_version == session.version and session.drawn_scale == 1.0)
                file = page.screenshot(clip={"x": 20, "y": 250, "width": 450, "height": 430})
                shot = np.asarray(Image.open(io.BytesIO(file)).convert("RGB")).astype(int)
                picture = sent[-1]
                is_fine = picture.shape[:2] == (700, 900)  # a coarser one has followed if the window changed meanwhile
                if is_fine and differ(shot, picture[250:680, 20:470].astype(int)) < 3:  # JPEG
                    return shot
                assert time.monotonic() < end, "the browser shows another picture than the last one sent"
                page.wait_for_timeout(100)

        image = settled()
        assert image.std() > 10, "a frame has arrived"
        page.get_by_role("combobox").first.click()
        page.get_by_role("option", name="ids", exact=True).click()
        wait_for(lambda: session.settings.mode == "ids")
        assert differ(settled(), image) > 10, "the mode changes the picture"
        page.get_by_role("combobox").first.click()
        page.get_by_role("option", name="image", exact=True).click()
        wait_for(lambda: session.settings.mode == "image")
        again = settled()
        assert differ(again, image) < 2, "and back"
        slider = page.get_by_role("slider", name="K").or_(page.get_by_role("slider").nth(0))
        slider.first.focus()
        page.keyboard.press("Home")
        wait_for(lambda: session.settings.max_hits == 0)
        assert differ(settled(), again) > 1, "the slider changes the picture"

        page.mouse.move(200, 450)
        page.mouse.down()
        page.mouse.move(320, 430, steps=5)
        page.mouse.up()
        home = session.home.pose
        wait_for(lambda: session.viewpoint is not None and not np.allclose(session.viewpoint.pose, home, atol=1e-3))
        record_and_save(page, session, tmp_path)
        browser.close()
        wait_for(lambda: not viewer.sessions)
    assert not errors, errors


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
@pytest.mark.slow
@pytest.mark.timeout(180)
def test_a_browser_carries_the_token_from_the_page_to_the_websocket(model):
    api = pytest.importorskip("playwright.sync_api")
    with serving(model, host="0.0.0.0") as viewer, api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        own = viewer.url.partition("?")[0]
        stranger = browser.new_context().new_page()
        answer = stranger.goto(own)
        assert answer is not None and answer.status == 403 and "needs its token" in stranger.content()

        page = browser.new_context().new_page()
        page.goto(viewer.url)
        wait_for(lambda: len(viewer.sessions) == 1)
        page.reload()
        again = page.context.new_page()
        again.goto(own)  # another tab has the cookie
        again.get_by_text("nexwarp · nexwarp").wait_for()
        wait_for(lambda: len(viewer.sessions) == 2)
        assert "token" not in page.evaluate("document.cookie"), "no script reads it"
        foreign = page.context.new_page()
        opened = foreign.evaluate(CONNECT, viewer.url.replace("http", "ws"))
        assert opened == "refused" and len(viewer.sessions) == 2
        browser.close()


CONNECT = """url => new Promise(done => {
    const socket = new WebSocket(url, "viser-v1");
    socket.onopen = () => done("connected");
    socket.onerror = () => done("refused");
})"""
