"""Kernels compile for CUDA without a GPU, for NVRTC comes with Warp (CI has no GPU).

For sm_90 those of the usual K, for sm_80, where only atomics differ, a default run's; all of them with `-m slow`.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def compiled(folder: Path, arch: int, choice: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "error", "-m", "tests.compile_cuda", str(arch), choice, str(folder)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("arch", "least"),
    [
        pytest.param(80, 30, marks=pytest.mark.background_job(compiled, 80, "one run")),
        pytest.param(90, 100, marks=pytest.mark.background_job(compiled, 90, "usual")),
        *(
            pytest.param(arch, 150, marks=[pytest.mark.background_job(compiled, arch, "all"), pytest.mark.slow])
            for arch in (80, 90)
        ),
    ],
)
def test_kernels_compile_for_cuda(arch: int, least: int, background_job: subprocess.CompletedProcess[str]) -> None:
    assert background_job.returncode == 0, background_job.stderr
    sizes = json.loads(background_job.stdout.splitlines()[-1])
    assert len(sizes) >= least
    assert all(size > 1000 for size in sizes.values()), "a kernel left no machine code"
