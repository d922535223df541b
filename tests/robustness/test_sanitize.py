"""Small training steps, frames and renderings of odd sizes; for compute-sanitizer, which checks every access on a GPU.

    export NEXWARP_SANITIZE=1 PYTORCH_NO_CUDA_MEMORY_CACHING=1
    compute-sanitizer --error-exitcode 1 --tool memcheck python -m pytest -m cuda tests/robustness/test_sanitize.py

after a run without it, which compiles the kernels; `pip install nvidia-cuda-sanitizer-api==13.5.25` has it (racecheck
of CUDA 13.0 fails). For racecheck add `--kernel-name kernel_substring=_cuda_kernel_`: it is slow, and false of others'
kernels. The allocators of torch and Warp reuse freed memory, which hides an access beyond the end of an array: with the
variables each array is an allocation of its own, and products of matrices keep from cuBLAS, whose writes initcheck does
not see.
"""

import dataclasses
import os
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import pytest
import torch
import warp as wp

import nexwarp as nw
from tests.rehearsal import tiny_scene
from tests.render_support import loss
from tests.scenes import make_camera, make_surfels, make_texture, random_scene

# Iterations of a full run: all degrees of spherical harmonics, then a step with a density round.
ITERATIONS = (10_001, 10_100)
# One pixel, less than a tile, whole tiles, a row, and parts of tiles in both directions.
SIZES = ((1, 1), (17, 33), (31, 7), (16, 16), (50, 1), (5, 64), (33, 47))


@contextmanager
def plain_products() -> Iterator[None]:
    """Multiply matrices by torch's own kernels."""
    original = torch.Tensor.__matmul__

    def matmul(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        if min(a.dim(), b.dim()) < 2:
            return original(a, b)
        wide = torch.promote_types(a.dtype, torch.float32)
        return (a.to(wide)[..., None] * b.to(wide)[..., None, :, :]).sum(-2).to(a.dtype)

    def mm(
        a: torch.Tensor, b: torch.Tensor, *, out_dtype: torch.dtype | None = None, out: torch.Tensor | None = None
    ) -> torch.Tensor:
        product = matmul(a.to(out_dtype or a.dtype), b.to(out_dtype or b.dtype))
        return product if out is None else out.copy_(product)

    def activated(bias: torch.Tensor, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (bias + matmul(a, b)).relu()

    with (
        patch.object(torch.Tensor, "__matmul__", matmul),
        patch.object(torch, "mm", mm),
        patch.object(torch, "_addmm_activation", activated),
    ):
        yield


@pytest.fixture(autouse=True)
def separate_allocations(device: torch.device) -> Iterator[None]:
    if device.type == "cpu" or "NEXWARP_SANITIZE" not in os.environ:
        yield
        return
    wp.init()
    wp.set_mempool_enabled(f"cuda:{torch.cuda.current_device()}", False)
    with plain_products():
        yield
    torch.cuda.synchronize(device)


def test_steps_and_frames_run(device: torch.device) -> None:
    scene = tiny_scene()
    base = nw.preset("default")
    texture = dataclasses.replace(base.texture, levels=8, table_size=2**10)
    densify = dataclasses.replace(base.densify, fraction=1.0, prune_opacity=0.02)
    config = dataclasses.replace(base, max_surfels=200, texture=texture, densify=densify)
    for deterministic in (False, True):
        trainer = nw.Trainer(scene, dataclasses.replace(config, deterministic=deterministic), device)
        for iteration in ITERATIONS:
            trainer.iteration = iteration - 1
            trainer.step()
        trainer.check()
    model = trainer.model()
    camera = scene.test[0].camera.to(device)
    with torch.no_grad():
        for view in (camera, camera.crop(-5, 7, 33, 50)):
            out = model.render(view)
            out.splat_error(out.alpha)
            assert bool(torch.isfinite(out.image).all())


def test_renderings_of_odd_sizes_run(device: torch.device) -> None:
    texture = make_texture(device=device)
    for max_hits in range(9) if device.type == "cuda" else (2,):  # all K where kernels are compiled in seconds
        for width, height in SIZES:
            scene = random_scene(60, seed=max_hits, device=device)
            surfels, camera = make_surfels(scene), make_camera(scene, width=width, height=height)
            out = nw.render(surfels, texture, camera, max_hits=max_hits)
            (loss(out) + out.expected_depth.sum() + out.median_depth.sum() + out.normals.sum()).backward()
            assert all(x.grad is None or bool(torch.isfinite(x.grad).all()) for x in surfels.parameters())
