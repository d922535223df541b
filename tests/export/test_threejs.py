import base64
import io
import zipfile
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import nexwarp as nw
from nexwarp.cameras.similarity import upright
from nexwarp.export.glb import bake_cards, save_glb
from tests.export.web.support import CHROMIUM, FLAGS, URL, Tab, psnr, ring
from tests.scenes import make_surfels, make_texture, random_scene

BACKGROUND = (0.1, 0.2, 0.3)
NEAR, FAR = 0.01, 1000.0
DRAW = """async ([width, height, view, projection, background]) => {
    const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
    renderer.setSize(width, height);
    renderer.outputEncoding = THREE.sRGBEncoding;
    const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera();
    scene.background = new THREE.Color().setRGB(...background);
    scene.add((await new THREE.GLTFLoader().loadAsync("scene.glb")).scene);
    camera.matrixAutoUpdate = false;
    camera.matrix.set(...view).invert();
    camera.matrixWorldNeedsUpdate = true;
    camera.projectionMatrix.set(...projection);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    renderer.render(scene, camera);
    return renderer.domElement.toDataURL("image/png");
}"""


def three() -> bytes:
    """A page with three.js and its GLTFLoader, which draws nothing by itself."""
    trimesh = pytest.importorskip("trimesh", reason="trimesh (extra `glb`)")
    archive = resources.files(trimesh) / "resources" / "templates" / "viewer.zip"
    with archive.open("rb") as file, zipfile.ZipFile(file) as content:
        page = content.read("viewer.html.template").decode()
    assert page.count("init();</script>") == 1
    return page.replace("init();</script>", "</script>").encode()


def drawn(glb: bytes, camera: nw.Camera, turn: np.ndarray) -> torch.Tensor:
    """What three.js draws of a file (H, W, 3), whose frame `turn` (3, 3) leads to from the camera's."""
    api = pytest.importorskip("playwright.sync_api")
    view = np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.viewmat.double().numpy()
    view[:3, :3] = view[:3, :3] @ turn.T
    width, height = camera.width, camera.height
    depth = [-(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)]
    projection = [[2 * camera.fx / width, 0, 1 - 2 * camera.cx / width, 0]]
    projection += [[0, 2 * camera.fy / height, 2 * camera.cy / height - 1, 0], [0, 0, *depth], [0, 0, -1, 0]]
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        tab = Tab(browser, {"index.html": three(), "scene.glb": glb})
        tab.page.goto(URL)
        order = [width, height, view.ravel().tolist(), [x for row in projection for x in row], BACKGROUND]
        picture = base64.b64decode(tab.value(DRAW, order).partition(",")[2])
        assert not tab.errors
        browser.close()
    with Image.open(io.BytesIO(picture)) as image:
        return torch.from_numpy(np.array(image.convert("RGB"))).float() / 255


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
@pytest.mark.timeout(300)
def test_three_js_draws_what_is_read_back(tmp_path: Path) -> None:
    """Its tests of depth and alpha, its texture, and which way is up."""
    cameras = ring()
    model = nw.Model(make_surfels(random_scene(40, width=64, height=48, seed=3)), make_texture(residual=True))
    save_glb(tmp_path / "scene.glb", bake_cards(model, [*cameras.values()], steps=1), [*cameras.values()])
    read = nw.load_baked(tmp_path / "scene.glb")
    for camera in (cameras["0.png"], cameras["3.png"]):
        picture = drawn((tmp_path / "scene.glb").read_bytes(), camera, upright([*cameras.values()]))
        expected = read.render(camera, background=BACKGROUND).clamp(0, 1)
        assert psnr(picture, expected) > 30
        assert psnr(picture, torch.tensor(BACKGROUND).expand_as(picture)) < 15, "something is drawn"
