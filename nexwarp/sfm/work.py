"""Running pycolmap's stages: with progress, interruptible, quiet."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from nexwarp.data.lens import pycolmap_module

POLL_SECONDS = 0.2
ONLY_FATAL = 3  # glog level
# What pycolmap 4.2 raises: failed checks are ValueError or RuntimeError.
ERRORS = (RuntimeError, ValueError, IndexError, KeyError, OSError, MemoryError)

T = TypeVar("T")


def run_stage(title: str, work: Callable[[Any], T], watch: Callable[[], None]) -> T:
    """Run `work(cancellation token)` in a thread while this one calls `watch` now and then, and can be interrupted.

    An interruption cancels the work and waits for its end: a second or two.

    Raises:
        ValueError: pycolmap failed; the message names the stage.
    """
    pycolmap = pycolmap_module()
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(work, token)
        try:
            while wait([future], POLL_SECONDS).not_done:
                watch()
        except BaseException:
            token.cancel()
            raise
    try:
        result = future.result()
    except ERRORS as error:
        detail = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{title}: pycolmap failed: {detail}") from error
    watch()
    return result


@contextmanager
def quiet() -> Iterator[None]:
    """Keep COLMAP's log, hundreds of lines, off the terminal."""
    logging = pycolmap_module().logging
    before = logging.minloglevel
    logging.minloglevel = ONLY_FATAL
    try:
        yield
    finally:
        logging.minloglevel = before


@contextmanager
def open_database(path: Path) -> Iterator[Any]:
    """Open COLMAP's database, through pycolmap alone.

    Python's sqlite3 would be a second copy of SQLite in one process, whose closing of a file drops the locks of the
    first: pycolmap then dies of a bus error.
    """
    with closing(pycolmap_module().Database.open(str(path))) as database:
        yield database


class Count:
    """Counts items that get done about in order, by asking of the first one that is not."""

    def __init__(self, items: Iterable[T], is_done: Callable[[T], bool]) -> None:
        self.items, self.is_done, self.done = list(items), is_done, 0

    def __call__(self) -> int:
        """How many are done."""
        while self.done < len(self.items) and self.is_done(self.items[self.done]):
            self.done += 1
        return self.done
