"""Compiling ahead of time: fill Warp's kernel cache with all that training and rendering with some settings need.

First the catalogue's kernels, several at a time. Then a tiny training, an evaluation and a rendering really run: they
compile whatever the catalogue lacks, so that it can cost time but leave nothing out.
"""

import dataclasses
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import torch
import warp as wp

from nexwarp.camera import Camera
from nexwarp.data import Scene, View
from nexwarp.kernels.catalogue import thread_kernels, walk_kernels
from nexwarp.kernels.launch import get_num_threads
from nexwarp.kernels.ssim import SIMD_WIDTH
from nexwarp.kernels.walk import BLOCK_DIM
from nexwarp.ops.tiles import TILE_SIZE
from nexwarp.run.evaluate import evaluate
from nexwarp.train.config import REFERENCE_ITERATIONS, Config
from nexwarp.train.floaters import floaters
from nexwarp.train.trainer import Trainer

BINARIES = (".o", ".cubin", ".ptx")

WIDTH, HEIGHT, POINTS = 64, 48, 100

ITERATIONS = 8


class Build(NamedTuple):
    """A kernel, and how many threads a block it is launched with: on CUDA it is compiled for that number."""

    kernel: wp.Kernel
    block_dim: int


def needed(config: Config, device: torch.device) -> list[Build]:
    """Return the catalogue's kernels that settings need on a device."""
    textured, cpu = config.max_hits > 0, device.type == "cpu"
    alone = thread_kernels(
        wp.float32,
        wp.float32 if cpu else wp.float16,
        TILE_SIZE,
        degrees=range(config.sh_degree + 1),
        features=(config.texture.features,) * textured,
        clamps=(config.clamp_texture,) * textured,
        low_passes=(config.low_pass,),
        ssim_lengths=(SIMD_WIDTH if cpu else 1,),
        cpu=cpu,
        fixed_point=config.deterministic,
    )
    low_passes = (config.low_pass,)
    hits, fixed = {config.hits_at(0), config.max_hits}, config.deterministic
    if config.densify.floaters or config.footprints:
        hits.add(max(config.max_hits, 1))  # which a look for them tells by, and one at the end for footprints
    walks = walk_kernels(wp.float32, TILE_SIZE, sorted(hits), low_passes=low_passes, cpu=cpu, fixed_point=fixed)
    return [*(Build(kernel, 256) for kernel in alone), *(Build(kernel, BLOCK_DIM) for kernel in walks)]


def compile_all(builds: Iterable[Build], device: torch.device, done: Callable[[], None] | None = None) -> None:
    """Compile kernels, or load them from the cache, in as many threads as kernels may use.

    Threads as in `wp.force_load`, which cannot tell how far it is. The compilers work without the GIL, but NVRTC parses
    one program at a time: two threads save a third of the time on a CPU, and a tenth on CUDA.

    Args:
        builds: what to compile.
        device: where it will run.
        done: called, in this thread, when one more is there.
    """
    name = "cpu" if device.type == "cpu" else f"cuda:{device.index or 0}"
    wp.synchronize_device(name)  # makes the device's context, which threads must not race for

    def load(build: Build) -> None:
        wp.load_module(build.kernel.module, device=name, block_dim=build.block_dim)

    with ThreadPoolExecutor(get_num_threads()) as pool:
        for _ in pool.map(load, builds):
            if done is not None:
                done()


def rehearse(config: Config, device: torch.device) -> None:
    """Train for a few steps, evaluate and render, with these settings on a tiny scene; seeds the generators as a run.

    The steps go through every SH degree, both photo sizes, rounds of density control and steps after the last one, in
    the order of a real run; and looks for floaters.
    """
    scene = tiny_scene()
    trainer = Trainer(scene, tiny(config), device)
    trainer.run()
    if config.densify.floaters:
        floaters(trainer.model(), trainer.views.cameras, [1.0], torch.Generator())
    model = trainer.finish()
    evaluate(model, scene.test)
    with torch.no_grad():
        out = model.render(scene.test[0].camera)
        out.splat_error(out.alpha)


def tiny(config: Config) -> Config:
    """Shorten a run to `ITERATIONS`, and shrink what no kernel is compiled for."""
    step = REFERENCE_ITERATIONS // ITERATIONS  # iterations of a full run that stand for one of these
    return dataclasses.replace(
        config,
        iterations=ITERATIONS,
        max_surfels=POINTS,
        sh_every=2 * step,  # 0 1 1 2 2 3 3 3
        coarse=0.5,
        texture=dataclasses.replace(config.texture, table_size=2**10),
        densify=dataclasses.replace(config.densify, start=0, every=3, stop=ITERATIONS * step),
    )


def tiny_scene() -> Scene:
    """Make two photos of noise, one of them for testing, and points before them."""
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
    """Return what lies compiled in Warp's cache."""
    wp.init()  # finds out where the cache is
    return {path for path in Path(wp.config.kernel_cache_dir).glob("*/*") if path.suffix in BINARIES}
