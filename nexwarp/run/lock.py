"""The lock of a run folder: one training or evaluation at a time writes to it."""

import errno
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from platform import node

from nexwarp.errors import RunError, StorageError
from nexwarp.io.files import make_folders, one_line, remove_empty
from nexwarp.io.json_files import READ_ERRORS, parse_json
from nexwarp.run.contents import LOCK_FILE

BUSY = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES)
UNSUPPORTED = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
MAX_HOLDER = 1000  # bytes of the record of the holder that are read

# Descriptors of the locks that this process holds.
held: set[int] = set()

if sys.platform == "win32":
    import msvcrt

    LOCKED_BYTE = 2**30  # far behind the record, which others may not read where it is locked

    def _lock(number: int) -> None:
        os.lseek(number, LOCKED_BYTE, os.SEEK_SET)
        msvcrt.locking(number, msvcrt.LK_NBLCK, 1)
        os.lseek(number, 0, os.SEEK_SET)

else:
    import fcntl

    def _lock(number: int) -> None:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _forget() -> None:
    """Close the locks in a forked child, which would otherwise keep the lock of a dead parent."""
    for number in held:
        os.close(number)
    held.clear()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_forget)


@contextmanager
def locked_run(run: Path, warn: Callable[[str], None] = lambda _: None) -> Iterator[None]:
    """Hold the lock of a run folder during the block; the death of the process releases it.

    A missing folder is created, and removed if it is empty at the end. The lock is `flock` on the file `run.lock`,
    which tells the holder and is deleted at the end. A process that is killed leaves the file, but not the lock.

    Args:
        run: run folder.
        warn: is told if the file system has no locks; the block then runs without.

    Raises:
        RunError: another process, or another thread of this one, holds the lock.
        StorageError: the lock's file cannot be created.
    """
    try:
        created = make_folders(run)
    except OSError as error:
        raise StorageError.at(run, error) from error
    try:
        number = _acquire(run, warn)
        held.add(number)
        try:
            yield
        finally:
            if number in held:  # else this is a forked child, and the lock its parent's
                held.remove(number)
                try:
                    with suppress(OSError):  # Windows does not delete open files: there the file stays
                        (run / LOCK_FILE).unlink()
                finally:
                    os.close(number)
    finally:
        remove_empty(created)


def _acquire(run: Path, warn: Callable[[str], None]) -> int:
    """Return the descriptor of the lock's file, locked."""
    path = run / LOCK_FILE
    while True:
        try:
            number = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        except OSError as error:
            raise StorageError.at(path, error) from error
        try:
            _lock_or_warn(run, number, warn)
            # A holder deletes the file at its end: what was opened before that is no longer the lock.
            if _is_at(number, path):
                record = {"process": os.getpid(), "host": node(), "since": _now()}
                os.ftruncate(number, 0)
                os.write(number, (json.dumps(record) + "\n").encode())
                return number
        except BaseException as error:
            os.close(number)
            if isinstance(error, OSError):
                raise StorageError.at(path, error) from error
            raise
        os.close(number)


def _lock_or_warn(run: Path, number: int, warn: Callable[[str], None]) -> None:
    try:
        _lock(number)
    except OSError as error:
        if error.errno in BUSY:
            raise RunError(
                f"{run}: expected a run folder that no other process writes to, but {_holder(run / LOCK_FILE)} does; "
                "wait until it ends, or give another run folder"
            ) from None
        if error.errno not in UNSUPPORTED:
            raise
        warn(f"{run}: its file system has no locks ({error.strerror}): do not start a second training in this folder")


def _is_at(number: int, path: Path) -> bool:
    """Whether an open file is the one that has this path."""
    try:
        return os.path.samestat(os.fstat(number), path.lstat())
    except FileNotFoundError:
        return False


def _holder(path: Path) -> str:
    """Describe the holder of a lock: its process, host and time."""
    try:
        with path.open("rb") as file:
            record = parse_json(str(path), file.read(MAX_HOLDER))
        return one_line(f"process {record['process']} on {record['host']}, since {record['since']},")
    except READ_ERRORS:  # the holder has not written it yet
        return "another process"


def _now() -> str:
    return datetime.now().astimezone().isoformat(" ", "seconds")
