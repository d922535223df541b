"""The WebGPU renderer from Python: the shaders of the browser on any GPU that wgpu drives, without CUDA and Warp."""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from nexwarp.cameras.camera import Camera
from nexwarp.errors import check_range
from nexwarp.export.web.gpu import Gpu, Pass, grouped
from nexwarp.export.web.program import (
    FRAME_BYTES,
    MODES,
    SCAN_BLOCK,
    SORT_BLOCK,
    Program,
    frame_values,
    geometry_rows,
    level_rows,
    packed_matrices,
    tile_grid,
)
from nexwarp.export.web.scene_data import SceneData
from nexwarp.model.model import Model

if TYPE_CHECKING:
    from wgpu import GPUAdapter, GPUBuffer

SHARING = 8  # threads that share a surfel's tile rows
FIRST_ENTRIES = 2**16
MOST_ENTRIES = 2**28
SPARE = 1.5  # capacity of the tile lists over what a frame needed
TEXEL_STEPS = (1, 2, 3, 4)


@dataclass(frozen=True)
class WebRendering:
    """The buffers of a frame, as those of `nexwarp.Rendering`.

    Attributes:
        image: (H, W, 3) float32; in a mode other than "image", the picture that it shows.
        alpha: (H, W) float32.
        ids: (H, W, K) int32, -1 in empty slots.
        depths: (H, W, K) float32, z-depths in world units.
        weights: (H, W, K) float32.
        entries: number of (tile, surfel) entries.
        times: milliseconds of the stages; empty unless asked for.
    """

    image: np.ndarray
    alpha: np.ndarray
    ids: np.ndarray
    depths: np.ndarray
    weights: np.ndarray
    entries: int
    times: dict[str, float] = field(default_factory=dict)


class Renderer:
    """Renders a scene with the WGSL shaders of the web page, on a GPU of any maker."""

    def __init__(
        self,
        scene: Model | SceneData | str | os.PathLike[str],
        adapter: "GPUAdapter | None" = None,
        *,
        half: bool = False,
        unrolled: bool = False,
        uniform: bool = True,
    ) -> None:
        """Upload a scene.

        Args:
            scene: a model, a scene file's name, or its content.
            adapter: an adapter of wgpu; None takes the fastest one.
            half: compute the MLP in half precision where the device has it.
            unrolled: unroll the MLP, unless it is large; some drivers take minutes to compile it.
            uniform: keep the MLP's weights in a uniform buffer, if they fit.

        Raises:
            MissingError: wgpu is not installed, or finds no GPU.
            OutOfMemoryError: a buffer is beyond the device's limits.
        """
        if isinstance(scene, (str, os.PathLike)):
            from nexwarp.export.web.scene_reader import load_scene_file

            scene = load_scene_file(scene)
        self.scene = SceneData.of(scene) if isinstance(scene, Model) else scene
        self.gpu = Gpu(adapter)
        self._program = Program.of(self.scene, SHARING, half and self.gpu.half, unrolled, uniform)
        self._plans: dict[tuple[int, int, int, int], list[Pass]] = {}
        self._capacity = FIRST_ENTRIES
        self._image: tuple[int, int] | None = None
        self._lists = 0
        count, gpu = len(self.scene), self.gpu
        texture = self.scene.texture
        self._buffers = {
            "frame": gpu.buffer("frame", FRAME_BYTES, uniform=True),
            "geometry": gpu.buffer("surfels", geometry_rows(self.scene)),
            "seen": gpu.buffer("detail limits", 16 if self.scene.limits is None else self.scene.limits),
            "sh": gpu.buffer("SH coefficients", self.scene.sh),
            "records": gpu.buffer("records", (80 if self.scene.options.low_pass else 64) * count),
            "polygons": gpu.buffer("tile polygons", 64 * count),
            "starts": gpu.buffer("list starts", 4 * count * SHARING),
            "start_sums": gpu.buffer("sums", 4 * (-(-count * SHARING // SCAN_BLOCK) + 1)),
            "count": gpu.buffer("count", np.array([count], np.uint32)),
        }
        for name in ("keys", "order", "keys2", "order2"):
            self._buffers[name] = gpu.buffer(name, 4 * count)
        if texture is not None:
            self._buffers["grid"] = gpu.buffer("texture grid", texture.grid)
            self._buffers["mlp"] = gpu.buffer(
                "texture MLP", self._packed(texture.matrices), uniform=self._program.uniform
            )
            self._buffers["levels"] = gpu.buffer("resolutions", level_rows(texture.resolutions), uniform=True)

    def _packed(self, matrices: list[np.ndarray]) -> np.ndarray:
        return packed_matrices(matrices).astype(np.float16 if self._program.half else np.float32)

    def render(
        self,
        camera: Camera,
        *,
        mode: str = "image",
        slot: int = 0,
        texel_step: int = 1,
        least_weight: float = 0.0,
        exposure: str = "photos",
        timed: bool = False,
    ) -> WebRendering:
        """Render a camera.

        Args:
            camera: the camera.
            mode: one of `MODES`.
            slot: rank of the hit that the modes "ids", "depth", "weights" and "normals" show; 0 is the heaviest.
            texel_step: pixels between evaluations of the texture along x and y, 1 to 4; 2 is half the resolution.
            least_weight: hits but the heaviest below this weight keep their plain colours.
            exposure: "photos" applies the scene's exposures, "mean" none.
            timed: measure the stages.

        Raises:
            TypeError, ValueError: the message names the argument.
            OutOfMemoryError: a buffer is beyond the device's limits.
        """
        if not isinstance(camera, Camera):
            raise TypeError(f"camera: expected a nexwarp.Camera, got {type(camera).__name__}")
        if mode not in MODES:
            raise ValueError(f"mode: expected one of {', '.join(MODES)}, got {mode!r:.60}")
        if texel_step not in TEXEL_STEPS:
            raise ValueError(f"texel_step: expected one of {TEXEL_STEPS}, got {texel_step!r:.60}")
        check_range("least_weight", least_weight, 0.0, 1.0)
        exposures = self.scene.exposures if exposure == "photos" else None
        self._make_image_buffers(camera)
        while True:
            self._make_lists()
            values = frame_values(
                self.scene,
                camera,
                self._capacity,
                mode=mode,
                slot=slot,
                texel_step=texel_step,
                least_weight=least_weight,
                exposures=exposures,
            )
            times = self._submit(camera, texel_step, values, timed)
            total = self._program.number("TOTAL")
            entries = int(self.gpu.read(self._buffers["start_sums"], np.uint32, total + 1)[-1])
            if entries <= self._capacity:
                return self._rendering(camera, entries, times)
            check_range("entries of the tile lists", entries, 0, MOST_ENTRIES)
            self._capacity = int(entries * SPARE)

    def _submit(self, camera: Camera, texel_step: int, values: bytes, timed: bool = False) -> dict[str, float]:
        """Submit a frame without waiting for it, unless timed."""
        key = (camera.width, camera.height, texel_step, self._capacity)
        if key not in self._plans:
            self._plans[key] = self._passes(camera, texel_step)
        self.gpu.write(self._buffers["frame"], values)
        return self.gpu.run(self._plans[key], timed)

    def measure(
        self, camera: Camera, frames: int, *, texel_step: int = 1, least_weight: float = 0.0
    ) -> tuple[float, list[dict[str, float]]]:
        """Render a camera again and again without reading the pictures.

        Args:
            camera: the camera.
            frames: number of frames, >= 1.
            texel_step: see `render`.
            least_weight: see `render`.

        Returns:
            Wall time in seconds of a frame of many in a row; and the milliseconds of the stages of as many more.
        """
        self.render(camera, texel_step=texel_step, least_weight=least_weight)
        values = frame_values(
            self.scene,
            camera,
            self._capacity,
            mode="image",
            slot=0,
            texel_step=texel_step,
            least_weight=least_weight,
            exposures=self.scene.exposures,
        )
        start = time.perf_counter()
        for _ in range(frames):
            self._submit(camera, texel_step, values)
        self.gpu.read(self._buffers["image"], np.float32, 4)
        seconds = (time.perf_counter() - start) / frames
        return seconds, [self._submit(camera, texel_step, values, timed=True) for _ in range(frames)]

    def _make_image_buffers(self, camera: Camera) -> None:
        """Make the buffers of an image's size, unless they exist."""
        size = (camera.width, camera.height)
        if self._image == size:
            return
        self._plans.clear()
        pixels, slots = camera.width * camera.height, max(self.scene.options.max_hits, 1)
        columns, rows = tile_grid(camera)
        self._image = None
        for name, width in (("colors", 16), ("ids", 4 * slots), ("depths", 4 * slots), ("weights", 4 * slots)):
            self._buffers[name] = self.gpu.buffer(name, width * pixels)
        self._buffers["texels"] = self.gpu.buffer("texels", 16 * slots * pixels)
        self._buffers["image"] = self.gpu.buffer("image", 16 * pixels)
        self._buffers["tile_starts"] = self.gpu.buffer("tile starts", 4 * (columns * rows + 1))
        self._image = size

    def _make_lists(self) -> None:
        """Make the tile lists of the capacity, unless they exist."""
        if self._lists == self._capacity:
            return
        self._plans.clear()
        for name in ("tiles", "surfels", "tiles2", "surfels2"):
            self._buffers[name] = self.gpu.buffer("tile lists", 4 * self._capacity)
        self._lists = self._capacity

    def _passes(self, camera: Camera, texel_step: int) -> list[Pass]:
        """Return the dispatches of a frame."""
        count, (columns, rows) = len(self.scene), tile_grid(camera)
        tiles = columns * rows
        total = self._program.number("TOTAL")
        passes = [self._pass("project", "project", "project", PROJECT, grouped(count))]
        passes += self._sort("sort surfels", ("keys", "order"), ("keys2", "order2"), 32, count, ("count", 0))
        passes += [self._pass("lists", "lists", "count", COUNT, grouped(count * SHARING))]
        passes += self._scan("lists", "starts", "start_sums", count * SHARING)
        passes += [self._pass("lists", "lists", "emit", EMIT, grouped(count * SHARING))]
        bits = 16 if tiles < 2**16 else 32
        pair, spare = ("tiles", "surfels"), ("tiles2", "surfels2")
        passes += self._sort("sort entries", pair, spare, bits, self._capacity, ("start_sums", total))
        passes += [self._pass("lists", "lists", "offsets", OFFSETS, grouped(tiles + 1))]
        passes += [self._pass("collect", "collect", "collect", COLLECT, (columns, rows))]
        if self.scene.texture is not None:
            width, height = (-(-size // texel_step) for size in (camera.width, camera.height))
            passes += [self._pass("texture", "shade", "shade", SHADE, (-(-width // 8), -(-height // 8)))]
        groups = (-(-camera.width // 8), -(-camera.height // 8))
        return [*passes, self._pass("compose", "compose", "compose", COMPOSE, groups)]

    def _pass(self, stage: str, name: str, entry: str, names: Mapping[int, str], groups: tuple[int, int]) -> Pass:
        return self._bound(stage, name, entry, {index: self._buffers[one] for index, one in names.items()}, groups)

    def _bound(
        self, stage: str, name: str, entry: str, buffers: Mapping[int, "GPUBuffer"], groups: tuple[int, int]
    ) -> Pass:
        pipeline = self.gpu.pipeline(name, self._program.source(name), entry)
        return Pass(stage, pipeline, self.gpu.bind(pipeline, buffers), groups)

    def _uniform(self, *values: int) -> "GPUBuffer":
        """A uniform buffer of four words, made once."""
        name = f"uniform {values}"
        if name not in self._buffers:
            self._buffers[name] = self.gpu.buffer(name, np.array(values, np.uint32), uniform=True)
        return self._buffers[name]

    def _scan(self, stage: str, data: str, sums: str, count: int) -> list[Pass]:
        """Prefix sums in place; the total is written behind the sums."""
        blocks = -(-count // SCAN_BLOCK)
        buffers = {0: self._uniform(count, blocks, 0, 0), 1: self._buffers[data], 2: self._buffers[sums]}
        middle = {index: buffer for index, buffer in buffers.items() if index != 1}
        groups = grouped(blocks, 1)
        return [
            self._bound(stage, "scan", "reduce", buffers, groups),
            self._bound(stage, "scan", "middle", middle, (1, 1)),
            self._bound(stage, "scan", "spread", buffers, groups),
        ]

    def _sort(
        self, stage: str, pair: tuple[str, str], spare: tuple[str, str], bits: int, count: int, total: tuple[str, int]
    ) -> list[Pass]:
        """Sort pairs by the low bits of their keys; an even number of passes leaves the result in `pair`."""
        blocks = max(-(-count // SORT_BLOCK), 1)
        counts, sums = f"counts {count}", f"count sums {count}"
        if counts not in self._buffers:
            self._buffers[counts] = self.gpu.buffer("digit counts", 4 * 256 * blocks)
            self._buffers[sums] = self.gpu.buffer("sums", 4 * (-(-256 * blocks // SCAN_BLOCK) + 1))
        passes = []
        for shift in range(0, bits, 8):
            uniform = self._uniform(shift, blocks, count, total[1])
            before, after = (self._buffers[one] for one in pair), (self._buffers[one] for one in spare)
            buffers = dict(enumerate([uniform, self._buffers[total[0]], *before, self._buffers[counts], *after]))
            histogram = {index: buffers[index] for index in (0, 1, 2, 4)}
            groups = grouped(blocks, 1)
            passes.append(self._bound(stage, "sort", "histogram", histogram, groups))
            passes += self._scan(stage, counts, sums, 256 * blocks)
            passes.append(self._bound(stage, "sort", "scatter", buffers, groups))
            pair, spare = spare, pair
        return passes

    def _rendering(self, camera: Camera, entries: int, times: dict[str, float]) -> WebRendering:
        """Read the buffers of a frame."""
        shape = (camera.height, camera.width)
        pixels, hits = shape[0] * shape[1], self.scene.options.max_hits

        def read(name: str, dtype: type, width: int) -> np.ndarray:
            return self.gpu.read(self._buffers[name], dtype, pixels * width).reshape(*shape, width)

        image, colors = read("image", np.float32, 4), read("colors", np.float32, 4)
        ids, depths, weights = (
            read(name, dtype, hits) if hits else np.zeros((*shape, 0), dtype)
            for name, dtype in (("ids", np.int32), ("depths", np.float32), ("weights", np.float32))
        )
        return WebRendering(image[..., :3], colors[..., 3], ids, depths, weights, entries, times)


# Bindings of the entry points: index to the buffer's name.
PROJECT = dict(enumerate(["frame", "geometry", "seen", "sh", "records", "polygons", "keys", "order"]))
COUNT = {0: "frame", 1: "order", 2: "polygons", 3: "starts"}
EMIT = {**COUNT, 4: "tiles", 5: "surfels", 6: "start_sums"}
OFFSETS = {0: "frame", 4: "tiles", 6: "start_sums", 7: "tile_starts"}
COLLECT = dict(enumerate(["frame", "records", "surfels", "tile_starts", "colors", "ids", "depths", "weights"]))
SHADE = dict(enumerate(["frame", "seen", "ids", "depths", "weights", "grid", "mlp", "texels", "levels"]))
COMPOSE = dict(enumerate(["frame", "records", "colors", "ids", "depths", "weights", "texels", "image"]))
