"""Atomic writes, complete or not at all even after a power failure; names for messages; a bound of file headers."""

import errno
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from nexwarp.errors import FormatError, StorageError

TEMPORARY = re.compile(r"\..+\.\d{1,9}-[0-9a-f]{16}\.tmp(\.[^.]*)?")
MAX_STEM = 40  # characters of a file's stem in its temporary name; a file system may limit names to 255 bytes
LONGEST_HEADER = 2**20  # bytes; that of a model has about 5,000
# Errors of fsync on folders of file systems that cannot sync them, and of open on folders that may not be read.
UNSYNCABLE = (errno.EINVAL, errno.ENOTSUP, errno.EACCES)


def printable(text: str) -> str:
    """Text with its control, bidirectional and other characters that do not print escaped, line breaks too."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)


def one_line(text: object, limit: int = 300) -> str:
    """Text from a file as one printable line of at most `limit` characters, for a message."""
    line = printable(" ".join(str(text)[: 4 * limit].split()))
    return line if len(line) <= limit else f"{line[: limit - 3]}..."


def temporary_name(path: Path) -> Path:
    """Return `.STEM.PROCESS-RANDOM.tmp.SUFFIX` beside `path`: nobody can create a link of that name in advance."""
    return path.with_name(f".{path.stem[:MAX_STEM]}.{os.getpid()}-{secrets.token_hex(8)}.tmp{path.suffix}")


def is_temporary(name: str) -> bool:
    """Whether a name is one of `temporary_name`."""
    return TEMPORARY.fullmatch(name) is not None


@contextmanager
def made_folders(folder: Path) -> Iterator[None]:
    """Create a folder and those above it, stored on disk; at the end of the block, remove new ones that are empty.

    StorageError: it cannot be created.
    """
    missing = [f for f in (folder, *folder.parents) if not f.exists()]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for new in missing:
                sync(new.parent)
        except OSError as error:
            raise StorageError.at(folder, error) from error
        yield
    finally:
        remove_empty(missing)


def remove_empty(folders: list[Path]) -> None:
    """Remove those of some folders, deepest first, that are empty."""
    for folder in folders:
        with suppress(OSError):  # not empty, or not there
            folder.rmdir()


@contextmanager
def written_aside(path: str | os.PathLike[str], *, durable: bool = True) -> Iterator[Path]:
    """Yield a new, empty file beside `path`, with the same suffix; it is renamed to `path` when the block ends.

    Missing folders are created. If the block fails, an existing file at `path` stays unchanged, and the temporary file
    and the folders created for it are removed. Unless `durable`, it does not wait until the disk has stored the file: a
    power failure can leave an empty one. OSError: the folder cannot be created or written to, or `path` is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected a file to write, found a folder")
    temporary = temporary_name(path)
    with made_folders(path.parent):
        try:
            temporary.touch(exist_ok=False)
            yield temporary
            if durable:
                sync(temporary)
            os.replace(temporary, path)
            if durable:
                sync(path.parent)
        except OSError as error:
            # An OSError from write or flush does not name the file.
            if isinstance(error, StorageError) or error.errno is None or error.filename not in (None, str(temporary)):
                raise
            raise StorageError.at(path, error) from error
        finally:
            temporary.unlink(missing_ok=True)


def write_atomically(path: str | os.PathLike[str], content: bytes, *, durable: bool = True) -> None:
    """Write a file to a temporary name and rename it: it is complete or absent; see `written_aside`."""
    with written_aside(path, durable=durable) as temporary:
        temporary.write_bytes(content)


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Write files by their paths, the first one last; nothing changes before the disk has stored all contents."""
    with ExitStack() as stack:
        for path, content in contents.items():
            temporary = stack.enter_context(written_aside(path))
            temporary.write_bytes(content)
            sync(temporary)


def sync(path: Path) -> None:
    """Wait until the disk has stored the content of a file, or the entries of a folder where that is possible."""
    folder = path.is_dir()
    if folder and os.name == "nt":  # Windows cannot open a folder
        return
    try:
        number = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
        try:
            os.fsync(number)
        finally:
            os.close(number)
    except OSError as error:
        if not folder or error.errno not in UNSYNCABLE:
            raise


def check_tensors_header(path: Path) -> None:
    """Raise FormatError if a safetensors file's header is long: parsing one of 100,000 tensors takes seconds."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
    # A file whose header would not fit is damaged, which its reader says.
    if LONGEST_HEADER < size <= path.stat().st_size:
        raise FormatError(
            f"{path}: expected a safetensors header of at most {LONGEST_HEADER:,} bytes, a few tensors, got {size:,}"
        )
