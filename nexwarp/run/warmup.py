"""Ahead-of-time compilation: fill Warp's kernel cache with the kernels that training and rendering need.

First the kernels of the catalogue are compiled, several at a time. Then a short training, an evaluation and a rendering
run on a tiny scene and compile any kernel that the catalogue lacks. A gap in the catalogue thus costs time only.
"""

import dataclasses
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import torch
import warp as wp

from nexwarp.cameras.camera import Camera
from nexwarp.data import Scene, View
from nexwarp.kernels.catalogue import fused_kernel_builds, ssim_tile_builds, thread_kernels, walk_kernels
from nexwarp.kernels.launch import get_num_threads
from nexwarp.kernels.walk import BLOCK_DIM
from nexwarp.ops.fused_texture import supported, takes_shape
from nexwarp.ops.startup import start_warp
from nexwarp.ops.tiles import TILE_SIZE
from nexwarp.run.evaluate import evaluate
from nexwarp.train.config import REFERENCE_ITERATIONS, Config
from nexwarp.train.relocation import least_contributing
from nexwarp.train.trainer import Trainer

BINARIES = (".o", ".cubin", ".ptx")

WIDTH, HEIGHT, POINTS = 64, 48, 100

ITERATIONS = 8


class Build(NamedTuple):
    """A kernel to compile.

    Attributes:
        kernel: the kernel.
        block_dim: threads per block of its launches; CUDA binaries depend on it.
    """

    kernel: wp.Kernel
    block_dim: int


def needed(config: Config, device: torch.device) -> list[Build]:
    """Return the catalogue's kernels that training and rendering with these settings need on a device."""
    textured, cpu = config.max_hits > 0, device.type == "cpu"
    shape = config.texture
    threads = thread_kernels(
        wp.float32,
        wp.float32 if cpu else wp.float16,
        TILE_SIZE,
        degrees=range(config.sh_degree + 1),
        features=(config.texture.features,) * textured,
        clamps=(False,) * textured,
        low_passes=(False,),
        cpu=cpu,
        fixed_point=config.deterministic,
    )
    hits, fixed = {config.hits_at(0), config.max_hits}, config.deterministic
    if config.footprints:
        hits.add(max(config.max_hits, 1))  # detail limits render with K >= 1
    walks = walk_kernels(wp.float32, TILE_SIZE, sorted(hits), low_passes=(False,), cpu=cpu, fixed_point=fixed)
    builds = [*(Build(kernel, 256) for kernel in threads), *(Build(kernel, BLOCK_DIM) for kernel in walks)]
    if not cpu:
        builds += (Build(*build) for build in ssim_tile_builds())
    if textured and supported(device) and takes_shape(shape.levels, shape.features, shape.width, shape.hidden_layers):
        builds += (Build(*build) for build in fused_kernel_builds((shape.features,)))
    return builds


def compile_all(builds: Iterable[Build], device: torch.device, done: Callable[[], None] | None = None) -> None:
    """Compile kernels, or load them from the cache, in as many threads as kernels may use.

    Unlike `wp.force_load`, it reports its progress. The compilers release the GIL, but NVRTC parses one program at a
    time: two threads save a third of the time on a CPU, and a tenth on CUDA.

    Args:
        builds: the kernels to compile.
        device: the device to compile for.
        done: called in this thread after each kernel.
    """
    name = "cpu" if device.type == "cpu" else f"cuda:{device.index or 0}"
    wp.synchronize_device(name)  # creates the device's context, which the threads must not create concurrently

    def load(build: Build) -> None:
        wp.load_module(build.kernel.module, device=name, block_dim=build.block_dim)

    with ThreadPoolExecutor(get_num_threads()) as pool:
        for _ in pool.map(load, builds):
            if done is not None:
                done()


def rehearse(config: Config, device: torch.device) -> None:
    """Train for a few steps, evaluate and render on a tiny scene with these settings; seed the generators like a run.

    The steps cover every SH degree, both photo sizes, rounds of density control and steps after the last round, in the
    order of a full run. The choice of surfels to relocate runs too.
    """
    scene = tiny_scene()
    trainer = Trainer(scene, tiny(config), device)
    trainer.run()
    if config.densify.relocate:
        least_contributing(trainer.model(), trainer.views.cameras, config.densify.relocate)
    model = trainer.finish()
    evaluate(model, scene.test)
    with torch.no_grad():
        out = model.render(scene.test[0].camera)
        out.splat_error(out.alpha)


def tiny(config: Config) -> Config:
    """Return settings for `ITERATIONS` steps, with the sizes reduced that no kernel depends on."""
    step = REFERENCE_ITERATIONS // ITERATIONS  # iterations of a full run per iteration of this one
    return dataclasses.replace(
        config,
        iterations=ITERATIONS,
        max_surfels=POINTS,
        sh_every=2 * step,  # SH degrees of the steps: 0 1 1 2 2 3 3 3
        texture=dataclasses.replace(config.texture, table_size=2**10),
        densify=dataclasses.replace(config.densify, start=0, every=3, stop=ITERATIONS * step),
    )


def tiny_scene() -> Scene:
    """Make a scene of one photo of noise, for training and testing, and random points in front of its camera."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(POINTS, 3, generator=generator) * 2 - 1
    photo = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    K = torch.tensor([[WIDTH, 0.0, WIDTH / 2], [0.0, WIDTH, HEIGHT / 2], [0.0, 0.0, 1.0]])
    view = View(Camera(viewmat, K, WIDTH, HEIGHT), photo, None, "tiny.png")
    return Scene(
        train=[view],
        test=[view],
        points=points,
        colors=torch.randint(0, 256, (POINTS, 3), generator=generator, dtype=torch.uint8),
        track_lengths=torch.full((POINTS,), 3, dtype=torch.int32),
        reprojection_errors=torch.zeros(POINTS),
        scale=1.0,
        path=Path("tiny"),
    )


def cached_binaries() -> set[Path]:
    """Return the compiled kernels in Warp's cache."""
    start_warp()  # sets the folder of the cache
    return {path for path in Path(str(wp.config.kernel_cache_dir)).glob("*/*") if path.suffix in BINARIES}
