"""Compiles what most tests on a CPU use, on a second core beside the first of them; see `conftest`.

python -m tests.compile_ahead      # fills Warp's cache
"""

from collections.abc import Iterator

import torch
import warp as wp

from nexwarp.kernels import launch
from nexwarp.kernels.catalogue import thread_kernels
from nexwarp.kernels.cpu.collect import collect_simd_backward_kernel, collect_simd_kernel
from nexwarp.ops.tiles import TILE_SIZE
from nexwarp.run.warmup import Build, compile_all

HITS = (2, 0, 1, 8, 4)


def builds() -> Iterator[Build]:
    """Yield kernels."""
    for real in (wp.float32, wp.float64):
        for kernel in thread_kernels(real, real, TILE_SIZE, cpu=True):
            yield Build(kernel, 1)
        for hits in HITS:
            for low_pass in (False, True):
                yield Build(collect_simd_kernel(real, hits, low_pass, TILE_SIZE), 1)
                yield Build(collect_simd_backward_kernel(real, hits, low_pass, TILE_SIZE, False), 1)


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    launch.set_num_threads(1)
    compile_all(builds(), torch.device("cpu"))
