"""The WGSL renderer of the web page, run through wgpu: agreement with `Model.render`, times of its stages, sizes.

    python -m benchmarks.bench_web RUN --size 1920x1080

Needs the extra `wgpu` and a Vulkan or Metal driver. Prints for the run's test views the PSNR against `Model.render` in
single precision, of the exact and of the quantised scene file; with --scene, also the PSNR of each against the photos.
Then the times of the stages at --size, for each way to save work on weak GPUs with its cost in dB, and with CUDA those
of `Model.render`.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, cast

import numpy as np
import torch
import tyro

import nexwarp as nw
from benchmarks.timing import git_commit
from nexwarp.cameras.camera import resized
from nexwarp.cameras.cameras_file import load_cameras
from nexwarp.export.web.renderer import Renderer
from nexwarp.export.web.scene_data import SceneData
from nexwarp.export.web.scene_file import encode_scene
from nexwarp.export.web.scene_reader import decode_scene
from nexwarp.export.web.sections import matrix_shapes
from nexwarp.model.model import Model
from nexwarp.model.texture import TextureShape
from nexwarp.train.presets import preset


@dataclass(frozen=True)
class Case:
    """A way to render.

    Attributes:
        name: of the way.
        half: half precision of the MLP.
        unrolled: MLP unrolled.
        uniform: its weights in a uniform buffer.
        texel_step: pixels between evaluations of the texture.
        least_weight: smallest weight of a textured second hit.
        small: the network of `--preset web` instead of the scene's, not trained: its picture means nothing.
    """

    name: str
    half: bool = True
    unrolled: bool = False
    uniform: bool = True
    texel_step: int = 1
    least_weight: float = 0.0
    small: bool = False


CASES = (
    Case("half precision"),
    Case("single precision", half=False),
    Case("texture at half resolution", texel_step=2),
    Case("second hits below 1/64 plain", least_weight=1 / 64),
    Case("both", texel_step=2, least_weight=1 / 64),
    Case("network of preset web", small=True),
    Case("network of preset web, both", texel_step=2, least_weight=1 / 64, small=True),
)
FORMS = (
    Case("half precision, weights in storage", uniform=False),
    Case("single precision, weights in storage", half=False, uniform=False),
    Case("half precision, unrolled", unrolled=True),
    Case("single precision, unrolled", half=False, unrolled=True),
    Case("half precision, unrolled, weights in storage", unrolled=True, uniform=False),
)


@dataclass
class Arguments:
    """Arguments of the command line."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    size: str = "1920x1080"
    """Size of the timed frames."""
    frames: int = 30
    """Number of timed frames; 0 only compares."""
    views: int = 7
    """Test views that are compared."""
    scale: float = 1.0
    """Factor on their size."""
    scene: Path | None = None
    """The scene's folder, for the PSNR against photos."""
    downscale: int = 1
    """--downscale of the training."""
    forms: bool = False
    """Also time other forms of the MLP."""


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """PSNR of two images of values up to 1, without clamping; that of equal images is limited to 200 dB."""
    return float(-10 * np.log10(max(np.mean((a.astype(np.float64) - b) ** 2), 1e-20)))


def shown(image: np.ndarray) -> np.ndarray:
    """Return an image as it is shown and compared with photos."""
    return np.rint(image.clip(0, 1) * 255) / 255


def compare(arguments: Arguments, model: Model, scenes: dict[str, SceneData]) -> None:
    """Print the agreement with `Model.render`, and the PSNR against the photos."""
    views = []
    for name, camera in list(load_cameras(arguments.run)["test"].items())[: arguments.views]:
        size = (round(arguments.scale * camera.width), round(arguments.scale * camera.height))
        views.append((name, resized(camera, *size)))
    photos = {}
    if arguments.scene is not None:
        given = nw.load_scene(arguments.scene, downscale=arguments.downscale)
        photos = {view.name: view.image for view in given.test}
    device = "cuda" if torch.cuda.is_available() else "cpu"
    exact = Model(model.surfels, model.texture, model.exposures, model.detail_limits, model.options).to(device)
    if exact.texture is not None:
        exact.texture.half_precision = False
    with torch.no_grad():
        references = [exact.render(camera) for _, camera in views]
    for name, scene in scenes.items():
        renderer = Renderer(scene)
        rows = []
        for (view, camera), reference in zip(views, references, strict=True):
            out, expected = renderer.render(camera), reference.image.cpu().numpy()
            row = [psnr(out.image, expected)]
            if name == "full":
                row.append(100 * float(np.mean((out.ids != reference.ids.cpu().numpy()).any(-1))))
            if view in photos:
                photo = np.asarray(photos[view]) / 255
                row += [psnr(shown(out.image), photo), psnr(shown(expected), photo)]
            rows.append(row)
        columns = list(zip(*rows, strict=True))
        text = f"{name}: against Model.render {min(columns[0]):.1f} dB at least, {statistics.mean(columns[0]):.1f} mean"
        if name == "full":
            text += f"; pixels whose ids differ {max(columns[1]):.4f} % at most"
        if photos:
            ours, theirs = (statistics.mean(column) for column in columns[-2:])
            text += f"; against photos {ours:.3f} dB, Model.render {theirs:.3f}"
        print(text, flush=True)


def small_texture(scene: SceneData) -> SceneData:
    """Return the scene with the texture network of `--preset web`, its weights random."""
    if scene.texture is None:
        return scene
    config = preset("web").texture
    shape = {**scene.texture.shape, "width": config.width, "hidden_layers": config.hidden_layers, "sh_degree": 1}
    rng = np.random.default_rng(0)
    matrices = [0.3 * rng.standard_normal(size).astype(np.float32) for size in matrix_shapes(shape)]
    return replace(scene, texture=replace(scene.texture, shape=cast(TextureShape, shape), matrices=matrices))


def times(arguments: Arguments, scene: SceneData, camera: nw.Camera, cases: Sequence[Case]) -> None:
    """Print the times of the stages for each way to render."""
    reference = None
    renderers: dict[tuple[bool, bool, bool, bool], Renderer] = {}
    for case in cases:
        start = time.perf_counter()
        form = (case.half, case.unrolled, case.uniform, case.small)
        if form not in renderers:
            half, unrolled, uniform, small = form
            content = small_texture(scene) if small else scene
            renderers[form] = Renderer(content, half=half, unrolled=unrolled, uniform=uniform)
        renderer = renderers[form]
        out = renderer.render(camera, texel_step=case.texel_step, least_weight=case.least_weight)
        first = time.perf_counter() - start
        reference = out.image if reference is None else reference
        wall, runs = renderer.measure(
            camera, arguments.frames, texel_step=case.texel_step, least_weight=case.least_weight
        )
        stages = {stage: statistics.median(run[stage] for run in runs) for stage in runs[0]}
        listed = ", ".join(f"{stage} {ms:.3f}" for stage, ms in stages.items())
        print(
            f"{case.name}: stages {sum(stages.values()):.3f} ms ({listed}); "
            f"back to back {1e3 * wall:.3f} ms = {1 / wall:.0f} FPS; {psnr(out.image, reference):.1f} dB to the first; "
            f"{out.entries:,} entries; first frame {first:.2f} s",
            flush=True,
        )


def cuda_times(arguments: Arguments, camera: nw.Camera) -> None:
    """Print the time of `Model.render` on CUDA."""
    model = nw.load(arguments.run).to("cuda")
    camera = camera.to("cuda")

    @torch.no_grad()
    def frame() -> None:
        model.render(camera)

    for _ in range(5):
        frame()
    wall = _back_to_back(frame, arguments.frames)
    print(f"Model.render on {torch.cuda.get_device_name()}: {wall:.3f} ms back to back")
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for _ in range(10):
            frame()
        torch.cuda.synchronize()
    kernels = sorted(profile.key_averages(), key=lambda event: -event.device_time_total)
    total = sum(event.device_time_total for event in kernels) / 1e4
    listed = ", ".join(f"{event.key[:34]} {event.device_time_total / 1e4:.3f}" for event in kernels[:12])
    print(f"  on the GPU {total:.3f} ms: {listed}")


def _back_to_back(frame: Callable[[], None], count: int) -> float:
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(count):
        frame()
    torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - start) / count


def main(arguments: Arguments) -> None:
    """Compare, then measure."""
    model = nw.load(arguments.run)
    sets = load_cameras(arguments.run)
    cameras = {**sets["train"], **sets["test"]}
    contents = {quality: encode_scene(model, cameras, quality=quality) for quality in ("full", "quantised")}
    scenes = {quality: decode_scene(content) for quality, content in contents.items()}
    sizes = ", ".join(f"{quality} {len(content) / 1e6:.2f} MB" for quality, content in contents.items())
    print(f"{Renderer(scenes['full']).gpu.name}; commit {git_commit()}; {len(model.surfels):,} surfels; {sizes}")
    width, height = map(int, arguments.size.split("x"))
    camera = resized(next(iter(sets["test"].values())), width, height)
    print(f"{arguments.run.name} at {width}x{height}, median of {arguments.frames}")
    if arguments.frames:
        times(arguments, scenes["quantised"], camera, CASES)
    if arguments.frames and torch.cuda.is_available():
        cuda_times(arguments, camera)
    compare(arguments, model, scenes)
    if arguments.forms:
        times(arguments, scenes["quantised"], camera, FORMS)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
