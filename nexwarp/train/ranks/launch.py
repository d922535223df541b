"""Starts the ranks of a training on this machine, with torch's own launcher, which `torchrun` is too."""

import logging
import os
import sys
import time
import uuid
from collections.abc import Sequence
from contextlib import suppress

import torch

from nexwarp.errors import RankError, SettingError
from nexwarp.train.ranks.ranks import LostRankError

MONITOR_SECONDS = 0.1
LAUNCHED = "NEXWARP_LAUNCHED"
TURN_SECONDS = 2.0
LOST_SECONDS = 5.0


def is_rank() -> bool:
    """Whether torchrun has started this process as one of several ranks."""
    return all(os.environ.get(name) for name in ("RANK", "MASTER_ADDR", "MASTER_PORT")) and (
        os.environ.get("WORLD_SIZE", "1") != "1"
    )


def may_speak(error: BaseException | None) -> bool:
    """Wait for the rank that knows best why all end; whether it is for this one to say it, if it is still there.

    As soon as one rank has ended, the launcher ends the others. So rank 0 tells what all have met, then another what
    it alone has met; and nobody needs to tell of a lost connection whose other end the launcher sees.
    """
    if not is_rank():
        return True
    lost = isinstance(error, LostRankError)
    first = os.environ["RANK"] == "0"
    with suppress(KeyboardInterrupt):
        time.sleep(LOST_SECONDS * lost + TURN_SECONDS * (not first))
    return first if isinstance(error, KeyboardInterrupt) else not (lost and LAUNCHED in os.environ)


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


def launch(count: int, command: Sequence[str]) -> int:
    """Run Python with the arguments `command` in `count` processes; return the exit code of the first that fails.

    Ranks tell errors themselves; RankError tells which one was killed.
    """
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    for name in list(logging.root.manager.loggerDict):
        if name.startswith("torch.distributed"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
    os.environ[LAUNCHED] = "1"
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=count,
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        run_id=uuid.uuid4().hex,
        max_restarts=0,
        monitor_interval=MONITOR_SECONDS,
        local_addr="localhost",
    )
    # Of all cores, each process gets its share, as with torchrun.
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // count)))
    try:
        elastic_launch(config, sys.executable)(*command)
    except ChildFailedError as error:
        rank, failure = error.get_first_failure()
        if failure.exitcode < 0:
            end = f"rank {rank} (process {failure.pid}) was ended by signal {-failure.exitcode}, so all ranks end"
            raise RankError(f"{end}; --resume continues from the last checkpoint") from None
        return failure.exitcode
    except SignalException as stop:
        return 128 + int(stop.sigval)
    return 0
