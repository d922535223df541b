"""Frames of a baked page by the page's own shaders on the GPU, through EGL instead of a browser.

    pip install moderngl
    python -m benchmarks.page RUN/export --cameras RUN --size 1920x1080

Printed are medians over the run's test cameras: GPU time of a frame, frames a second, and the quads of a pixel that are
blended (overdraw; each reads the atlas once, bilinearly). The sort of the surfels, which the page's script
does on the CPU, does not count, nor does the browser. The first picture is compared with `nexwarp.load_baked`.
"""

import argparse
import dataclasses
import re
import statistics
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

import nexwarp as nw
from nexwarp.cameras.camera import Camera
from nexwarp.export.baked_scene import BakedScene
from nexwarp.export.web.baked import encode_atlas, encode_harmonics
from nexwarp.model.surfels import axes
from nexwarp.run.evaluate import psnr

SHADERS = Path(nw.__file__).parent / "export" / "web" / "page" / "baked_shaders.js"
PER_ROW = 128  # surfels, as the shaders expect
REPEATS = 20  # of each camera's frame


def shaders() -> dict[str, str]:
    """Return the shaders of the page by the names that its script has for them."""
    texts = dict(re.findall(r"const (\w+) = `(.*?)`;", SHADERS.read_text(encoding="utf-8"), re.DOTALL))
    return {name: text.replace("${COMMON}", texts["COMMON"]) for name, text in texts.items()}


def packed(scene: BakedScene) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Return geometry (rows, 128 * 8, 4) float32 and harmonics (rows, 128 * 15, 4) uint8 texels, and SH ranges."""
    assert scene.harmonics is not None and scene.limits is not None
    shape, (sh0, shN) = scene.shape, scene.harmonics
    x, y, z = axes(torch.nn.functional.normalize(shape.quats, dim=1))
    count = len(sh0)
    zero = torch.zeros(count, 1)
    parts = [x, shape.scales[:, :1], y, shape.scales[:, 1:], shape.means, shape.opacities[:, None]]
    parts += [shape.gammas, scene.limits.farthest[:, None].clamp(max=1e30), zero]
    parts += [scene.boxes, scene.rects, sh0[:, 0], zero, z, zero]
    rows = -(-count // PER_ROW)
    geometry = np.zeros((rows * PER_ROW, 32), np.float32)
    geometry[:count] = torch.cat(parts, dim=1).numpy()
    codes, ranges = encode_harmonics(shN)
    harmonics = np.full((rows * PER_ROW, 15, 4), 128, np.uint8)
    harmonics[:count, : codes.shape[1], :3] = codes
    return geometry.reshape(rows, -1, 4), harmonics.reshape(rows, -1, 4), ranges


class PageDrawing:
    """The quads of a page, in a framebuffer of half floats."""

    def __init__(self, scene: BakedScene, width: int, height: int) -> None:
        """Move a scene to the GPU, for pictures of one size."""
        import moderngl

        self.gl = moderngl.create_context(standalone=True, backend="egl")
        self.size, self.scene, texts = (width, height), scene, shaders()
        self.program = self.gl.program(texts["QUADS_VERTEX"], texts["QUADS_FRAGMENT"])
        geometry, harmonics, ranges = packed(scene)
        texels, scale = encode_atlas(scene.texels[..., :3])
        atlas = torch.nn.functional.pad(texels, (0, 1), value=255).numpy()
        nearest, linear = (moderngl.NEAREST, moderngl.NEAREST), (moderngl.LINEAR, moderngl.LINEAR)
        pictures = (
            ("geometry", geometry, "f4", nearest),
            ("harmonics", harmonics, "f1", nearest),
            ("atlas", atlas, "f1", linear),
        )
        for unit, (name, values, dtype, kind) in enumerate(pictures):
            texture = self.gl.texture((values.shape[1], values.shape[0]), 4, values.tobytes(), dtype=dtype)
            texture.filter = kind
            texture.use(unit)
            self.program[name].value = unit
        constants: dict[str, Any] = {"mode": 0, "coefficients": 1 + len(scene.harmonics[1][0])}  # type: ignore[index]
        constants |= {"bands": tuple(ranges), "size": self.size, "atlasScale": (atlas.shape[1], atlas.shape[0], scale)}
        for name, value in constants.items():
            self.program[name].value = value
        self.ids = self.gl.buffer(reserve=4 * len(scene.boxes))
        self.quads = self.gl.vertex_array(self.program, [(self.ids, "1u /i", "surfel")])
        self.picture = self.gl.texture(self.size, 4, dtype="f2")
        self.frame = self.gl.framebuffer([self.picture])
        self.gl.enable_only(moderngl.BLEND)
        self.gl.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        self.strip = moderngl.TRIANGLE_STRIP

    def take(self, camera: Camera) -> None:
        """Sort the surfels for a camera, and pass it to the shaders."""
        viewmat, means = camera.viewmat.float(), self.scene.shape.means
        depths = means @ viewmat[2, :3]
        self.ids.write(depths.argsort(descending=True).numpy().astype(np.uint32).tobytes())
        values: dict[str, Any] = {
            "viewmat": tuple(viewmat.T.flatten().tolist()),
            "eye": tuple(camera.position.tolist()),
        }
        values |= {"intrinsics": (camera.fx, camera.fy, camera.cx, camera.cy), "near": camera.near}
        for name, value in values.items():
            self.program[name].value = value

    def draw(self) -> None:
        """Draw a frame."""
        self.frame.use()
        self.frame.clear()
        self.quads.render(self.strip, vertices=4, instances=len(self.scene.boxes))

    def image(self) -> torch.Tensor:
        """Return the frame in front of the scene's background, (H, W, 3)."""
        width, height = self.size
        values = np.frombuffer(self.picture.read(), np.float16).reshape(height, width, 4)[::-1].astype(np.float32)
        color, alpha = torch.from_numpy(values.copy()).split([3, 1], dim=-1)
        return color + (1 - alpha) * torch.tensor(self.scene.background)

    def figures(self) -> dict[str, float]:
        """Return milliseconds of a frame on the GPU, and its blended quads of a pixel."""
        times = []
        for _ in range(REPEATS):
            with (query := self.gl.query(time=True)):
                self.draw()
            times.append(query.elapsed / 1e6)
        with (query := self.gl.query(samples=True)):
            self.draw()
        return {"ms": statistics.median(times), "overdraw": query.samples / (self.size[0] * self.size[1])}


def filling(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera whose picture has another size and shows the same height."""
    K = camera.K.clone()
    K[:2] *= height / camera.height
    K[0, 2] += (width - camera.width * height / camera.height) / 2
    return Camera(camera.viewmat, K, width, height, camera.near)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.page", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("page", type=Path, help="page, or its folder")
    parser.add_argument(
        "--cameras", type=Path, required=True, help="run folder, of whose test cameras frames are drawn"
    )
    parser.add_argument("--size", default="1920x1080", help="default: %(default)s")
    options = parser.parse_args(arguments)
    width, height = (int(x) for x in options.size.split("x"))
    scene = nw.load_baked(options.page)
    cameras = [filling(camera, width, height) for camera in nw.load_cameras(options.cameras)["test"].values()]
    drawing = PageDrawing(scene, width, height)
    figures: list[dict[str, Any]] = []
    for camera in cameras:
        drawing.take(camera)
        figures.append(drawing.figures())
    drawing.take(cameras[0])
    drawing.draw()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    expected = dataclasses.replace(scene, exposures=None).to(device).render(cameras[0]).cpu()
    ms, overdraw = (statistics.median(x[name] for x in figures) for name in ("ms", "overdraw"))
    print(f"{drawing.gl.info['GL_RENDERER']}, {width}x{height}, {len(scene.boxes):,} quads, {len(cameras)} views")
    print(f"{ms:.3f} ms on the GPU, {1000 / ms:.0f} frames a second; {overdraw:.1f} quads a pixel are blended")
    print(f"{psnr(drawing.image(), expected):.1f} dB to nexwarp.load_baked")
    return 0


if __name__ == "__main__":
    sys.exit(main())
