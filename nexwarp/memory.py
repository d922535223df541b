"""How much memory there is, and how much an error of torch or Warp says was missing."""

import ctypes
import functools
import os
import re
import sys
from pathlib import Path

import torch

from nexwarp.errors import UNKNOWN, OutOfMemoryError

ALLOCATION = re.compile(r"(?:tried|failed|unable) to allocate ([\d.]+ ?(?:[KMGT]iB|bytes))", re.I)

# Of CUDA's own calls, and of its libraries, which do not say how much they wanted.
EXHAUSTED = re.compile(
    r"CUDA (driver )?error:? .*out of memory|_ALLOC_FAILED|cudaErrorMemoryAllocation|bad_alloc", re.I
)


# Parameters of glibc's mallopt.
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4


@functools.cache
def keep_freed_memory() -> None:
    """Let glibc keep freed memory for reuse, up to 2 GiB, for work on a CPU; the first call counts.

    Each rendering allocates the same blocks again. glibc would get those of over 32 MiB from the system each time,
    page by page, which takes a third of a frame's time. NEXWARP_KEEP_MEMORY=0 in the environment leaves glibc as it
    is. No effect with other C libraries.
    """
    if not sys.platform.startswith("linux") or os.environ.get("NEXWARP_KEEP_MEMORY") == "0":
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    for parameter, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1), (M_TOP_PAD, 64 * 2**20)):
        mallopt(parameter, value)


def available_memory() -> int:
    """Free memory for this process in bytes: that of the machine or of its control group, whichever is smaller."""
    import psutil

    free = int(psutil.virtual_memory().available)
    group = Path("/sys/fs/cgroup")
    try:
        limit = (group / "memory.max").read_text().strip()
        if limit != "max":
            used = int((group / "memory.current").read_text())
            stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
            free = min(free, int(limit) - used + int(stat.get("inactive_file", 0)))
    except (OSError, ValueError):  # no control groups of version 2
        pass
    return max(free, 0)


def needed_memory(error: BaseException) -> str | None:
    """Return what an error of torch or Warp says of the memory that it did not get; None for other errors."""
    if not isinstance(error, (MemoryError, RuntimeError)):
        return None
    if isinstance(error, OutOfMemoryError):
        return error.needed
    match = ALLOCATION.search(str(error))
    if match is not None:
        return _readable(match[1])
    exhausted = isinstance(error, (MemoryError, torch.OutOfMemoryError)) or EXHAUSTED.search(str(error))
    return UNKNOWN if exhausted else None


def _readable(amount: str) -> str:
    match = re.fullmatch(r"(\d+) ?bytes", amount, re.I)
    if match is None:
        return amount
    size = int(match[1])
    return f"{size / 2**30:.2f} GiB" if size >= 2**30 else f"{size / 2**20:.2f} MiB"
