"""The WebGPU renderer in Chromium, on SwiftShader, against `Model.render`; skipped without Chromium."""

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.export.web.export import static_files
from nexwarp.export.web.program import Program, shader
from nexwarp.export.web.renderer import SHARING
from nexwarp.export.web.scene_data import SceneData
from nexwarp.export.web.scene_file import encode_scene
from nexwarp.export.web.scene_reader import read_header
from tests.export.web.support import CHROMIUM, FLAGS, named_cameras, psnr, serving, web_model
from tests.export.web.test_scene_file import damaged
from tests.tolerances import FLIPS, WEB_PSNR, assert_same_ids

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine"),
    pytest.mark.timeout(300),
]
PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<script type="importmap">{"imports": {"nexwarp/": "./"}}</script>
<canvas id="canvas" width="37" height="27"></canvas>
<script type="module">
import { Renderer } from "nexwarp/renderer.js";
import { SceneReader, fromHalf, toHalf } from "nexwarp/scene.js";
import * as program from "nexwarp/program.js";
window.nexwarp = { Renderer, SceneReader, fromHalf, toHalf, program };
</script>"""
RENDER = """async ([file, camera, canvas]) => {
    const stages = [];
    const target = canvas ? document.getElementById("canvas") : null;
    const renderer = await nexwarp.Renderer.create(target, { onStage: (stage) => stages.push(stage) });
    await renderer.load(file);
    const frame = await renderer.render(camera);
    const base64 = (array) => btoa(String.fromCharCode(...new Uint8Array(array.buffer)));
    const image = base64(await renderer.read("image"));
    const ids = base64(await renderer.read("ids"));
    const result = { stages, frame, image, ids, info: renderer.info, picked: await renderer.pick(18, 13, camera) };
    if (canvas) {
        result.shown = [...target.getContext("2d").getImageData(0, 0, 37, 27).data];
    }
    renderer.destroy();
    return result;
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


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Iterator[tuple[Any, Path, list[str]]]:
    """A browser's page with the modules, the folder that it is served from, and its errors."""
    api = pytest.importorskip("playwright.sync_api", reason="drives Chromium (extra `dev`)")
    folder = tmp_path_factory.mktemp("page")
    (folder / "shaders").mkdir()
    for name, content in static_files().items():
        (folder / name).write_bytes(content)
    (folder / "index.html").write_text(PAGE)
    errors: list[str] = []
    with serving(folder) as url, api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        opened = browser.new_page()
        opened.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        opened.on("pageerror", lambda error: errors.append(str(error)))
        opened.goto(url)
        opened.wait_for_function("window.nexwarp")
        yield opened, folder, errors
        browser.close()


def entry_of(camera: nw.Camera) -> dict[str, object]:
    """A camera as the page takes it."""
    K = [camera.fx, camera.fy, camera.cx, camera.cy]
    size = {"width": camera.width, "height": camera.height, "near": camera.near}
    return {"viewmat": camera.viewmat.flatten().tolist(), "K": K, **size}


@pytest.mark.parametrize(
    ("quality", "degree"),
    [("full", 3), ("full", 6), *(pytest.param("quantised", d, marks=pytest.mark.slow) for d in (3, 6))],
)
def test_the_picture_is_that_of_the_model(page, quality, degree):
    opened, folder, errors = page
    model, camera = web_model(sh_degree=degree, options=nw.RenderOptions(sh_degree=degree))
    with torch.no_grad():
        expected = model.render(camera)
    (folder / "scene.nxw").write_bytes(encode_scene(model, named_cameras(camera), quality=quality, poster=b"picture"))
    result = opened.evaluate(RENDER, ["scene.nxw", entry_of(camera), quality == "full"])
    assert result["stages"] == ["header", "geometry", "grid", "done"]
    assert result["info"]["textured"] and result["info"]["surfels"] == len(model.surfels)
    size = (camera.height, camera.width)
    image = np.frombuffer(base64.b64decode(result["image"]), np.float32).reshape(*size, 4)[..., :3]
    assert psnr(image, expected.image.numpy()) > WEB_PSNR[quality]
    if quality == "full":
        ids = np.frombuffer(base64.b64decode(result["ids"]), np.int32).reshape(expected.ids.shape)
        assert_same_ids(torch.from_numpy(ids.copy()), expected.ids, name="ids", allow_flips=FLIPS)
        shown = np.array(result["shown"], np.float32).reshape(*size, 4)[..., :3] / 255
        assert np.abs(shown - image.clip(0, 1)).max() < 1.1 / 255
        assert result["picked"]["id"] == ids[13, 18, 0]
        assert result["picked"]["depth"] == pytest.approx(expected.depths[13, 18, 0].item(), rel=1e-4)
    assert errors == []


def test_constants_and_shaders_are_those_of_python(page):
    opened, _, _ = page
    cases: list[dict[str, Any]] = [
        {},
        {"sh_degree": 6, "options": nw.RenderOptions(sh_degree=6)},
        {"features": 4, "residual": False, "hidden_layers": 0, "texture_degree": 1},
    ]
    for case in cases:
        model, camera = web_model(**case)
        scene = SceneData.of(model)
        header, _ = read_header(encode_scene(model, named_cameras(camera)))
        program = Program.of(scene, SHARING, half=False, unrolled=True, uniform=True)
        names = ["common", "project", "lists", "collect", "shade", "mlp", "compose", f"features{program.features}"]
        texts = {name: shader(name) for name in names}
        found = opened.evaluate(
            """([header, texts, features]) => {
                const constants = nexwarp.program.constantsOf(header);
                const source = (name) => nexwarp.program.sourceOf(name, constants, texts, features, false, true);
                return [constants, source("shade"), source("collect")];
            }""",
            [header, texts, program.features],
        )
        assert found == [program.constants, program.source("shade"), program.source("collect")]


def test_half_precision_numbers_are_those_of_numpy(page):
    opened, _, _ = page
    halves = np.arange(0, 2**16, 7, dtype=np.uint16)
    values = halves.view(np.float16)
    finite = halves[np.isfinite(values)]
    numbers = opened.evaluate("(halves) => halves.map(nexwarp.fromHalf)", finite.tolist())
    np.testing.assert_array_equal(numbers, finite.view(np.float16).astype(np.float64))
    rng = np.random.default_rng(0)
    floats = (rng.standard_normal(2000) * 10.0 ** rng.integers(-9, 5, 2000)).astype(np.float32)
    bits = opened.evaluate("(floats) => floats.map(nexwarp.toHalf)", floats.astype(float).tolist())
    np.testing.assert_array_equal(np.array(bits, np.uint16), floats.astype(np.float16).view(np.uint16))


def test_damaged_files_give_one_line(page):
    opened, folder, _ = page
    for name, content in damaged().items():
        (folder / "damaged.nxw").write_bytes(content)
        message = opened.evaluate(READ, f"damaged.nxw?{json.dumps(name)}")
        assert message.startswith("SceneError: scene file: ") and "\n" not in message, (name, message)
