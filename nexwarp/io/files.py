"""Atomic writes: a file exists complete or not at all."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nexwarp.errors import FormatError, StorageError

LONGEST_HEADER = 2**20  # bytes; that of a model has about 5,000
LEFTOVER = re.compile(r"\..+\.(\d+)\.tmp(\.[^.]*)?")


def one_line(text: object, limit: int = 300) -> str:
    """Text from a file as one printable line of at most `limit` characters, for a message."""
    line = "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode()
        for c in " ".join(str(text)[: 4 * limit].split())
    )
    return line if len(line) <= limit else f"{line[: limit - 3]}..."


def check_tensors_header(path: Path) -> None:
    """Raise FormatError if a safetensors file's header is long: parsing one of 100,000 tensors takes seconds."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
    # A file whose header would not fit is damaged, which its reader says.
    if LONGEST_HEADER < size <= path.stat().st_size:
        raise FormatError(
            f"{path}: expected a safetensors header of at most {LONGEST_HEADER:,} bytes, a few tensors, got {size:,}"
        )


@contextmanager
def written_aside(path: str | os.PathLike[str], *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`, with the same suffix; it is renamed to `path` when the block ends.

    Missing folders are created. If the block fails, an existing file at `path` stays unchanged, and the temporary file
    and the folders created for it are removed.

    Args:
        path: the file to write.
        durable: wait until the disk has stored the file. Otherwise a power failure can leave an empty file at `path`.

    Raises:
        OSError: the folder cannot be created or written to, or `path` is a folder. StorageError: the disk is full.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected a file to write, found a folder")
    missing = [folder for folder in path.parents if not folder.exists()]
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    done = False
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if durable:
            sync(temporary)
        os.replace(temporary, path)
        done = True
        if durable:
            sync(path.parent)
    except OSError as error:
        # An OSError from write or flush does not name the file.
        if isinstance(error, StorageError) or error.errno is None or error.filename not in (None, str(temporary)):
            raise
        raise StorageError.at(path, error) from error
    finally:
        # unlink would raise NotADirectoryError if a parent of `path` were a file.
        if path.parent.is_dir():
            temporary.unlink(missing_ok=True)
        if not done:
            for folder in missing:
                try:
                    folder.rmdir()
                except OSError:  # not created, or not empty
                    break


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file to a temporary name and rename it: it is complete or absent, even after a power failure."""
    with written_aside(path, durable=True) as temporary:
        temporary.write_bytes(content)


def sync(path: Path) -> None:
    """Wait until the disk has stored the content of a file, or the entries of a folder."""
    folder = path.is_dir()
    if folder and os.name == "nt":  # Windows cannot open a folder
        return
    number = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that killed processes left in a folder or its subfolders."""
    for file in folder.rglob(".*.tmp*"):
        if is_leftover(file):
            file.unlink(missing_ok=True)


def is_leftover(file: Path) -> bool:
    """Whether a file is a temporary file of a process that no longer runs."""
    match = LEFTOVER.fullmatch(file.name)
    return match is not None and file.is_file() and not _runs(int(match[1]))


def _runs(process: int) -> bool:
    """Whether another process with this id runs."""
    if process == os.getpid() or os.name == "nt":  # on Windows, os.kill would end the process
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
