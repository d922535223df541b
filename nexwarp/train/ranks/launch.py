"""Starts the ranks of a training on this machine, and ends them; torchrun does it for several machines.

Nothing that is started here listens beyond the loopback address: ranks find each other through a file that only the
user can read, and gloo and NCCL are bound to the loopback interface.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from tempfile import TemporaryDirectory

import torch

from nexwarp.errors import RankError, SettingError
from nexwarp.train.ranks.ranks import STORE, LostRankError

POLL_SECONDS = 0.1
END_SECONDS = 30.0  # in which a rank that is told to end must have ended
TURN_SECONDS = 2.0
LOST_SECONDS = 5.0
TORCHRUN = ("MASTER_ADDR", "MASTER_PORT")


def is_rank() -> bool:
    """Whether `launch` or torchrun has started this process as one of several ranks."""
    meeting = STORE in os.environ or all(os.environ.get(name) for name in TORCHRUN)
    return meeting and bool(os.environ.get("RANK")) and os.environ.get("WORLD_SIZE", "1") != "1"


def may_speak(error: BaseException | None) -> bool:
    """Wait for the rank that knows best why all end; whether it is for this one to say it, if it is still there.

    As soon as one rank has ended, the launcher ends the others. So rank 0 tells what all have met, then another what
    it alone has met; and nobody needs to tell of a lost connection whose other end `launch` sees.
    """
    if not is_rank():
        return True
    lost = isinstance(error, LostRankError)
    if lost and STORE in os.environ:
        return False
    first = os.environ["RANK"] == "0"
    with suppress(KeyboardInterrupt):
        time.sleep(LOST_SECONDS * lost + TURN_SECONDS * (not first))
    return first or not isinstance(error, KeyboardInterrupt)


def end_process(code: int) -> int:
    """Return an exit code; a rank ends at once, as its connections would disturb an ordinary end."""
    if is_rank():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


def check_count(count: int, device: str | None) -> None:
    """Raise SettingError unless this machine can run so many ranks on a device, "cpu" or a GPU each."""
    if count < 1:
        raise SettingError(f"--gpus: expected at least 1, got {count}")
    gpus = torch.cuda.device_count()
    if device != "cpu" and count > gpus:
        raise SettingError(
            f"--gpus: expected at most {gpus}, as many as GPUs on this machine, got {count}; "
            "--device cpu trains on CPUs instead"
        )


def launch(count: int, command: Sequence[str], stop: Callable[[], int | None] = lambda: None) -> int:
    """Run Python with the arguments `command` in `count` processes; return the exit code of the first that fails.

    `stop` returns the number of a signal that all ranks are to get, or None. Ranks tell errors themselves; RankError
    tells which one was killed.
    """
    with TemporaryDirectory(prefix="nexwarp-") as folder:  # nobody else may read or write there
        variables = os.environ | _variables(count, os.path.join(folder, "store"))
        ranks: list[subprocess.Popen[bytes]] = []
        try:
            for rank in range(count):
                mine = variables | {"RANK": str(rank), "LOCAL_RANK": str(rank)}
                # A session of its own: Ctrl-C reaches a rank once, from here.
                ranks.append(subprocess.Popen([sys.executable, *command], env=mine, start_new_session=True))
            return _watch(ranks, stop)
        finally:
            _end(ranks)


def _variables(count: int, store: str) -> dict[str, str]:
    """Return the environment that all ranks share."""
    variables = {"WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count), STORE: store}
    # Of all cores, each process gets its share, as with torchrun.
    variables["OMP_NUM_THREADS"] = os.environ.get("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // count)))
    loopback = next((name for _, name in socket.if_nameindex() if name in ("lo", "lo0")), None)
    if loopback is not None:
        variables |= {"GLOO_SOCKET_IFNAME": loopback, "NCCL_SOCKET_IFNAME": loopback}
    return variables


def _watch(ranks: Sequence[subprocess.Popen[bytes]], stop: Callable[[], int | None]) -> int:
    """Wait until all ranks have ended or one has failed; return the exit code of all."""
    signalled = None
    while True:
        codes = [process.poll() for process in ranks]
        failed = [rank for rank, code in enumerate(codes) if code]
        if failed and signalled is None:
            rank = min(failed, key=lambda rank: codes[rank] or 0)  # one that was killed, not one that missed it
            code = codes[rank] or 0
            if code > 0:
                return code
            end = f"rank {rank} (process {ranks[rank].pid}) was ended by signal {-code}, so all ranks end"
            raise RankError(f"{end}; --resume continues from the last checkpoint")
        if None not in codes:
            return 0 if signalled is None else 128 + signalled
        if signalled is None and (signalled := stop()) is not None:
            for process in ranks:
                process.send_signal(signalled)
        time.sleep(POLL_SECONDS)


def _end(ranks: Sequence[subprocess.Popen[bytes]]) -> None:
    """End the ranks that are still there: in order, or after some time at once."""
    for process in ranks:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
    until = time.monotonic() + END_SECONDS
    for process in ranks:
        try:
            process.wait(max(until - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
