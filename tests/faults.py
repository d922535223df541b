"""A disk, an allocator and a GPU that fail at the k-th thing asked of them; a process that dies at its k-th call."""

from __future__ import annotations

import builtins
import errno
import io
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from nexwarp.kernels import launch as launching


class Disk:
    """Counts what is asked of the disk below `folder`, and fails the `fatal`-th request (from 0), with `number`.

    A request is a file that is opened to be written, a write to it, its closing, a flush, a rename, a new folder. A
    write that fails has written half. With `lasting` every later request fails too, as on a full disk.
    """

    def __init__(self, folder: Path, fatal: int | None = None, number: int = errno.ENOSPC, lasting: bool = False):
        self.folder, self.fatal, self.number, self.lasting = folder, fatal, number, lasting
        self.requests: list[str] = []

    def ask(self, what: str, path: Any) -> None:
        if isinstance(path, int):
            path = os.readlink(f"/proc/self/fd/{path}")
        if Path(os.path.abspath(path)).is_relative_to(self.folder):
            self.requests.append(f"{what} {Path(path).name}")
            count = len(self.requests) - 1
            if self.fatal is not None and (count == self.fatal or (self.lasting and count > self.fatal)):
                raise OSError(self.number, os.strerror(self.number))


class Failing:
    """A file open to be written."""

    def __init__(self, file: Any, disk: Disk, path: Any) -> None:
        self.file, self.disk, self.path = file, disk, path

    def write(self, content: Any) -> int:
        try:
            self.disk.ask("write", self.path)
        except OSError:
            self.file.write(content[: len(content) // 2])
            raise
        return self.file.write(content)

    def close(self) -> None:
        if not self.file.closed:
            self.file.close()
            self.disk.ask("close", self.path)

    def fileno(self) -> int:
        raise io.UnsupportedOperation  # so that nobody writes past `write`

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)

    def __enter__(self) -> Failing:
        return self

    def __exit__(self, kind: Any, *_: Any) -> None:
        (self if kind is None else self.file).close()


@contextmanager
def failing(disk: Disk) -> Iterator[Disk]:
    """Let the requests of a block go to `disk`."""
    import OpenEXR

    real_open = io.open

    def opening(file: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        # Not Warp's, which opens /dev/null for its descriptor.
        if not set(mode) & set("wax+") or isinstance(file, int) or str(file) == os.devnull:
            return real_open(file, mode, *args, **kwargs)
        disk.ask("open", file)
        return Failing(real_open(file, mode, *args, **kwargs), disk, file)

    def asking(what: str, original: Any, which: int = 0) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            if what != "mkdir" or not os.path.exists(args[which]):
                disk.ask(what, args[which])
            return original(*args, **kwargs)

        return call

    class File(OpenEXR.File):
        """Fails as the real one does, with a RuntimeError."""

        def write(self, name: str) -> None:
            try:
                disk.ask("exr", name)
            except OSError as error:
                Path(name).write_bytes(b"v/1\x01")
                raise RuntimeError(f'Failed to write pixel data to image file "{name}". {error.strerror}.') from None
            super().write(name)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(builtins, "open", opening)
        patch.setattr(io, "open", opening)
        patch.setattr(os, "fsync", asking("fsync", lambda _: None))  # no power cut comes
        patch.setattr(os, "replace", asking("replace", os.replace, 1))
        patch.setattr(os, "rename", asking("rename", os.rename, 1))
        patch.setattr(os, "mkdir", asking("mkdir", os.mkdir))
        patch.setattr(OpenEXR, "File", File)
        yield disk


SYSTEM_CALLS: list[tuple[object, str]] = [(Path, name) for name in ("write_bytes", "rename", "mkdir", "touch", "rmdir")]
SYSTEM_CALLS += [(os, name) for name in ("fsync", "replace")]


class Killed(BaseException):
    pass


def kill_at(patch: pytest.MonkeyPatch, moment: int) -> list[str]:
    """Die before the given call of the system, or half-way through it if it writes; returns the names of the calls."""
    calls: list[str] = []
    mine = threading.get_ident()  # other threads, with work for other tests, live on

    def dying(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != mine:
                return original(*args, **kwargs)
            calls.append(name)
            if len(calls) > moment:  # what is dead does nothing any more, not even clean up
                if len(calls) == moment + 1 and name == "write_bytes":
                    with open(args[0], "wb") as half:
                        half.write(args[1][: len(args[1]) // 2])
                raise Killed
            return original(*args, **kwargs)

        return call

    for owner, name in SYSTEM_CALLS:
        patch.setattr(owner, name, dying(name, getattr(owner, name)))
    unlink = Path.unlink

    def gone(*args: Any, **kwargs: Any) -> None:
        if len(calls) <= moment or threading.get_ident() != mine:
            unlink(*args, **kwargs)

    patch.setattr(Path, "unlink", gone)
    return calls


class Allocator:
    """Counts allocations and kernel launches, and fails the `fatal`-th (from 0) as a GPU without memory does."""

    def __init__(self, fatal: int | None = None) -> None:
        self.fatal, self.requests = fatal, 0

    def ask(self) -> None:
        self.requests += 1
        if self.requests - 1 == self.fatal:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has 1 KiB free")


MAKERS = ("empty", "zeros", "empty_like", "zeros_like", "randn", "stack", "cat")
METHODS = ("new_empty", "new_zeros", "new_ones", "new_full", "clone", "contiguous")


@contextmanager
def allocating(allocator: Allocator) -> Iterator[Allocator]:
    """Let the allocations and launches of a block ask `allocator` first."""

    def asking(original: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            allocator.ask()
            return original(*args, **kwargs)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for place, names in ((torch, MAKERS), (torch.Tensor, METHODS), (launching, ("launch",))):
            for name in names:
                patch.setattr(place, name, asking(getattr(place, name)))
        yield allocator


@contextmanager
def failing_gpu(fatal: int | None, message: str) -> Iterator[list[str]]:
    """Fail the `fatal`-th launch of a block (from 0) and all later ones, as a GPU does after a fault; list launches."""
    launches: list[str] = []
    original = launching.launch

    def call(kernel: Any, *args: Any, **kwargs: Any) -> None:
        launches.append(kernel.key)
        if fatal is not None and len(launches) > fatal:
            raise RuntimeError(message)
        original(kernel, *args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(launching, "launch", call)
        yield launches
