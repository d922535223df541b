"""Work on the columns of matrices that CPU threads share, whose bits do not depend on how many threads there are.

A BLAS chooses how it divides a product, and so in which order it adds up, by the number of its threads. Here the parts
are fixed, and each is worked on by one thread of torch and its BLAS.
"""

import functools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch

from nexwarp.kernels import launch as launching

# Columns that one part has at least, and what parts begin at multiples of. Small parts stay in a core's cache from one
# layer to the next; what they add up does not depend on the number of threads, so their number must not either.
SMALLEST_PART, ALIGN, MOST_PARTS = 2048, 16, 64


def share_columns(count: int, part: Callable[[int, slice], None]) -> None:
    """Call `part(index, columns)` for fixed parts of `count` columns, several at a time, without gradients."""
    # A mode of torch holds in one thread alone.
    inference = torch.is_inference_mode_enabled()

    def work(numbered: tuple[int, slice]) -> None:
        with torch.inference_mode(inference), torch.no_grad():
            part(*numbered)

    for _ in _pool(launching.get_num_threads()).map(work, enumerate(_parts(count))):
        pass


def parts_of(count: int) -> int:
    """Number of parts of `count` columns."""
    return len(_parts(count))


def _parts(count: int) -> list[slice]:
    return [slice(*bounds) for bounds in launching.chunks(count, ALIGN, SMALLEST_PART, MOST_PARTS)]


@functools.lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads, all of them started, in which torch and its BLAS use one thread each."""
    started = threading.Barrier(threads + 1)

    def begin() -> None:
        # Asked first, as a thread that never was takes over the number of the others when it begins to work.
        torch.get_num_threads()
        # Holds in the calling thread alone, but is also what threads made later begin with: so it is undone below.
        torch.set_num_threads(1)
        started.wait()

    before = torch.get_num_threads()
    pool = ThreadPoolExecutor(threads, "columns", initializer=begin)
    for _ in range(threads):
        pool.submit(int)
    started.wait()
    torch.set_num_threads(before)
    return pool


def _after_fork() -> None:
    """Forget the parent's threads, which do not survive a fork, and let torch do without them.

    OpenMP, which shares out torch's own loops, waits forever in the child of a process that has used it.
    """
    _pool.cache_clear()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
