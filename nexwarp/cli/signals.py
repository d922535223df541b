"""Signals that ask a program to end, in an orderly way: Ctrl-C, SIGTERM, SIGHUP."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class Stopped(KeyboardInterrupt):
    """A signal that ends the program.

    Attributes:
        number: the signal's.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Raise `Stopped` where SIGTERM or SIGHUP interrupts the block; Ctrl-C raises KeyboardInterrupt as ever.

    After `nohup`, which has SIGHUP ignored, a closed terminal is no reason to. In a thread, which gets no signals, the
    block just runs.
    """

    def handle(number: int, _frame: Any) -> None:
        raise Stopped(number)

    with _handled(handle, *_endings()):
        yield


@contextmanager
def deferred_stop() -> Iterator[Callable[[], int | None]]:
    """Let a first Ctrl-C, or a request to end, wait until it is asked for, between steps: no half step is saved.

    Yields:
        A function that tells the signal's number, or None. A second signal does not wait: it raises `Stopped`.
    """
    asked: list[int] = []

    def handle(number: int, _frame: Any) -> None:
        asked.append(number)
        if len(asked) > 1:
            raise Stopped(number)

    with _handled(handle, signal.SIGINT, *_endings()):
        yield lambda: asked[0] if asked else None


def _endings() -> list[int]:
    """SIGTERM and SIGHUP, as far as the system knows them and they are not ignored."""
    known = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    return [number for number in known if signal.getsignal(number) != signal.SIG_IGN]


@contextmanager
def _handled(handle: Callable[[int, Any], None], *numbers: int) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
