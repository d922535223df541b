"""The machine: its memory, its threads, and repeatable results on it."""

import ctypes
import functools
import hashlib
import os
import random
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from nexwarp.errors import UNKNOWN, OutOfMemoryError

Item = TypeVar("Item")
Result = TypeVar("Result")
ALLOCATION = re.compile(r"(?:tried|failed|unable) to allocate ([\d.]+ ?(?:[KMGT]iB|bytes))", re.I)

# Errors of CUDA and its libraries, which do not say how much memory they wanted.
EXHAUSTED = re.compile(
    r"CUDA (driver )?error:? .*out of memory|_ALLOC_FAILED|cudaErrorMemoryAllocation|bad_alloc", re.I
)
# Parameters of glibc's mallopt: M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD.
KEEP_FREED = {-4: 0, -1: 2**31 - 1, -2: 64 * 2**20}


@functools.cache
def keep_freed_memory() -> None:
    """Let glibc keep freed memory for reuse, up to 2 GiB, for work on a CPU; NEXWARP_KEEP_MEMORY=0 leaves it as it is.

    Each rendering allocates the same blocks again. glibc would get those of over 32 MiB from the system each time,
    page by page, which takes a third of a frame's time.
    """
    if not sys.platform.startswith("linux") or os.environ.get("NEXWARP_KEEP_MEMORY") == "0":
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    for parameter, value in KEEP_FREED.items():
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
    if (match := ALLOCATION.search(str(error))) is None:
        exhausted = isinstance(error, (MemoryError, torch.OutOfMemoryError)) or EXHAUSTED.search(str(error))
        return UNKNOWN if exhausted else None
    if (digits := re.fullmatch(r"(\d+) ?bytes", match[1], re.I)) is None:
        return match[1]
    size = int(digits[1])
    return f"{size / 2**30:.2f} GiB" if size >= 2**30 else f"{size / 2**20:.2f} MiB"


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Run torch's own loops on `count` threads; nexwarp's kernels keep theirs.

    How threads split a sum changes its rounding: what must be reproducible on any machine has one.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield what a function returns of each item, in order, by as many threads as torch has; each uses one core.

    It is for work on small tensors in CPU memory, where torch's own threads wait for each other.
    """
    count = torch.get_num_threads()
    with torch_threads(1), ThreadPoolExecutor(count) as pool:
        yield from pool.map(function, items)


@contextmanager
def deterministic(wanted: bool) -> Iterator[None]:
    """Make results of torch and of nexwarp's kernels independent of the order of threads; False changes nothing."""
    if not wanted or torch.are_deterministic_algorithms_enabled():
        yield
        return
    memory: Any = torch.utils.deterministic  # its properties are not in torch's stubs
    fill = memory.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True)
    memory.fill_uninitialized_memory = False  # every buffer is written before it is read
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)
        memory.fill_uninitialized_memory = fill


def seed_everything(seed: int) -> None:
    """Seed the global generators of Python, numpy and torch."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)


def derived_seed(seed: int, number: int, stream: int) -> int:
    """Return a seed, for `torch.Generator.manual_seed`, of its own for each number and series of a training."""
    digest = hashlib.blake2b(f"{seed} {number} {stream}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1  # manual_seed takes 63 bits
