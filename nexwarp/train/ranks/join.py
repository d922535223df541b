"""How a process learns of the other ranks of its training, and meets them."""

import hashlib
import math
import os
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from torch.distributed.distributed_c10d import PrefixStore, Store
from torch.distributed.rendezvous import TCPStore  # type: ignore[attr-defined]

from nexwarp.errors import RankError

# Of torchrun, and of whoever starts ranks by other means.
VARIABLES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
JOIN_SECONDS = 300.0
POLL_SECONDS = 0.05
WAIT_VARIABLE = "NEXWARP_JOIN_SECONDS"
# A viewer may pause a training: it is the death of a rank that ends the others, not a long wait.
FOREVER = timedelta(days=365)


_present = [0]  # ranks that are known to be there


@dataclass(frozen=True)
class Place:
    """The place of a process among the ranks; see `nexwarp.train.ranks.ranks.Ranks`."""

    rank: int
    size: int
    local_rank: int
    local_size: int
    launch: str
    restarted: bool

    @classmethod
    def of_environment(cls) -> "Place":
        """Return the place that torchrun's environment variables tell; RankError if they make no sense."""
        names = (*VARIABLES[:2], "LOCAL_RANK", "LOCAL_WORLD_SIZE", "TORCHELASTIC_RESTART_COUNT")
        values = {name: os.environ.get(name, "") for name in names}
        local = {"LOCAL_RANK": values["RANK"], "LOCAL_WORLD_SIZE": values["WORLD_SIZE"]}
        numbers = {}
        for name, text in values.items():
            text = text or local.get(name, "0")
            if not (text.isascii() and text.isdigit()):
                raise RankError(f"{name}: expected a number in the environment, got {text!r:.60}")
            numbers[name] = int(text)
        rank, size, local_rank, local_size, restarts = numbers.values()
        if not (rank < size and local_rank < local_size <= size):
            raise RankError(f"RANK, WORLD_SIZE: expected a rank below the number of ranks, got {rank} of {size}")
        return cls(rank, size, local_rank, local_size, _launch(), restarts > 0)


def is_rank() -> bool:
    """Whether torchrun has started this process as one of several ranks."""
    return all(os.environ.get(name) for name in VARIABLES) and os.environ["WORLD_SIZE"] != "1"


def first_present() -> int:
    """Return the first rank that is known to be there; it speaks for all before they have met."""
    return _present[0]


def _launch() -> str:
    """Identify torchrun's process, which outlives the ranks that it restarts."""
    import psutil

    run = os.environ.get("TORCHELASTIC_RUN_ID", "")
    return f"{run} {socket.gethostname()} {os.getppid()} {psutil.Process(os.getppid()).create_time():.2f}"


def open_store(seconds: float, *, host: bool) -> Store:
    """Connect to the store in which ranks meet; ranks that torchrun has restarted find it empty.

    Args:
        seconds: to wait for it, and for its answers.
        host: serve it, unless torchrun does.
    """
    served = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    wait = timedelta(seconds=math.ceil(seconds))  # torch 2.4 counts whole seconds
    host = host and not served
    store = TCPStore(address, port, None, host, wait, wait_for_workers=False, multi_tenant=host)
    return PrefixStore(f"nexwarp/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}", store)


def join_store(place: Place) -> Store:
    """Wait for all ranks, and return the store in which they meet.

    Raises:
        RankError: not all came in time; the message names those that are missing.
    """
    where = f"{os.environ['MASTER_ADDR']}:{os.environ['MASTER_PORT']}"
    seconds = float(os.environ.get(WAIT_VARIABLE, JOIN_SECONDS))
    keys = [f"joined/{rank}" for rank in range(place.size)]
    expected = f"expected {place.size} ranks to join at {where} within {seconds:.0f} s"
    try:
        store = open_store(seconds, host=place.rank == 0)
        store.set(keys[place.rank], "")
    except (RuntimeError, ValueError, OSError):
        _present[:] = [place.rank]
        raise RankError(f"{expected}, but rank {place.rank} cannot reach rank 0 there") from None
    until = time.monotonic() + seconds
    while not store.check(keys):
        time.sleep(POLL_SECONDS)
        if time.monotonic() < until:
            continue
        _present[:] = [rank for rank, key in enumerate(keys) if store.check([key])]
        missing = [str(rank) for rank in range(place.size) if rank not in _present]
        raise RankError(f"{expected}; missing: {', '.join(missing) or 'none any more'}")
    return store


def code_digest() -> str:
    """Return a digest of nexwarp's source files."""
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def first_difference(facts: Sequence[object]) -> str | None:
    """Tell the first difference between the facts of ranks, dictionaries of text; None where all are the same."""
    reference = facts[0]
    assert isinstance(reference, dict)
    for rank, values in enumerate(facts):
        assert isinstance(values, dict)
        for name, value in reference.items():
            if values.get(name) != value:
                return f"rank {rank}: expected the same {name} as rank 0, {value}, got {values.get(name)}"
    return None
