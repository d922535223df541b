"""How ranks end: the death of one ends all within seconds, and one line in all is printed.

Each rank waits, in a thread, for a farewell from rank 0, and rank 0 for one from each other rank. A rank that fails
says so in it. The system closes the connections of a dead process at once, which ends the wait with an error.
"""

import os
import re
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import torch
import torch.distributed as dist

from nexwarp.errors import NexwarpError
from nexwarp.train.ranks.join import POLL_SECONDS, Place, first_present, is_rank, open_store

EXIT_CODE = 3
ORDERLY, FAILED = 0, 1  # farewells
PARENT_SECONDS = 1.0
# For the thread that waits for the other ranks to find which one has died, after a message to it has failed.
GRACE_SECONDS = 3.0
STORE_SECONDS = 3.0
# The launcher, which looks every 0.1 s, should see the rank that ended by itself first: its exit code is the command's.
NOTICE_SECONDS = 0.3
# What gloo and NCCL say when the process at the other end is gone.
LOST = re.compile(r"gloo|nccl|connection (closed|reset|refused)|broken pipe|socket", re.I)

_current: "Liveness | None" = None


class Liveness:
    """Watches the other ranks.

    Attributes:
        leaving: whether this rank is about to end, so that the end of others is no error.
        speaks: whether it is for this rank to print why all end.
        ending: whether this rank ends because another has; whatever happens to it now is no news.
    """

    def __init__(self, place: Place, group: dist.ProcessGroup, names: list[str], hint: str) -> None:
        """Begin to watch.

        Args:
            place: of this rank.
            group: of all ranks, which nobody else uses.
            names: of the ranks' processes.
            hint: added to the message when a rank has died.
        """
        global _current
        self.place, self.group, self.names, self.hint = place, group, names, hint
        self.leaving = self.speaks = self.ending = False
        self.partners = list(range(1, place.size)) if place.rank == 0 else [0]
        self.store = open_store(STORE_SECONDS, host=False)
        self.ended, self.others_failed = threading.Event(), threading.Event()
        self.threads = [_started(self._wait_for, partner) for partner in self.partners]
        if "TORCHELASTIC_RUN_ID" in os.environ:
            self.threads.append(_started(self._watch_parent, os.getppid()))
        _current = self

    def close(self) -> None:
        """Say farewell and wait for the others'."""
        global _current
        self.leaving = True
        for partner in self.partners:
            dist.send(torch.tensor([ORDERLY]), partner, group=self.group)
        self.ended.set()
        for thread in self.threads:  # one that held the group at the interpreter's end would abort it
            thread.join()
        _current = None

    def fail(self, error: BaseException) -> None:
        """Note that this rank ends with an error; decide whether it is for this rank to print it.

        An error that follows from the death of another rank is not: the thread that waits for that rank ends the
        process meanwhile.
        """
        if isinstance(error, RuntimeError) and not isinstance(error, NexwarpError) and LOST.search(str(error)):
            time.sleep(GRACE_SECONDS)
        if self.ending:
            return
        self.leaving = True
        claimed = self._claim()
        self._tell_failure()
        self.speaks = self._speaks_without_store() if claimed is None else claimed

    def settle(self) -> None:
        """Note that this rank has told why all end, or wait for the one that tells to have done so.

        torchrun ends the other ranks as soon as one has ended.
        """
        until = time.monotonic() + GRACE_SECONDS
        with suppress(RuntimeError):  # the store is gone, and with it rank 0
            if self.speaks:
                self.store.set("told", "")
            while not self.store.check(["told"]) and time.monotonic() < until:
                time.sleep(POLL_SECONDS)

    def _tell_failure(self) -> None:
        for partner in self.partners:
            with suppress(RuntimeError):  # gone itself
                dist.send(torch.tensor([FAILED]), partner, group=self.group)

    def _wait_for(self, partner: int) -> None:
        farewell = torch.tensor([ORDERLY])
        try:
            dist.recv(farewell, partner, group=self.group)
        except RuntimeError:
            self._end(f"rank {partner} ({self.names[partner]}) has ended unexpectedly, so all ranks end", partner)
        if int(farewell) == FAILED:
            self.others_failed.set()
            self._end("", partner)

    def _watch_parent(self, parent: int) -> None:
        while not self.ended.wait(PARENT_SECONDS):
            if os.getppid() != parent:
                self._end("the process that started the ranks has ended, so all ranks end", 0)

    def _end(self, why: str, lost: int) -> None:
        """End this process because another one has ended, unless it is ending anyway.

        Args:
            why: to print; "" where another rank prints it.
            lost: the rank that has ended.
        """
        if self.leaving:
            return
        self.ending = True
        claimed = self._claim() if why else False
        if claimed or (claimed is None and self.place.rank == (0 if lost else 1)):
            shown = "\x1b[?25h\n" if sys.stdout.isatty() else ""  # a progress bar hides the cursor
            sys.stdout.write(shown)
            sys.stderr.write(f"nexwarp: error: {why}{self.hint}\n")
            sys.stderr.flush()
            with suppress(RuntimeError):
                self.store.set("told", "")
        if self.place.rank == 0:
            self._tell_failure()
        self.settle()
        time.sleep(NOTICE_SECONDS)
        finish_process(EXIT_CODE)

    def _claim(self) -> bool | None:
        """Return True on one rank only; None where the store is gone, and rank 0, which may serve it, with it."""
        try:
            mine = str(self.place.rank).encode()
            return self.store.compare_set("fault", "", mine.decode()) == mine
        except RuntimeError:
            return None

    def _speaks_without_store(self) -> bool:
        """Whether this rank is the first that is left. Rank 0 has told why it ended if it said that it failed."""
        if self.place.rank == 0:
            return True
        self.threads[0].join(GRACE_SECONDS)  # ends when rank 0 speaks or is gone
        return self.place.rank == 1 and not self.others_failed.is_set()


def _started(work: Callable[[int], None], argument: int) -> threading.Thread:
    thread = threading.Thread(target=work, args=(argument,), name="liveness", daemon=True)
    thread.start()
    return thread


def may_speak() -> bool:
    """Whether this process may print why it ends: always where it is alone, on one rank where it is not."""
    if _current is not None:
        return _current.speaks
    return not is_rank() or os.environ["RANK"] == str(first_present())


def end_process(code: int) -> int:
    """Return an exit code, or end the process with it at once if it is a rank that has not parted from the others.

    The threads that wait for other ranks would disturb an ordinary exit.
    """
    if _current is not None:
        try:
            _current.settle()
        finally:  # Ctrl-C ends the wait
            finish_process(code)
    return code


def finish_process(code: int) -> None:
    """End the process at once, after its output."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(code)
