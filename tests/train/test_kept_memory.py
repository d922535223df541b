"""Freed memory stays with a process that renders on a CPU, large blocks too, unless the environment says otherwise."""

import sys
from pathlib import Path
from typing import Any

import pytest

from tests.subprocesses import run_python

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
    changes: dict[str, Any] = {} if value is None else {"NEXWARP_KEEP_MEMORY": value}
    done = run_python("-c", SCRIPT, **changes)
    assert (int(done.stdout) < 2000) == (kept or huge_pages())  # of 19,532 pages
