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
def stopped_by_signals(*, deferred: bool = False) -> Iterator[Callable[[], int | None]]:
    """Raise `Stopped` in the block on Ctrl-C, SIGTERM and SIGHUP, where the system has them.

    `deferred`, the first signal is only recorded, so that a training can stop between two steps. An ignored SIGHUP, as
    after `nohup`, stays ignored. Other threads than the main one get no signals: there the block runs without handlers.
    Yield a function that returns the number of the first signal, or None.
    """
    received: list[int] = []

    def handle(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        if not deferred or len(received) > 1:
            raise Stopped(number)

    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    before = {n: signal.signal(n, handle) for n in numbers if signal.getsignal(n) != signal.SIG_IGN}
    try:
        yield lambda: received[0] if received else None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
