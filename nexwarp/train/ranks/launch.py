"""Starts the ranks of a training on this machine, with torch's own launcher, which `torchrun` is too."""

import logging
import os
import sys
import uuid
from collections.abc import Sequence

import torch

from nexwarp.errors import SettingError

MONITOR_SECONDS = 0.1


def check_count(count: int, device: str | None) -> None:
    """Raise SettingError unless this machine can run so many ranks.

    Args:
        count: how many.
        device: "cuda", "cpu" or None for CUDA where there is a GPU.
    """
    if count < 1:
        raise SettingError(f"--gpus: expected at least 1, got {count}")
    if device == "cpu":
        return
    found = torch.cuda.device_count()
    if count > found:
        raise SettingError(
            f"--gpus: expected at most {found}, as many as GPUs on this machine, got {count}; "
            "--device cpu trains on CPUs instead"
            if found
            else f"--gpus: expected a machine with {count} GPUs, found none; --device cpu trains on CPUs instead"
        )


def launch(count: int, command: Sequence[str]) -> int:
    """Run a command of Python in `count` processes, the ranks; return its exit code.

    The first rank that fails gives the exit code, and the others are ended. Ranks print for themselves.

    Args:
        count: how many.
        command: arguments of the Python interpreter.
    """
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    # Why ranks end, they tell themselves, in one line.
    for name in list(logging.root.manager.loggerDict):
        if name.startswith("torch.distributed"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
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
        code = error.get_first_failure()[1].exitcode
        return code if code >= 0 else 128 - code
    except SignalException as stop:
        return 128 + int(stop.sigval)
    return 0
