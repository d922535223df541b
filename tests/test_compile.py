"""Kernels compile for CUDA without a GPU, for NVRTC comes with Warp (CI has no GPU).

For sm_90 those of the usual K, for sm_80, where only atomics differ, a default run's; all of them with `-m slow`.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import warp as wp

from nexwarp.kernels.catalogue import all_kernels, thread_kernels, walk_kernels
from nexwarp.kernels.types import MAX_HITS
from nexwarp.ops.tiles import TILE_SIZE


def usual() -> Iterator[wp.Kernel]:
    return all_kernels(max_hits=(*range(5), MAX_HITS))


def one_run() -> Iterator[wp.Kernel]:
    few = {"degrees": (3,), "features": (2, 4), "clamps": (False,), "low_passes": (False,), "ssim_lanes": (1,)}
    yield from thread_kernels(wp.float32, wp.float16, TILE_SIZE, **few)
    yield from walk_kernels(wp.float32, TILE_SIZE, (2,), low_passes=(False,))


@pytest.mark.parametrize(
    ("arch", "chosen"),
    [(80, one_run), (90, usual), *(pytest.param(arch, all_kernels, marks=pytest.mark.slow) for arch in (80, 90))],
)
def test_kernels_compile_for_cuda(arch: int, chosen: Callable[[], Iterator[wp.Kernel]], tmp_path: Path) -> None:
    kernels = list(chosen())
    assert len({kernel.module.name for kernel in kernels}) == len(kernels), "kernels share a module"

    def compile_one(kernel: wp.Kernel) -> int:
        folder = tmp_path / kernel.module.name
        wp.compile_aot_module(kernel.module, arch=arch, module_dir=str(folder), strip_hash=True, use_ptx=False)
        return sum(path.stat().st_size for path in folder.glob("*.cubin"))

    with ThreadPoolExecutor(2) as pool:
        sizes = list(pool.map(compile_one, kernels))
    assert all(size > 1000 for size in sizes), "a kernel left no machine code"
