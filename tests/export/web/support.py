"""A model for the web renderer, and a server of a page's files."""

import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import torch

import nexwarp as nw
from nexwarp.model.detail_limits import DetailLimits
from nexwarp.model.exposures import Exposures
from tests.scenes import make_camera, make_surfels, random_scene

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WEBGPU = ["--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader"]
KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}


def web_model(
    count: int = 60,
    *,
    features: int = 2,
    residual: bool = True,
    hidden_layers: int = 2,
    texture_degree: int = 3,
    sh_degree: int = 3,
    options: nw.RenderOptions | None = None,
) -> tuple[nw.Model, nw.Camera]:
    """Return a small model with texture, exposures with a falloff and detail limits, and a camera.

    Values of the texture are exact in half precision, as those of model files are.
    """
    scene = random_scene(count, width=37, height=27, sh_degree=sh_degree)
    generator = torch.Generator().manual_seed(3)
    texture = nw.NeuralTexture(
        levels=3,
        table_size=2**9,
        features=features,
        min_resolution=1.0,
        max_resolution=8.0,
        width=12,
        hidden_layers=hidden_layers,
        sh_degree=texture_degree,
        residual=residual,
    )
    with torch.no_grad():
        for parameter in texture.parameters():
            parameter.copy_((0.4 * torch.randn(parameter.shape, generator=generator)).half().float())
    camera = make_camera(scene)
    viewmats = [camera.viewmat.detach().clone() for _ in range(4)]
    for i, viewmat in enumerate(viewmats):
        viewmat[0, 3] += 0.3 * i
    cameras = [nw.Camera(viewmat, camera.K, camera.width, camera.height) for viewmat in viewmats]
    gains = torch.tensor([[0.1, 0.0, -0.1], [0.0, 0.05, 0.0], [-0.1, 0.0, 0.1], [0.05, 0.0, 0.0]])
    exposures = Exposures.of(gains, cameras, falloff=(-0.3, 0.05, 0.8))
    limits = DetailLimits(torch.full((count,), 0.05), torch.linspace(0.08, 0.3, count))
    options = options or nw.RenderOptions(background=(0.1, 0.2, 0.3))
    camera = nw.Camera(camera.viewmat.detach(), camera.K, camera.width, camera.height, camera.near)
    return nw.Model(make_surfels(scene), texture, exposures, limits, options), camera


def named_cameras(camera: nw.Camera) -> dict[str, nw.Camera]:
    """Return two cameras by name, the first of which is the given one."""
    return {"a.png": camera, "b.png": camera.crop(2, 1, 20, 16)}


def psnr(actual: np.ndarray, expected: np.ndarray) -> float:
    """PSNR of two images, without clamping."""
    return float(-10 * np.log10(max(np.mean((actual.astype(np.float64) - expected) ** 2), 1e-20)))


class Site:
    """A page's files on a server of its own; tests change them."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self.files = files
        site = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                name = self.path.partition("?")[0].lstrip("/") or "index.html"
                content = site.files.get(name)
                self.send_response(200 if content is not None else 404)
                self.send_header("Content-Type", KINDS.get(Path(name).suffix, "application/octet-stream"))
                self.send_header("Content-Length", str(len(content or b"")))
                self.end_headers()
                self.wfile.write(content or b"")

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def __enter__(self) -> "Site":
        return self

    def __exit__(self, *_: object) -> None:
        self.server.shutdown()
        self.server.server_close()
