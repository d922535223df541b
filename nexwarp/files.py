"""Files that are there whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def one_line(text: object, limit: int = 300) -> str:
    """Text that came out of a file, for a message: on one line, printable, of at most `limit` characters."""
    line = "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode()
        for c in " ".join(str(text)[: 4 * limit].split())
    )
    return line if len(line) <= limit else f"{line[: limit - 3]}..."


@contextmanager
def written_aside(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary name beside `path`, with its suffix, to write to; it becomes `path` when the block ends.

    The folder is made if need be. When anything fails, a file already at `path` stays as it is, and neither the
    temporary file nor a folder made for it stays behind.

    Raises:
        OSError: the folder cannot be made or written to, or `path` is a folder.
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
        os.replace(temporary, path)
        done = True
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
