"""Run pycolmap's stages with progress reports, interruptible, and without COLMAP's log."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from nexwarp.data.lens import pycolmap_module

if TYPE_CHECKING:
    import pycolmap

POLL_SECONDS = 0.2
ONLY_FATAL = 3  # glog level
# Exceptions of pycolmap 4.2; failed checks raise ValueError or RuntimeError.
ERRORS = (RuntimeError, ValueError, IndexError, KeyError, OSError, MemoryError)

T = TypeVar("T")


def run_stage(title: str, work: Callable[["pycolmap.CancellationToken"], T], watch: Callable[[], None]) -> T:
    """Run a stage in a thread; this thread stays interruptible.

    An interruption cancels the work and waits until it ends, which takes a second or two.

    Args:
        title: name of the stage, for messages.
        work: called with a cancellation token in the other thread.
        watch: called in this thread every 0.2 s and at the end, to report progress.

    Returns:
        The result of `work`.

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
    """Suppress COLMAP's log, which has hundreds of lines."""
    logging = pycolmap_module().logging
    before = logging.minloglevel
    logging.minloglevel = ONLY_FATAL
    try:
        yield
    finally:
        logging.minloglevel = before


@contextmanager
def open_database(path: Path) -> Iterator["pycolmap.Database"]:
    """Open COLMAP's database through pycolmap, and close it at the end of the block.

    Python's sqlite3 must not open it: it is a second copy of SQLite in the process, and closing its file releases the
    locks of the first copy, after which pycolmap crashes with a bus error.
    """
    with closing(pycolmap_module().Database.open(str(path))) as database:
        yield database


class Count(Generic[T]):
    """Counts finished items that finish roughly in order; each call checks only the first unfinished ones."""

    def __init__(self, items: Iterable[T], is_done: Callable[[T], bool]) -> None:
        self.items, self.is_done, self.done = list(items), is_done, 0

    def __call__(self) -> int:
        """Number of finished items before the first unfinished one."""
        while self.done < len(self.items) and self.is_done(self.items[self.done]):
            self.done += 1
        return self.done
