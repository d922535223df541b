"""A disk, an allocator and a GPU that fail at the k-th thing asked of them."""

from __future__ import annotations

import builtins
import errno
import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from nexwarp.kernels import launch as launching


class Faults:
    """Counts requests, and fails the `fatal`-th (from 0); with `lasting`, every later one too."""

    def __init__(self, fatal: int | None, error: Exception, lasting: bool = False) -> None:
        self.fatal, self.error, self.lasting = fatal, error, lasting
        self.requests: list[str] = []

    def ask(self, what: str) -> None:
        self.requests.append(what)
        count = len(self.requests) - 1
        if self.fatal is not None and (count == self.fatal or (self.lasting and count > self.fatal)):
            raise self.error

    def asking(self, patch: pytest.MonkeyPatch, place: Any, names: tuple[str, ...]) -> None:
        """Let functions ask before they do what they are called for."""

        def asked(name: str, original: Any) -> Any:
            def call(*args: Any, **kwargs: Any) -> Any:
                self.ask(name)
                return original(*args, **kwargs)

            return call

        for name in names:
            patch.setattr(place, name, asked(name, getattr(place, name)))


class Disk(Faults):
    """Counts what is asked of the disk below `folder`, and fails with the error `number`.

    A request is a file that is opened to be written, a write to it, its closing, a flush, a rename, a new folder. A
    write that fails has written half. With `lasting` it is a full disk.
    """

    def __init__(self, folder: Path, fatal: int | None = None, number: int = errno.ENOSPC, lasting: bool = False):
        super().__init__(fatal, OSError(number, os.strerror(number)), lasting)
        self.folder, self.number = folder, number

    def write_to(self, what: str, path: Any) -> None:
        if isinstance(path, int):
            path = os.readlink(f"/proc/self/fd/{path}")
        if Path(os.path.abspath(path)).is_relative_to(self.folder):
            self.ask(f"{what} {Path(path).name}")


class Failing:
    """A file open to be written."""

    def __init__(self, file: Any, disk: Disk, path: Any) -> None:
        self.file, self.disk, self.path = file, disk, path

    def write(self, content: Any) -> int:
        try:
            self.disk.write_to("write", self.path)
        except OSError:
            self.file.write(content[: len(content) // 2])
            raise
        return self.file.write(content)

    def close(self) -> None:
        if not self.file.closed:
            self.file.close()
            self.disk.write_to("close", self.path)

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
        disk.write_to("open", file)
        return Failing(real_open(file, mode, *args, **kwargs), disk, file)

    def asking(what: str, original: Any, which: int = 0) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            if what != "mkdir" or not os.path.exists(args[which]):
                disk.write_to(what, args[which])
            return original(*args, **kwargs)

        return call

    class File(OpenEXR.File):
        """Fails as the real one does, with a RuntimeError."""

        def write(self, name: str) -> None:
            try:
                disk.write_to("exr", name)
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


MAKERS = ("empty", "zeros", "empty_like", "zeros_like", "randn", "stack", "cat")
METHODS = ("new_empty", "new_zeros", "new_ones", "new_full", "clone", "contiguous")


@contextmanager
def failing_gpu(fatal: int | None = None, message: str | None = None) -> Iterator[Faults]:
    """Fail the `fatal`-th allocation or launch of a block as a GPU without memory does; without one, count.

    With a message, fail the `fatal`-th launch and all later ones with it, as a GPU does after a fault.
    """
    full = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has 1 KiB free")
    faults = Faults(fatal, full) if message is None else Faults(fatal, RuntimeError(message), lasting=True)
    with pytest.MonkeyPatch.context() as patch:
        faults.asking(patch, launching, ("launch",))
        if message is None:
            faults.asking(patch, torch, MAKERS)
            faults.asking(patch, torch.Tensor, METHODS)
        yield faults
