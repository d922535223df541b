"""Compiles kernels for CUDA, GPU or not: NVRTC comes with Warp.

python -m tests.compile_cuda 90 usual FOLDER      # prints the size of the machine code by module, as JSON
"""

import json
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import warp as wp

from nexwarp.kernels.catalogue import all_kernels, walk_kernels
from nexwarp.kernels.fused_scatter import fused_scatter_kernel
from nexwarp.kernels.hashgrid import hashgrid_kernels
from nexwarp.kernels.types import MAX_HITS
from nexwarp.ops.tiles import TILE_SIZE


def usual() -> Iterator[wp.Kernel]:
    """Yield all kernels for K = 2, and for other K those that depend on it, in the form of a default run.

    K and the other constants of a kernel do not depend on each other.
    """
    found = [*all_kernels(max_hits=(2,))]
    found += walk_kernels(wp.float32, TILE_SIZE, (0, 1, 3, 4, MAX_HITS), low_passes=(False,), fixed_point=False)
    yield from {kernel.module.name: kernel for kernel in found}.values()


def atomic() -> Iterator[wp.Kernel]:
    """Yield the kernels whose atomics depend on the architecture."""
    for count in (2, 4):
        for storage in (wp.float16, wp.float32):
            yield hashgrid_kernels(wp.float32, storage, count).backward
        yield fused_scatter_kernel(count)


CHOICES = {"all": all_kernels, "usual": usual, "atomic": atomic}


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
