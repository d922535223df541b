"""Orderly ends on signals: Ctrl-C (SIGINT), SIGTERM and SIGHUP."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class Stopped(KeyboardInterrupt):
    """The signal of this number ends the program."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Raise `Stopped` in the block on Ctrl-C, SIGTERM and SIGHUP.

    An ignored SIGHUP, as after `nohup`, stays ignored. Other threads than the main one get no signals: there the block
    runs without handlers.
    """

    def handle(number: int, _frame: FrameType | None) -> None:
        raise Stopped(number)

    with _handled(handle):
        yield


@contextmanager
def deferred_stop() -> Iterator[Callable[[], int | None]]:
    """Record the first signal instead of raising, so that a training can stop between two steps.

    Yields:
        A function that returns the number of the recorded signal, or None. A second signal raises `Stopped` at once.
    """
    received: list[int] = []

    def handle(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            raise Stopped(number)

    with _handled(handle):
        yield lambda: received[0] if received else None


@contextmanager
def _handled(handle: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle SIGINT, SIGTERM and SIGHUP, where the system has them and does not ignore them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    known = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    numbers = [number for number in known if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
