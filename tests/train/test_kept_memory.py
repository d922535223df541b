"""Freed memory stays with a process that renders on a CPU, large blocks too, unless the environment says otherwise."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.subprocesses import python_path

ROOT = Path(__file__).parents[2]
# Blocks as large as those of a frame of 480x320, which glibc maps anew each time, and the fewest page faults of one: a
# kept block may have been taken in part by a small one, so that the next large one is new.
SCRIPT = """
import resource
from nexwarp.machine import keep_freed_memory
import torch
keep_freed_memory()
faults = []
for _ in range(6):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.empty(20_000_000).fill_(1.0)
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(min(faults))
"""


def huge_pages() -> bool:
    """Whether the system maps large blocks in pages of 2 MiB, which are few."""
    setting = Path("/sys/kernel/mm/transparent_hugepage/enabled")
    return setting.is_file() and "[always]" in setting.read_text()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only glibc is told to keep memory")
@pytest.mark.parametrize(("value", "kept"), [(None, True), ("0", False)])
def test_large_blocks_are_not_mapped_anew(value: str | None, kept: bool) -> None:
    environment = os.environ | python_path(ROOT) | ({} if value is None else {"NEXWARP_KEEP_MEMORY": value})
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True)
    assert (int(done.stdout) < 2000) == (kept or huge_pages())  # of 19,532 pages
