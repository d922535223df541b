"""Kernels compile for CUDA without a GPU, for NVRTC comes with Warp (CI has no GPU).

For sm_90 each branch of them; for sm_80 those whose atomics differ from sm_90's; all of them for both with `-m slow`.
"""

import json
from pathlib import Path

import pytest

from nexwarp.kernels.launch import MOST_LOADERS
from tests.compile_cuda import kernels
from tests.subprocesses import run_python


@pytest.mark.long
@pytest.mark.parametrize(
    ("arch", "choice", "least"),
    [
        (80, "atomic", 7),
        (90, "usual", 70),
        *(pytest.param(arch, "all", 120, marks=pytest.mark.slow) for arch in (80, 90)),
    ],
)
def test_kernels_compile_for_cuda(arch: int, choice: str, least: int, tmp_path: Path) -> None:
    done = run_python("-W", "error", "-m", "tests.compile_cuda", arch, choice, tmp_path)
    assert done.returncode == 0, done.stderr
    sizes = json.loads(done.stdout.splitlines()[-1])
    assert len(sizes) >= least
    assert all(size > 1000 for size in sizes.values()), "a kernel left no machine code"


def test_no_kernel_is_generated_to_be_hashed() -> None:
    """As Warp does where wp.static holds a loop's number: it took 0.3 s at each start for D-SSIM."""
    assert not [kernel.key for kernel in kernels("usual") if kernel.adj.has_unresolved_static_expressions]


ENDS_WHILE_LOADING = """
import nexwarp as nw
from nexwarp.kernels import launch
from nexwarp.train.stages import load_kernels

load_kernels(nw.Config(), "cpu")
while not any(future.running() for future in list(launch._loading.values())):
    pass
"""


def test_a_process_that_ends_compiles_no_more(tmp_path: Path) -> None:
    done = run_python("-c", ENDS_WHILE_LOADING, WARP_CACHE_PATH=str(tmp_path))
    assert done.returncode == 0 and 1 <= len([*tmp_path.glob("*/wp_*")]) <= 2 * MOST_LOADERS, done.stderr
