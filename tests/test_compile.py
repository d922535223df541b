"""Kernels compile for CUDA without a GPU, for NVRTC comes with Warp (CI has no GPU).

Those of the usual K for sm_90, all of them with `-m slow`; for sm_80, where only atomics differ, those of K = 2.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import warp as wp

from nexwarp.kernels.catalogue import all_kernels
from nexwarp.kernels.types import MAX_HITS

USUAL_HITS = (0, 1, 2, 4, MAX_HITS)


@pytest.mark.parametrize(
    ("arch", "max_hits"),
    [(80, (2,)), (90, USUAL_HITS), pytest.param(90, range(MAX_HITS + 1), marks=pytest.mark.slow)],
)
def test_every_kernel_compiles_for_cuda(arch: int, max_hits: Sequence[int], tmp_path: Path) -> None:
    kernels = list(all_kernels(max_hits=max_hits))
    assert len({kernel.module.name for kernel in kernels}) == len(kernels), "kernels share a module"

    def compile_one(kernel: wp.Kernel) -> int:
        folder = tmp_path / kernel.module.name
        wp.compile_aot_module(kernel.module, arch=arch, module_dir=str(folder), strip_hash=True, use_ptx=False)
        return sum(path.stat().st_size for path in folder.glob("*.cubin"))

    with ThreadPoolExecutor(2) as pool:
        sizes = list(pool.map(compile_one, kernels))
    assert all(size > 1000 for size in sizes), "a kernel left no machine code"
