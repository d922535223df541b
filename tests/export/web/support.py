"""Models and pages for tests of the web renderer, a reader of their files, and the baked scene by its definition.

The reader is written from FORMAT.md, independent of the writer and the page.
"""

import base64
import io
import json
import shutil
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import nexwarp as nw
from nexwarp.export.baked_scene import BakedScene
from nexwarp.export.web.baked import encode_harmonics, encode_picture
from nexwarp.export.web.export import export_web
from nexwarp.export.web.quantise import CHUNK
from nexwarp.model.texture import NEVER
from tests.narrowing import present
from tests.scenes import intrinsics, make_camera, make_surfels, make_texture, random_scene, rigid

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WEBGPU = ["--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader"]
KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
DTYPES = {"u8": "<u1", "u16": "<u2", "u32": "<u4", "f16": "<f2", "f32": "<f4"}
URL = "http://localhost/"  # a secure context
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
DRAWN = "nexwarp.state === 'ready' && nexwarp.frames > 0 && nexwarp.refined === 'full'"
FINISHED = f"{DRAWN} && !nexwarp.dirty && !nexwarp.drawing && !nexwarp.flight && !nexwarp.pacing.moving"
# As text: the driver takes a second for that many numbers.
READ_IMAGE = """nexwarp.renderer.read("image").then(image => {
    const bytes = Array.from(new Uint8Array(Float32Array.from(image).buffer), byte => String.fromCharCode(byte));
    return [nexwarp.canvas.height, nexwarp.canvas.width, btoa(bytes.join(""))];
})"""
POSE = "[...nexwarp.pose.eye, nexwarp.pose.yaw, nexwarp.pose.pitch, nexwarp.pose.distance]"


def web_model(count: int = 60, *, options: nw.RenderOptions | None = None, **shape: Any) -> tuple[nw.Model, nw.Camera]:
    """Return a small model with texture, exposures with a falloff and detail limits, and a camera.

    Values of the texture are exact in half precision, as those of model files are.
    """
    scene = random_scene(count, width=37, height=27)
    generator = torch.Generator().manual_seed(3)
    small = {"levels": 3, "table_size": 2**9, "min_resolution": 1.0, "max_resolution": 8.0, "features": 2}
    texture = nw.NeuralTexture(**{**small, "width": 12, "hidden_layers": 2, "residual": True, **shape})
    with torch.no_grad():
        for parameter in texture.parameters():
            parameter.copy_((0.4 * torch.randn(parameter.shape, generator=generator)).half().float())
    camera = make_camera(scene)
    camera = replace(camera, viewmat=camera.viewmat.detach())
    shifts = torch.zeros(4, 4, 4)
    shifts[:, 0, 3] = 0.3 * torch.arange(4)
    cameras = [replace(camera, viewmat=camera.viewmat + shift) for shift in shifts]
    gains = torch.tensor([[0.1, 0.0, -0.1], [0.0, 0.05, 0.0], [-0.1, 0.0, 0.1], [0.05, 0.0, 0.0]])
    exposures = nw.Exposures.of(gains, cameras, falloff=(-0.3, 0.05, 0.8))
    limits = nw.DetailLimits(torch.full((count,), 0.05), torch.linspace(0.08, 0.3, count))
    options = options or nw.RenderOptions(background=(0.1, 0.2, 0.3))
    return nw.Model(make_surfels(scene), texture, exposures, limits, options), camera


def named_cameras(camera: nw.Camera) -> dict[str, nw.Camera]:
    """Return two cameras by name, the first of which is the given one."""
    return {"a.png": camera, "b.png": camera.crop(2, 1, 20, 16)}


def entry_of(camera: nw.Camera) -> dict[str, object]:
    """A camera as the page takes it."""
    K = [camera.fx, camera.fy, camera.cx, camera.cy]
    size = {"width": camera.width, "height": camera.height, "near": camera.near}
    return {"viewmat": camera.viewmat.flatten().tolist(), "K": K, **size}


def psnr(actual: torch.Tensor, expected: torch.Tensor) -> float:
    """PSNR of two images, without clamping."""
    return float(-10 * (actual.double() - expected).square().mean().clamp_min(1e-20).log10())


class Tab:
    """A browser's page that finds `files` at URL; what it asked for and complained about."""

    def __init__(self, browser: Any, files: dict[str, bytes], **options: Any) -> None:
        self.context = browser.new_context(**options)
        self.page = self.context.new_page()
        self.files = dict(files)
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.route(lambda url: url.startswith(URL), self._answer)
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))

    def _answer(self, route: Any) -> None:
        name = route.request.url.removeprefix(URL).partition("?")[0] or "index.html"
        kind = KINDS.get(Path(name).suffix, "application/octet-stream")
        found = name in self.files
        route.fulfill(status=200 if found else 404, content_type=kind, body=self.files.get(name, b""))

    def value(self, expression: str, *arguments: Any) -> Any:
        """What an expression is in the page."""
        return self.page.evaluate(expression, *arguments)


class PageTab(Tab):
    """A page of a scene."""

    def wait(self, condition: str, seconds: float = 60.0) -> None:
        """Wait for a condition; the page's policy forbids what playwright's own wait needs."""
        for _ in range(int(seconds / 0.05)):
            if self.value(condition):
                return
            self.page.wait_for_timeout(50)
        state = self.value("globalThis.nexwarp ? nexwarp.state : 'no page'")
        raise AssertionError(f"{condition}: not within {seconds} s; {state}: {self.message} {self.errors}")

    def open(self, query: str = "") -> None:
        self.page.goto(URL + query)
        self.wait(FINISHED)

    @property
    def message(self) -> str:
        return str(self.page.inner_text("#message"))

    def picture(self) -> np.ndarray:
        """The last frame (H, W, 3) in [0, 1]."""
        height, width, text = self.value(READ_IMAGE)
        return np.frombuffer(base64.b64decode(text), np.float32).reshape(height, width, 4)[..., :3]


def ring(count: int = 4, width: int = 64, height: int = 48) -> dict[str, nw.Camera]:
    """Cameras around the random scene."""
    cameras = {}
    for i in range(count):
        viewmat = rigid((0.9, 0.2, -0.3 + 0.06 * i, 0.1), (0.3 - 0.2 * i, -0.2, 0.5)).float()
        K = intrinsics(0.8 * width, 0.8 * width, width / 2, height / 2).float()
        cameras[f"{i}.png"] = nw.Camera(viewmat, K, width, height)
    return cameras


def small_model(count: int = 12, *, residual: bool = True, sh_degree: int = 3) -> nw.Model:
    """The random scene with a texture."""
    texture = make_texture(residual=residual, sh_degree=sh_degree)
    with torch.no_grad():
        texture.grid.mul_(0.3)
    surfels = make_surfels(random_scene(count, width=64, height=48, seed=3, sh_degree=sh_degree))
    return nw.Model(surfels, texture, options=nw.RenderOptions(background=(0.1, 0.2, 0.3)))


def ring_model(cameras: dict[str, nw.Camera], count: int, limits: nw.DetailLimits | None = None) -> nw.Model:
    """A small model with exposures and vignetting of the cameras."""
    gains = torch.linspace(-0.3, 0.3, len(cameras))[:, None].expand(-1, 3) * torch.tensor([1.0, 0.5, -0.5])
    model = small_model(count)
    model.exposures = nw.Exposures.of(gains, list(cameras.values()), (-0.4, 0.1, 0.7))
    model.detail_limits = limits
    return model


def exported(model: nw.Model, cameras: dict[str, nw.Camera], folder: Path, **options: Any) -> dict[str, bytes]:
    """The files of a model's page by name."""
    files = export_web(model, cameras, folder, **options)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def bilinear(texels: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Texels (height, width, C) at places (..., 2), column and row; differentiable."""
    left, top = places.detach().floor().long().unbind(-1)
    right, bottom = (left + 1).clamp(max=texels.shape[1] - 1), (top + 1).clamp(max=texels.shape[0] - 1)
    fx, fy = (places - places.detach().floor())[..., None].unbind(-2)
    upper = texels[top, left] * (1 - fx) + texels[top, right] * fx
    return upper * (1 - fy) + (texels[bottom, left] * (1 - fx) + texels[bottom, right] * fx) * fy


def read_sections(content: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header, and the arrays of the sections by name."""
    version, length = struct.unpack_from("<II", content, 8)
    assert version == 1
    header = json.loads(content[16 : 16 + length])
    arrays = {}
    for entry in header["sections"]:
        start = 16 + length + entry["offset"]
        stored = content[start : start + entry["bytes"]]
        data = zlib.decompress(stored) if entry["encoding"] == "deflate" else stored
        arrays[entry["name"]] = np.frombuffer(data, DTYPES[entry["dtype"]]).reshape(entry["shape"])
    return header, arrays


def header_of(content: bytes) -> dict[str, Any]:
    header: dict[str, Any] = json.loads(content[16 : 16 + struct.unpack("<I", content[12:16])[0]])
    return header


def rebuilt(content: bytes, **changes: Any) -> bytes:
    """A file with another header."""
    text = json.dumps({**header_of(content), **changes}).encode()
    return content[:12] + struct.pack("<I", len(text)) + text + content[16 + struct.unpack("<I", content[12:16])[0] :]


def read_surfels(content: bytes) -> dict[str, np.ndarray]:
    """The surfels of a scene file, float32."""
    header, arrays = read_sections(content)
    if header["quality"] == "full":
        return arrays
    ranges, count, bands = arrays["ranges"], header["surfels"], round(header["sh_coefficients"] ** 0.5)
    columns = np.repeat(np.arange(7, 7 + bands), [3 * (2 * band + 1) for band in range(bands)])
    data = {
        "means": decode_chunks(arrays["means"].T, ranges[:, :3]),
        "quats": decode_quats(arrays["quats"]),
        "scales": np.exp(decode_chunks(arrays["scales"].T, ranges[:, 3:5])),
        "opacities": arrays["opacities"].astype(np.float32) / 255,
        "gammas": np.maximum(np.exp(decode_chunks(arrays["gammas"].T, ranges[:, 5:7])), 1),
        "sh": decode_chunks(arrays["sh"].T, ranges[:, columns]).reshape(count, bands**2, 3),
    }
    if "limits" in arrays:
        data["limits"] = decode_limits(arrays["limits"].T, arrays["limits_scale"])
    return data


def decode_chunks(codes: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """The (N, C) float32 values of codes."""
    whole = np.repeat(ranges, CHUNK, axis=0)[: len(codes)]
    return whole[..., 0] + whole[..., 1] * codes.astype(np.float32)


def decode_quats(code: np.ndarray) -> np.ndarray:
    """(N, 4) unit quaternions, wxyz."""
    x = ((code & 2047) / 2047 * 2 - 1) * np.sqrt(0.5)
    y = (((code >> 11) & 2047) / 2047 * 2 - 1) * np.sqrt(0.5)
    z = ((code >> 22) / 1023 * 2 - 1) * np.sin(np.pi / 8)
    w = np.sqrt(np.maximum(1 - x**2 - y**2 - z**2, 0.0))
    quats = np.stack([w, x, y, z], axis=1)
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def decode_limits(codes: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(N, 2) float32 detail limits."""
    values = np.exp(scale[0] + scale[1] * (codes.astype(np.float32) - 1))
    return np.where(codes == 65535, np.float32(NEVER), np.where(codes == 0, 0, values)).astype(np.float32)


def decode_harmonics(codes: np.ndarray, ranges: list[float]) -> np.ndarray:
    """The (N, C - 1, 3) float32 coefficients of a baked scene."""
    steps = codes.astype(np.float32) - 128
    degrees = np.floor(np.sqrt(np.arange(codes.shape[1]) + 1)).astype(int)
    return (np.sign(steps) * (steps / 127) ** 2 * np.array(ranges, np.float32)[degrees - 1][:, None]).astype(np.float32)


def decode_atlas(codes: torch.Tensor, scale: float) -> torch.Tensor:
    """The float32 atlas of codes."""
    return (codes.float() - 128) * (scale / 127)


def as_stored(scene: BakedScene) -> BakedScene:
    """A baked scene with the colours that its files hold."""
    picture, scale = encode_picture(scene.texels[..., :3])
    with Image.open(io.BytesIO(picture)) as image:
        codes = torch.from_numpy(np.array(image.convert("RGB")))
    sh0, shN = present(scene.harmonics)
    shN = torch.from_numpy(decode_harmonics(*encode_harmonics(shN))).to(shN)
    texels = torch.nn.functional.pad(decode_atlas(codes, scale), (0, 1)).to(scene.texels)
    return replace(scene, texels=texels, harmonics=(sh0, shN))
