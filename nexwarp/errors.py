"""What nexwarp raises where it meets the world: one family, whose members are also the built-in errors akin to them.

    NexwarpError
      SettingError      (ValueError)         an option or setting that is out of its range, or does not suit another
      SceneError        (ValueError)         a scene that cannot be used
      FormatError       (ValueError)         a file that is damaged, or of another kind or version
        CheckpointError                      a checkpoint that is damaged, or of another run
      RunError          (ValueError)         a run folder that is not in the state that a command wants
      MissingError      (FileNotFoundError)  a file or folder that is not there
      StorageError      (OSError)            a disk that is full, read-only or failing
      DivergedError     (RuntimeError)       a training whose numbers are no longer finite
      OutOfMemoryError  (MemoryError)        a GPU, or a computer, that is too small for what was asked

Arguments of Python functions that are out of their range or of another type raise plain ValueErrors and TypeErrors.
"""

import os
from typing import Any


class NexwarpError(Exception):
    """Whatever nexwarp refuses or gives up: the message is one line that says what, where, and what was expected."""


class SettingError(NexwarpError, ValueError):
    """An option or setting that is out of its range, or does not suit another."""


class SceneError(NexwarpError, ValueError):
    """A scene that cannot be used."""


class FormatError(NexwarpError, ValueError):
    """A file that is damaged, or of another kind or version than expected."""


class CheckpointError(FormatError):
    """A checkpoint that is damaged, or of another run."""


class RunError(NexwarpError, ValueError):
    """A run folder that is not in the state that a command wants."""


class MissingError(NexwarpError, FileNotFoundError):
    """A file or folder that is not there."""


class StorageError(NexwarpError, OSError):
    """A disk that is full, read-only or failing; `errno` and `filename` say what and where."""

    def __str__(self) -> str:
        return super().__str__() if self.filename is None else f"{self.filename}: cannot be written ({self.strerror})"

    @classmethod
    def at(cls, path: str | os.PathLike[str], error: OSError) -> "StorageError":
        """Return the error that writing `path` met."""
        return cls(error.errno, error.strerror or str(error), str(path))


class DivergedError(NexwarpError, RuntimeError):
    """A training whose numbers are no longer finite.

    Attributes:
        report: what is known of it, as plain JSON values.
    """

    def __init__(self, message: str, report: dict[str, Any] | None = None) -> None:
        super().__init__(message)
        self.report = report or {}


class OutOfMemoryError(NexwarpError, MemoryError):
    """A GPU, or a computer, that is too small for what was asked; the message says what to lower."""
