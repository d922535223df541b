"""Launches that use every CPU core: a CPU launch is a serial loop that frees the GIL, so threads share the range.

A chunk's threads write what no other chunk's do, so that nothing depends on how many chunks there are.
"""

import contextlib
import ctypes
import functools
import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import warp as wp

# Chunks at most where some take much longer than others, or a few for each core where there are many: those that finish
# early take over what is left.
CHUNKS = 16
CHUNKS_A_THREAD = 4
# Where all take alike: handing out a chunk costs 9 us, during which no other thread can do so.
EVEN_CHUNKS_A_THREAD = 2
# Handing out a chunk costs as much as some hundred threads of a kernel that does little.
LIGHT_CHUNK = 4096
LAUNCH_THREADS = 256  # of a block on a GPU, where a kernel does not need another number
MOST_LOADERS = 4  # threads that compile: eight were hardly faster, for Warp generates code in one at a time


@dataclass(frozen=True)
class Sharing:
    """How CPU threads share a launch out."""

    smallest: int = LIGHT_CHUNK  # what one thread is given at least
    align: int = 1  # runs of this many neighbours stay in one thread, since they write to the same place
    even: bool = True  # whether equal parts of the range take about equally long


LIGHT, UNEVEN = Sharing(), Sharing(even=False)

_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def set_num_threads(count: int) -> None:
    """Set how many CPU threads kernels use (all cores at first); results do not depend on it."""
    global _threads
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    _threads = count


def get_num_threads() -> int:
    """Return how many CPU threads kernels use."""
    return _threads


@functools.lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="nexwarp")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork


def chunks(dim: int, align: int, smallest: int, most: int) -> list[tuple[int, int]]:
    """Split [0, dim) into at most `most` ranges of at least `smallest`, at multiples of `align`."""
    size = max(smallest, -(-dim // most))
    size = -(-size // align) * align
    return [(first, min(first + size, dim)) for first in range(0, dim, size)]


def _share(part: Callable[[tuple[int, int]], None], ranges: list[tuple[int, int]]) -> None:
    """Do all ranges, this thread and the pool's taking the next one in turns."""
    waiting = iter(ranges)  # next() of it is atomic

    def work() -> None:
        for bounds in waiting:
            part(bounds)

    helpers = [_pool(_threads - 1).submit(work) for _ in range(min(_threads, len(ranges)) - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            helper.result()


_loading: dict[wp.Module, Future[None]] = {}


def load_ahead(kernels: Iterable[tuple[wp.Kernel, int]], device: str) -> None:
    """Load kernels for launches with so many threads a block, in the background; a launch waits for its own.

    A kernel that cannot be loaded raises when it is launched.
    """
    tasks = []
    for kernel, block_dim in kernels:
        if kernel.module not in _loading:
            _loading[kernel.module] = future = Future()
            tasks.append((kernel.module, block_dim, future))
    waiting = iter(tasks)

    def work() -> None:
        for module, block_dim, future in waiting:
            if not threading.main_thread().is_alive():  # the process ends
                return
            if future.set_running_or_notify_cancel():
                try:
                    with contextlib.suppress(Exception):
                        wp.load_module(module=module, device=device, block_dim=None if device == "cpu" else block_dim)
                finally:
                    future.set_result(None)
                    _loading.pop(module, None)

    for _ in range(min(_threads, MOST_LOADERS, len(tasks))):
        with contextlib.suppress(RuntimeError):  # no more threads: launches load
            threading.Thread(target=work, name="nexwarp loading").start()


def _await_load(module: wp.Module) -> None:
    """Wait for the thread that loads a module ahead; one that none has begun with is left to the caller."""
    future = _loading.get(module)
    if future is not None:
        if not future.cancel():
            future.result()
        _loading.pop(module, None)


def _stop_loading() -> None:
    futures = list(_loading.values())
    _loading.clear()
    for future in [future for future in futures if not future.cancel()]:
        future.result()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_stop_loading)  # what a thread holds would stay held in the child


class _Command:
    """A kernel's launch that is made once and done again with other arguments, faster than by `wp.launch`.

    Nothing that it was launched with is kept.
    """

    def __init__(
        self, kernel: wp.Kernel, shape: tuple[int, ...], values: list[Any], stream: wp.Stream, block_dim: int
    ) -> None:
        self.shape = shape
        _await_load(kernel.module)
        command: Any = wp.launch(
            kernel, shape, inputs=values, device=stream.device, block_dim=block_dim, record_tape=False, record_cmd=True
        )
        self.command = command
        self.kinds = [type(param) for param in command.params]
        self.nulls: dict[int, Any] = {}
        command.fwd_args = None
        for i, param in enumerate(command.params):
            if i and isinstance(param, (ctypes.Structure, ctypes.Array)):
                command.params[i] = None

    def launch(self, shape: tuple[int, ...], values: list[Any], stream: wp.Stream) -> None:
        """Launch over `shape` with other arguments."""
        command = self.command
        if shape != self.shape:
            command.set_dim(shape)
            self.shape = shape
        params, addresses = command.params, command.params_addr
        for i, value in enumerate(values, 1):
            if type(value) in (int, float):
                params[i].value = value
            elif type(value) is self.kinds[i]:
                addresses[i] = ctypes.addressof(value)
            elif value is None:
                if i not in self.nulls:
                    self.nulls[i] = self.kinds[i]()
                addresses[i] = ctypes.addressof(self.nulls[i])
            else:
                command.set_param_at_index(i - 1, value)
        command.launch(stream)


_commands: dict[tuple[wp.Kernel, str, int], _Command] = {}
_commands_lock = threading.Lock()


def _launch_again(
    kernel: wp.Kernel, shape: tuple[int, ...], values: list[Any], stream: wp.Stream, block_dim: int
) -> None:
    """Launch on a GPU by the kernel's command. Threads take turns: a command's arguments are its own."""
    key = (kernel, stream.device.alias, block_dim)
    with _commands_lock:
        command = _commands.get(key)
        if command is None:
            command = _commands[key] = _Command(kernel, shape, values, stream, block_dim)
        command.launch(shape, values, stream)


def launch(
    kernel: wp.Kernel,
    dim: int | tuple[int, int],
    arguments: Sequence[Any],
    stream: wp.Stream | None,
    *,
    block_dim: int = LAUNCH_THREADS,
    sharing: Sharing = LIGHT,
) -> None:
    """Launch a kernel, whose arguments are `first` and these, over the leading dimension of `dim`.

    It goes to a stream of a GPU, with blocks of `block_dim` threads, or, without one, to the CPU.
    """
    shape = (dim,) if isinstance(dim, int) else tuple(dim)
    if min(shape) == 0:
        return
    if stream is not None:
        _launch_again(kernel, shape, [0, *arguments], stream, block_dim)
        return

    _await_load(kernel.module)

    def part(bounds: tuple[int, int]) -> None:
        first, last = bounds
        here = (last - first, *shape[1:])
        wp.launch(kernel, here, [first, *arguments], device="cpu", record_tape=False)

    most = EVEN_CHUNKS_A_THREAD * _threads if sharing.even else max(CHUNKS, CHUNKS_A_THREAD * _threads)
    split = chunks(shape[0], sharing.align, sharing.smallest, most)
    ranges = split if len(shape) == 1 else [(i, i + 1) for i in range(shape[0])]
    if _threads == 1 or len(ranges) == 1:
        for bounds in ranges:
            part(bounds)
        return
    # Loading inside the threads would compile twice.
    wp.load_module(module=kernel.module, device="cpu")
    _share(part, ranges)
