"""Compiles kernels for CUDA, GPU or not: NVRTC comes with Warp.

python -m tests.compile_cuda 90 usual FOLDER      # prints the size of the machine code by module, as JSON
"""

import json
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import warp as wp

from nexwarp.kernels.catalogue import all_kernels, fused_kernel_builds, ssim_tile_builds, thread_kernels, walk_kernels
from nexwarp.kernels.types import MAX_HITS
from nexwarp.ops.tiles import TILE_SIZE


def usual() -> Iterator[wp.Kernel]:
    """Yield those of the usual K."""
    return all_kernels(max_hits=(*range(5), MAX_HITS))


def one_run() -> Iterator[wp.Kernel]:
    """Yield those of a default run."""
    yield from thread_kernels(
        wp.float32,
        wp.float16,
        TILE_SIZE,
        degrees=(3,),
        features=(2, 4),
        clamps=(False,),
        low_passes=(False,),
        ssim_lengths=(),
    )
    yield from walk_kernels(wp.float32, TILE_SIZE, (2,), low_passes=(False,))
    yield from (kernel for kernel, _ in (*fused_kernel_builds((4,)), *ssim_tile_builds()))


CHOICES = {"all": all_kernels, "usual": usual, "one run": one_run}


def compile_for(arch: int, kernels: list[wp.Kernel], folder: Path) -> dict[str, int]:
    """Return bytes of machine code by module."""

    def compile_one(kernel: wp.Kernel) -> int:
        where = folder / kernel.module.name
        wp.compile_aot_module(kernel.module, arch=arch, module_dir=str(where), strip_hash=True, use_ptx=False)
        return sum(path.stat().st_size for path in where.glob("*.cubin"))

    with ThreadPoolExecutor(2) as pool:
        return dict(zip((kernel.module.name for kernel in kernels), pool.map(compile_one, kernels), strict=True))


if __name__ == "__main__":
    arch, choice, folder = sys.argv[1:]
    wp.config.log_level = wp.LOG_ERROR
    chosen = list(CHOICES[choice]())
    if len({kernel.module.name for kernel in chosen}) != len(chosen):
        sys.exit("kernels share a module")
    print(json.dumps(compile_for(int(arch), chosen, Path(folder))))
