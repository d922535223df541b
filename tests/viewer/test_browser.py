import io
import time
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nexwarp.viewer.world import surface_point
from tests.export.web.support import CHROMIUM, FLAGS
from tests.viewer.support import serving, wait_for

WIDTH, HEIGHT = 640, 500  # of the window, whose right the panel hides


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
@pytest.mark.timeout(180)
def test_in_a_browser(model, monkeypatch):
    api = pytest.importorskip("playwright.sync_api")
    errors: list[str] = []
    with (
        serving(model, measured=lambda points, _: [f"measured {len(points)}"]) as viewer,
        api.sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(viewer.url)
        page.get_by_text("nexwarp · nexwarp").wait_for()
        wait_for(lambda: len(viewer.sessions) == 1)
        (session,) = viewer.sessions.values()

        sent: list[np.ndarray] = []  # as JPEG keeps them
        show = session.client.scene.set_background_image

        def keep_and_show(pixels: np.ndarray, jpeg_quality: int, **arguments: Any) -> None:
            file = io.BytesIO()
            Image.fromarray(pixels).save(file, "JPEG", quality=jpeg_quality)
            sent.append(np.asarray(Image.open(file)))
            show(pixels, jpeg_quality=jpeg_quality, **arguments)

        monkeypatch.setattr(session.client.scene, "set_background_image", keep_and_show)
        session._changed()  # draws the current view again, now kept

        def differ(a: np.ndarray, b: np.ndarray) -> float:
            return float(np.abs(a - b).mean())

        def stretched(pixels: np.ndarray) -> np.ndarray:
            """A picture at the window's size: close to the surfels the finest one is smaller."""
            return np.asarray(Image.fromarray(pixels).resize((WIDTH, HEIGHT), Image.Resampling.BILINEAR))

        def settled() -> np.ndarray:
            """The picture that the browser shows left of the panel, once it is the finest one of the current view."""
            end = time.monotonic() + 60.0  # a browser may show a picture long after it was sent
            while time.monotonic() < end:
                file = page.screenshot(clip={"x": 20, "y": 180, "width": 270, "height": 300})
                shot = np.asarray(Image.open(io.BytesIO(file)).convert("RGB")).astype(int)
                is_drawn = session.drawn_version == session.version and session.drawn_scale == 1.0
                if is_drawn and differ(shot, stretched(sent[-1])[180:480, 20:290]) < 1:
                    return shot
                page.wait_for_timeout(100)
            pytest.fail("the browser does not show the last picture sent")

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

        page.mouse.move(150, 330)
        page.mouse.down()
        page.mouse.move(240, 315, steps=5)
        page.mouse.up()
        settled()
        assert session.viewpoint is not None
        assert not np.allclose(session.viewpoint.pose, session.home.pose, atol=1e-3), "dragging moves the camera"
        page.get_by_role("tab", name="Edit").click()
        page.get_by_label("Measure").click()

        def is_hit(x: int, y: int) -> bool:
            """Whether a surface is there, and beside it."""
            around = [((x + shift) / WIDTH, (y + shift) / HEIGHT) for shift in (-6, 0, 6)]
            assert session.viewpoint is not None
            return all(surface_point(model, session.viewpoint, place, 0.01) is not None for place in around)

        hits = [(x, y) for y in range(190, 480, 20) for x in range(30, 290, 20) if is_hit(x, y)]
        assert len(hits) > 1
        for count, (x, y) in enumerate((hits[0], hits[-1]), 1):
            page.mouse.click(x, y)
            page.get_by_text(f"measured {count}").wait_for()
        assert session.measure is not None
        (camera,) = session.viewpoint.bands(1.0, 0.01, torch.zeros(0, dtype=torch.float64))
        pixels, _ = camera.project(torch.from_numpy(session.measure.points))
        np.testing.assert_allclose(pixels * WIDTH / camera.width, (hits[0], hits[-1]), atol=1.1)
        page.get_by_role("tab", name="Record").click()
        with page.expect_download() as shot:
            page.get_by_role("button", name="Save screenshot").click()
        with Image.open(shot.value.path()) as png:
            assert png.format == "PNG" and png.height == 1080
        browser.close()
        wait_for(lambda: not viewer.sessions)
    assert not errors, errors
