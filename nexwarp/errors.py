"""Errors of user input, files and resources. Each is a NexwarpError, and the built-in error that callers expect.

Arguments of Python functions that are out of range or of another type raise plain ValueError and TypeError.
"""

import importlib.util
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch

UNKNOWN = "more than there is"  # memory that an error does not tell


class NexwarpError(Exception):
    """Base class of these errors. The message is one line: the place, what was expected, what was found."""


class SettingError(NexwarpError, ValueError):
    """An option or setting is out of range or conflicts with another one."""


class SceneError(NexwarpError, ValueError):
    """A scene cannot be used."""


class FormatError(NexwarpError, ValueError):
    """A file is damaged or has another format or version than expected."""


class CheckpointError(FormatError):
    """A checkpoint is damaged or belongs to another run."""


class RunError(NexwarpError, ValueError):
    """A run folder is in a state that the command cannot use."""


class MissingError(NexwarpError, FileNotFoundError):
    """A file or folder does not exist."""


class StorageError(NexwarpError, OSError):
    """A disk is full, read-only or failing; `errno` and `filename` give the reason and the file."""

    def __str__(self) -> str:
        return super().__str__() if self.filename is None else f"{self.filename}: cannot be written ({self.strerror})"

    @classmethod
    def at(cls, path: str | os.PathLike[str], error: OSError) -> "StorageError":
        """Return the error for a failed write to `path`, with the number and text of the operating system's error."""
        return cls(error.errno, error.strerror or str(error), str(path))


class DivergedError(NexwarpError, RuntimeError):
    """A training produced NaN or infinity."""


class RankError(NexwarpError, RuntimeError):
    """Ranks of a training on several GPUs are missing, differ from each other, or have ended."""


class OutOfMemoryError(NexwarpError, MemoryError):
    """A GPU or computer has too little memory for the task; `needed` says how much would have done."""

    def __init__(self, message: str, needed: str | None = None) -> None:
        super().__init__(message)
        self.needed = UNKNOWN if needed is None else needed

    @classmethod
    def of(cls, task: str, needed: str) -> "OutOfMemoryError":
        """Return the error of a rendering that does not fit."""
        advice = "render a smaller image, with a lower K, or in parts (Camera.crop)"
        return cls(f"out of memory: {task} needs {needed}; {advice}", needed)


def require(met: bool, message: str) -> None:
    """Raise SettingError unless a condition on options is met."""
    if not met:
        raise SettingError(message)


@contextmanager
def naming(option: str) -> Iterator[None]:
    """Raise a ValueError of the block as a SettingError that names an option."""
    try:
        yield
    except ValueError as error:
        raise SettingError(f"{option}: {error}") from None


def check_package(needed_for: str, package: str, extra: str) -> None:
    """Raise SettingError unless a package, of an extra of nexwarp, is installed."""
    found = importlib.util.find_spec(package) is not None
    require(found, f"{needed_for}: needs the package {package}, found none; pip install 'nexwarp[{extra}]'")


def check_type(name: str, value: object, kind: type, *, optional: bool = False) -> None:
    """Raise TypeError unless a value is of a public class, or None where it is `optional`."""
    if not isinstance(value, kind) and not (optional and value is None):
        expected = f"a nexwarp.{kind.__name__}{' or None' if optional else ''}"
        raise TypeError(f"{name}: expected {expected}, got {type(value).__name__}")


def check_tensors(
    tensors: Mapping[str, tuple[torch.Tensor, tuple[int | str, ...]]],
    *,
    dtype: torch.dtype | None = None,
    device: torch.device | None = None,
) -> dict[str, int]:
    """Return the sizes of the named dimensions of several tensors; TypeError or ValueError name one that does not fit.

    `tensors` has a tensor and its shape for each argument; a string in a shape names a dimension, which must have the
    same size wherever the name occurs. By default, dtype and device are those of the first one, which must be floating.
    """
    sizes: dict[str, int] = {}
    for name, (tensor, shape) in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name}: expected a torch.Tensor, got {type(tensor).__name__}")
        if dtype is None and not tensor.is_floating_point():
            raise TypeError(f"{name}: expected a floating dtype, got {tensor.dtype}")
        dtype = dtype or tensor.dtype
        device = device or tensor.device
        if tensor.dtype != dtype:
            raise TypeError(f"{name}: expected dtype {dtype}, got {tensor.dtype}")
        if tensor.device != device:
            raise ValueError(f"{name}: expected a tensor on {device}, got one on {tensor.device}")
        fits = tensor.ndim == len(shape)
        for size, want in zip(tensor.shape, shape, strict=False):
            expected = sizes.setdefault(want, size) if isinstance(want, str) else want
            fits &= size == expected
        if not fits:
            wanted = ", ".join(f"{size}={sizes[size]}" if size in sizes else f"{size}" for size in map(str, shape))
            raise ValueError(f"{name}: expected shape ({wanted}), got {tuple(tensor.shape)}")
    return sizes


def check_each(name: str, good: torch.Tensor, tensor: torch.Tensor, expected: str) -> None:
    """Raise ValueError naming the first element, or row, of `tensor` that is not good."""
    if not bool(good.all()):
        where = tuple(torch.nonzero(~good)[0].tolist())
        raise ValueError(f"{name}: expected {expected}, got {tensor[where].tolist()} at index {where}")


def check_finite(name: str, tensor: torch.Tensor) -> None:
    """Raise ValueError naming the first element of `tensor` that is NaN or infinite."""
    check_each(name, torch.isfinite(tensor), tensor, "finite values")


def check_values(name: str, tensor: torch.Tensor, low: float, high: float) -> None:
    """Raise ValueError naming the first element of `tensor` that is NaN or not in [low, high]."""
    if tensor.numel() == 0:
        return
    least, most = tensor.aminmax()  # both are NaN if an element is
    if not (least >= low and most <= high):
        check_each(name, (tensor >= low) & (tensor <= high), tensor, f"values from {low:g} to {high:g}")


def check_version(value: object, known: int) -> None:
    """Raise ValueError unless a file's format version is an integer from 1 to the newest known one."""
    if type(value) is not int or not 1 <= value <= known:
        newer = type(value) is int and value > known
        reason = "; a newer nexwarp wrote the file, update nexwarp to read it" if newer else ""
        expected = "1" if known == 1 else f"1 to {known}"
        raise ValueError(f"expected format version {expected}, got {value!r:.60}{reason}")


def check_integer(name: str, value: object, low: float, high: float = float("inf")) -> None:
    """Raise TypeError unless a value is an int, and ValueError unless low <= value <= high."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{name}: expected an int, got {type(value).__name__}")
    check_range(name, value, low, high)


def check_number(name: str, value: object, low: float, high: float = float("inf")) -> None:
    """Raise TypeError unless a value is an int or float, and ValueError unless low <= value <= high."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name}: expected a number, got {type(value).__name__}")
    check_range(name, value, low, high)


def check_range(name: str, value: float, low: float, high: float = float("inf")) -> None:
    """Raise ValueError unless low <= value <= high."""
    if not low <= value <= high:
        upper = "" if high == float("inf") else f" and at most {high:g}"
        raise ValueError(f"{name}: expected at least {low:g}{upper}, got {value!s:.60}")
