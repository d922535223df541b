"""Long work that tests wait for, done on a second core beside the tests that do not need it.

A test marked `background_job(work, *arguments)` gets what `work(folder, *arguments)` gave, or raises what it raised, as
the fixture `background_job`. Such tests come last in a run of many. The work should be done in a process of its own:
beside others it is called in a thread, and had better not touch files there, for tests may have them fail. `folder` is
empty and its own. Tests with the same mark share one call. Work without arguments is marked
`background_job.with_args(work)`, for pytest takes a mark called with one function for that function's own mark.
"""

import subprocess
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

Work = tuple[Any, ...]  # a function and its arguments after the folder

# So many tests that the other ones take longer than the work, and wait for most kernels.
MANY = 500


def key(item: pytest.Item) -> tuple[Callable[..., Any], ...] | None:
    """What a test's mark asks for."""
    mark = item.get_closest_marker("background_job")
    return mark.args if mark else None


class BackgroundJobs:
    """Work that has been begun.

    Attributes:
        pool: does it, in order.
        folder: makes a folder by its name.
    """

    def __init__(self, pool: ThreadPoolExecutor, folder: Callable[[str], Path]) -> None:
        self.pool, self.folder = pool, folder
        self._begun: dict[Work, Future[Any]] = {}

    def begin(self, works: Iterable[Work]) -> None:
        """Put work in line.

        Folders are made at once, in this thread: later ones may meet what a test has done to the file system's calls.
        """
        for work in works:
            if work not in self._begun:
                self._begun[work] = self.pool.submit(self._do, work, self.folder(work[0].__name__))

    def result(self, work: Work) -> Any:
        """Wait for work; what is still in line, or never was, is done here and now."""
        future = self._begun.get(work)
        if future is None or future.cancel():
            future = self._begun[work] = Future()
            try:
                future.set_result(self._do(work, self.folder(work[0].__name__)))
            except BaseException as error:
                future.set_exception(error)
        return future.result()

    def _do(self, work: Work, folder: Path) -> Any:
        function, *arguments = work
        return function(folder, *arguments)


@contextmanager
def begun(items: list[pytest.Item], folder: Callable[[str], Path], first: list[str]) -> Iterator[BackgroundJobs]:
    """Begin the work of some tests: of many at one time one, after a command that may be killed; of few two.

    That of tests on CUDA waits until it is asked for: nothing may run beside those that look at the GPU's memory.
    """
    items = [item for item in items if item.get_closest_marker("cuda") is None]
    many = len(items) >= MANY
    ahead = None
    with ThreadPoolExecutor(1 if many else 2) as pool:
        if many:
            quiet = subprocess.DEVNULL
            ahead = subprocess.Popen(first, cwd=Path(__file__).parents[1], stdout=quiet, stderr=quiet)
            pool.submit(ahead.wait)
        beside = BackgroundJobs(pool, folder)
        beside.begin(work for item in items if (work := key(item)))
        try:
            yield beside
        finally:
            if ahead is not None:
                ahead.kill()
            pool.shutdown(cancel_futures=True)
