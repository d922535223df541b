"""Small training steps, frames and renderings of odd sizes under compute-sanitizer, which checks every access.

    python -m tests.robustness.sanitize --tool memcheck,racecheck,initcheck,synccheck

runs itself under each tool, prints a line for each, and exits with 1 when a tool found an error, with 2 when there is
no compute-sanitizer (`pip install nvidia-cuda-sanitizer-api==13.5.25`; racecheck of CUDA 13.0, 2025.3, fails).

The allocators of torch and Warp reuse freed memory, which hides an access beyond the end of an array. So each array is
an allocation of its own here.
"""

import argparse
import dataclasses
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from unittest.mock import patch

import torch
import warp as wp

import nexwarp as nw
from nexwarp.run import warmup
from nexwarp.train.recipe import preset
from nexwarp.train.trainer import Trainer
from tests.render_support import loss
from tests.scenes import make_camera, make_surfels, make_texture, random_scene

TOOLS = ("memcheck", "racecheck", "initcheck", "synccheck")
# Iterations of a full run: all degrees of spherical harmonics, then a step with a density round.
ITERATIONS = (10_001, 10_100)
# One pixel, less than a tile, whole tiles, a row, and parts of tiles in both directions.
SIZES = ((1, 1), (17, 33), (31, 7), (16, 16), (50, 1), (5, 64), (33, 47))
PLACES = ("nvidia/cu13/compute-sanitizer", "nvidia/cuda_sanitizer_api/bin")  # of the package, below site-packages
# Racecheck checks shared memory; restricted to our kernels, since others are slow to check and give false reports.
OURS = ("--kernel-name", "kernel_substring=_cuda_kernel_")
SUMMARY = re.compile(r"^=+ (?:RACECHECK SUMMARY: .*\(|ERROR SUMMARY: )(\d+) errors?", re.M)
SHOWN = 60  # lines of a report that found errors


def errors_in(output: str) -> int | None:
    """Number of errors that compute-sanitizer tells, of one process or several; None without a summary."""
    found = SUMMARY.findall(output)
    return sum(map(int, found)) if found else None


def find_tool() -> str | None:
    """Return the path of compute-sanitizer, installed by pip or on the PATH; None without one."""
    folders = [str(Path(folder) / place) for folder in sys.path for place in PLACES]
    return shutil.which("compute-sanitizer", path=os.pathsep.join([*folders, os.environ.get("PATH", "")]))


def train_and_render(device: torch.device) -> None:
    """Train, as by default and with fixed-order sums, and render."""
    scene = warmup.tiny_scene()
    base = preset("default")
    config = dataclasses.replace(
        base,
        max_surfels=200,
        texture=dataclasses.replace(base.texture, levels=8, table_size=2**10),
        densify=dataclasses.replace(base.densify, fraction=1.0, prune_opacity=0.02),
    )
    for deterministic in (False, True):
        trainer = Trainer(scene, dataclasses.replace(config, deterministic=deterministic), device)
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


def render_odd_sizes(device: torch.device, hits: Sequence[int]) -> None:
    """Render each K and size with all its buffers and gradients."""
    texture = make_texture(device=device)
    for max_hits in hits:
        for width, height in SIZES:
            scene = random_scene(60, seed=max_hits, device=device)
            surfels, camera = make_surfels(scene), make_camera(scene, width=width, height=height)
            out = nw.render(surfels, texture, camera, max_hits=max_hits)
            (loss(out) + out.expected_depth.sum() + out.median_depth.sum() + out.normals.sum()).backward()
            assert all(x.grad is None or bool(torch.isfinite(x.grad).all()) for x in surfels.parameters())


@contextmanager
def plain_products() -> Iterator[None]:
    """Multiply matrices by torch's own kernels: initcheck does not see what cuBLAS writes on a Hopper GPU."""
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


def clean(tool: str, command: Sequence[str]) -> bool:
    """Run a command under a tool, print its result, and return whether it ended without an error."""
    run = subprocess.run(
        [*command[:1], "--tool", tool, *(OURS if tool == "racecheck" else ()), *command[1:]],
        env=os.environ | {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )
    errors = errors_in(run.stdout)
    good = errors == 0 and run.returncode == 0
    print(f"{tool}: {errors} errors, exit code {run.returncode}: {'clean' if good else 'NOT CLEAN'}")
    if not good:
        print("\n".join(run.stdout.splitlines()[:SHOWN]), flush=True)
    return good


def run_under(tools: Sequence[str]) -> int:
    sanitizer = find_tool()
    if sanitizer is None or not set(tools) <= set(TOOLS):
        print(f"expected compute-sanitizer on the PATH and tools of {TOOLS}, got {sanitizer}, {tools}", file=sys.stderr)
        return 2
    command = [sys.executable, "-m", "tests.robustness.sanitize"]
    # Once without a tool, to compile all kernels and to see that the work runs at all.
    subprocess.run(command, check=True)
    plain = ["--plain-products"]
    results = [clean(tool, [sanitizer, *command, *(plain if tool == "initcheck" else [])]) for tool in tools]
    return 0 if all(results) else 1


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.robustness.sanitize", description="Needs a GPU.")
    parser.add_argument("--tool", help="tools of compute-sanitizer to run this under, with commas; default: none")
    parser.add_argument("--plain-products", action="store_true", help="multiply matrices without cuBLAS")
    options = parser.parse_args()
    if options.tool:
        return run_under(options.tool.split(","))
    wp.config.log_level = wp.LOG_ERROR
    device = torch.device("cuda", torch.cuda.current_device())
    os.environ["PYTORCH_NO_CUDA_MEMORY_CACHING"] = "1"  # each array is an allocation of its own
    wp.init()
    wp.set_mempool_enabled(f"cuda:{device.index}", False)
    with plain_products() if options.plain_products else nullcontext():
        train_and_render(device)
        render_odd_sizes(device, range(9))
    torch.cuda.synchronize(device)
    return 0


if __name__ == "__main__":
    sys.exit(main())
