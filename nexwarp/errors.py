"""Errors of user input, files and resources. Each is a NexwarpError and also the built-in error named here.

    NexwarpError
      SettingError      (ValueError)         an option or setting that is out of range or conflicts with another one
      SceneError        (ValueError)         a scene that cannot be used
      FormatError       (ValueError)         a file that is damaged or has another format or version
        CheckpointError                      a checkpoint that is damaged or belongs to another run
      RunError          (ValueError)         a run folder in a state that the command cannot use
      MissingError      (FileNotFoundError)  a file or folder that does not exist
      StorageError      (OSError)            a disk that is full, read-only or failing
      DivergedError     (RuntimeError)       a training whose numbers are no longer finite
      RankError         (RuntimeError)       ranks of a training that are missing, differ or have ended
      OutOfMemoryError  (MemoryError)        a GPU or computer with too little memory for the task

Arguments of Python functions that are out of range or of another type raise plain ValueError and TypeError.
"""

import os
from collections.abc import Mapping

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
    """A training produced NaN or infinity.

    Attributes:
        report: facts about the failure, as JSON values.
    """

    def __init__(self, message: str, report: Mapping[str, object] | None = None) -> None:
        super().__init__(message)
        self.report: dict[str, object] = dict(report or {})


class RankError(NexwarpError, RuntimeError):
    """Ranks of a training on several GPUs are missing, differ from each other, or have ended."""


class OutOfMemoryError(NexwarpError, MemoryError):
    """A GPU or computer has too little memory for the task; the message says which settings to lower.

    Attributes:
        needed: how much memory was needed, for a message.
    """

    def __init__(self, message: str, needed: str | None = None) -> None:
        super().__init__(message)
        self.needed = UNKNOWN if needed is None else needed

    @classmethod
    def of(cls, task: str, needed: str) -> "OutOfMemoryError":
        """Return the error of a rendering that does not fit."""
        advice = "render a smaller image, with a lower K, or in parts (Camera.crop)"
        return cls(f"out of memory: {task} needs {needed}; {advice}", needed)
