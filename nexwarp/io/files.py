"""Files that are there whole or not at all."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nexwarp.errors import StorageError

LEFTOVER = re.compile(r"\..+\.(\d+)\.tmp(\.[^.]*)?")


def one_line(text: object, limit: int = 300) -> str:
    """Text that came out of a file, for a message: on one line, printable, of at most `limit` characters."""
    line = "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode()
        for c in " ".join(str(text)[: 4 * limit].split())
    )
    return line if len(line) <= limit else f"{line[: limit - 3]}..."


@contextmanager
def written_aside(path: str | os.PathLike[str], *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary name beside `path`, with its suffix, to write to; it becomes `path` when the block ends.

    The folder is made if need be. When anything fails, a file already at `path` stays as it is, and neither the
    temporary file nor a folder made for it stays behind.

    Args:
        path: where to.
        durable: wait until the disk has it: without that a power cut may leave an empty file under the new name.

    Raises:
        OSError: the folder cannot be made or written to, or `path` is a folder; StorageError where the disk is full.
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
        # Those of a write or a flush do not say which file it was.
        if isinstance(error, StorageError) or error.errno is None or error.filename not in (None, str(temporary)):
            raise
        raise StorageError.at(path, error) from error
    finally:
        # Only what is there: below a file, that stands where a folder should, even looking for it is an error.
        if path.parent.is_dir():
            temporary.unlink(missing_ok=True)
        if not done:
            for folder in missing:
                try:
                    folder.rmdir()
                except OSError:  # not made, or others put something there
                    break


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file under a temporary name and rename it, so that it is there whole or not at all, power cut or not."""
    with written_aside(path, durable=True) as temporary:
        temporary.write_bytes(content)


def sync(path: Path) -> None:
    """Wait until the disk has what was written to a file, or the names in a folder."""
    folder = path.is_dir()
    if folder and os.name == "nt":  # which has no such call
        return
    number = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that killed processes left in a folder and below it."""
    for file in folder.rglob(".*.tmp*"):
        if is_leftover(file):
            file.unlink(missing_ok=True)


def is_leftover(file: Path) -> bool:
    """Whether a file is a temporary one whose process is gone."""
    match = LEFTOVER.fullmatch(file.name)
    return match is not None and file.is_file() and not _runs(int(match[1]))


def _runs(process: int) -> bool:
    """Whether there is another process of that number."""
    if process == os.getpid() or os.name == "nt":  # where asking would end it
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
