"""Random seeds, torch's threads, and operations whose results do not depend on the order of threads."""

import hashlib
import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, cast

import numpy as np
import torch


class _DeterministicModule(Protocol):
    """The part of `torch.utils.deterministic` that is used here."""

    fill_uninitialized_memory: bool


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Run torch's own loops on `count` threads; nexwarp's kernels keep theirs.

    A thread that first uses torch inside the context keeps this number.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: how threads split a sum changes its rounding, and files must be reproducible."""
    with torch_threads(1):
        yield


@contextmanager
def deterministic(wanted: bool) -> Iterator[None]:
    """Make the results of torch's operations and of nexwarp's kernels independent of the order of threads.

    Args:
        wanted: False changes nothing.
    """
    if not wanted or torch.are_deterministic_algorithms_enabled():
        yield
        return
    # The module replaces its own class to make this a property, which torch's stubs do not declare.
    memory = cast(_DeterministicModule, torch.utils.deterministic)
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
    """Return a seed of its own for each of many series of random numbers, for `torch.Generator.manual_seed`.

    Args:
        seed: of the training.
        number: of what they are for, such as a view among all that the training sees.
        stream: number of the series.
    """
    digest = hashlib.blake2b(f"{seed} {number} {stream}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1  # manual_seed takes 63 bits
