"""The ranks of a training: processes with a device each, and the few things that they tell each other.

Gradients travel on the default process group, NCCL between GPUs and gloo between CPUs. Everything else, such as
settings, checkpoints and votes, travels between CPUs on a second group, which is always gloo. The content of messages
is JSON or raw bytes; nothing is unpickled.

`launch` starts the ranks on this machine; torchrun does it for several. What it starts listens on the loopback address
alone: ranks find each other through a file that only the user can read, and gloo and NCCL are bound to that interface.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from datetime import timedelta
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

import torch
import torch.distributed as dist
from torch import nn
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from nexwarp.errors import NexwarpError, RankError, SettingError
from nexwarp.io.files import one_line

JOIN_SECONDS = 300.0
WAIT_VARIABLE = "NEXWARP_JOIN_SECONDS"
STORE = "NEXWARP_STORE"  # variable: the file through which the ranks of one machine find each other
# A viewer may pause a training: it is the death of a rank that ends the others, not a long wait.
FOREVER = timedelta(days=365)
# What gloo and NCCL say when the process at the other end is gone.
LOST = re.compile(r"gloo|nccl|connection (closed|reset|refused)|broken pipe|socket", re.I)
ALIGNMENT = 4  # numbers; vector loads need addresses that are multiples of 16 bytes
POLL_SECONDS = 0.1
END_SECONDS = 30.0  # in which a rank that is told to end must have ended
TURN_SECONDS = 2.0
LOST_SECONDS = 5.0
TORCHRUN = ("MASTER_ADDR", "MASTER_PORT")


class LostRankError(RankError):
    """Another rank has ended, which this one has learnt from a message that did not arrive."""


class Ranks:
    """The ranks of a training, seen from one of them, as a context.

    Attributes:
        rank: number of this one, from 0; rank 0 writes files and shows progress.
        size: how many there are.
        device: of this rank.
        backend: of the gradients, "nccl" or "gloo"; "" for a process alone.
    """

    def __init__(self, rank: int, size: int, device: torch.device, backend: str) -> None:
        """Use `join`, or `alone`, instead."""
        self.rank, self.size = rank, size
        self.device, self.backend = device, backend
        self.control: dist.ProcessGroup | None = None
        self.vote: tuple[dist.Work, torch.Tensor] | None = None

    @classmethod
    def alone(cls, device: torch.device) -> "Ranks":
        """Return the only rank of a training in one process: nothing is sent."""
        return cls(0, 1, device, "")

    @classmethod
    def join(cls, device: torch.device, *, backend: str | None = None) -> "Ranks":
        """Join the other ranks that the environment tells of; RankError unless all come in time.

        `nexwarp train --gpus` names a file, and torchrun an address. `backend` is that of the gradients; None is NCCL
        for GPUs, else gloo.
        """
        backend = backend or ("nccl" if device.type == "cuda" else "gloo")
        seconds = float(os.environ.get(WAIT_VARIABLE, JOIN_SECONDS))
        wait = timedelta(seconds=seconds)
        file = os.environ.get(STORE)
        try:
            if file is None:
                store, rank, size = next(rendezvous("env://", timeout=wait))
            else:
                rank, size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
                store, _, _ = next(rendezvous(f"file://{file}", rank, size))
                store.set(f"rank {rank}", "is here")
                store.wait([f"rank {other}" for other in range(size)], wait)
            store = PrefixStore("nexwarp", store)
            dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=FOREVER)
        except (RuntimeError, ValueError, OSError) as error:
            place = file or f"{os.environ['MASTER_ADDR']}:{os.environ['MASTER_PORT']}"
            expected = f"expected {os.environ['WORLD_SIZE']} ranks to join at {place} within {seconds:.0f} s"
            raise RankError(f"{expected} ({one_line(error)})") from None
        ranks = cls(rank, size, device, backend)
        ranks.control = dist.new_group(backend="gloo", timeout=FOREVER)
        return ranks

    def __enter__(self) -> "Ranks":
        return self

    def __exit__(self, _: type[BaseException] | None, error: BaseException | None, __: TracebackType | None) -> None:
        if error is None:
            self.close()
        elif isinstance(error, RuntimeError) and not isinstance(error, NexwarpError) and LOST.search(str(error)):
            hint = "--resume continues from the last checkpoint"
            raise LostRankError(f"rank {self.rank}: the connection to another rank is lost; {hint}") from error

    def close(self) -> None:
        """Part from the other ranks, once all are here; after it, each may end when it likes."""
        if self.control is not None:
            self.barrier()
            self.control = None
            dist.destroy_process_group()

    @property
    def first(self) -> bool:
        """Whether this is rank 0."""
        return self.rank == 0

    def barrier(self) -> None:
        """Wait until all ranks are here."""
        if self.size > 1:
            dist.barrier(group=self.control)

    def share_bytes(self, content: bytes | None) -> bytes:
        """Return the content that rank 0 gives; the others' is ignored."""
        if self.size == 1:
            assert content is not None
            return content
        size = torch.tensor([len(content or b"")], dtype=torch.int64)
        dist.broadcast(size, 0, group=self.control)
        data = torch.empty(int(size), dtype=torch.uint8)
        if self.first and content:
            data = torch.frombuffer(bytearray(content), dtype=torch.uint8)
        dist.broadcast(data, 0, group=self.control)
        return data.numpy().tobytes()

    def share(self, value: object) -> Any:
        """Return the JSON value that rank 0 gives; the others' is ignored."""
        return json.loads(self.share_bytes(json.dumps(value).encode())) if self.size > 1 else value

    def gather_bytes(self, content: bytes) -> list[bytes]:
        """Return the content of each rank, on all ranks."""
        if self.size == 1:
            return [content]
        sizes = [torch.zeros(1, dtype=torch.int64) for _ in range(self.size)]
        dist.all_gather(sizes, torch.tensor([len(content)], dtype=torch.int64), group=self.control)
        longest = max(int(size) for size in sizes)
        mine = torch.frombuffer(bytearray(content.ljust(max(longest, 1), b"\0")), dtype=torch.uint8)
        padded = [torch.zeros_like(mine) for _ in range(self.size)]
        dist.all_gather(padded, mine, group=self.control)
        return [x[: int(size)].numpy().tobytes() for x, size in zip(padded, sizes, strict=True)]

    def gather(self, value: object) -> list[Any]:
        """Return the JSON value of each rank, on all ranks."""
        return [json.loads(content) for content in self.gather_bytes(json.dumps(value).encode())]

    def check_same(self, facts: dict[str, str]) -> None:
        """Raise RankError, the same one on all ranks, unless each fact is the same on all of them."""
        first, *others = self.gather(facts)
        for rank, theirs in enumerate(others, 1):
            for name, expected in first.items():
                if theirs[name] != expected:
                    raise RankError(f"rank {rank}: expected the same {name} as rank 0, {expected}, got {theirs[name]}")

    def share_tensors(self, tensors: Iterable[torch.Tensor]) -> None:
        """Overwrite tensors, which are on the ranks' devices, with those of rank 0."""
        if self.size > 1:
            for tensor in tensors:
                dist.broadcast(tensor.detach(), 0)

    def largest(self, values: torch.Tensor) -> torch.Tensor:
        """Return, for each of the values, which are on the ranks' devices, the largest that any rank has."""
        if self.size == 1:
            return values
        values = values.clone()
        dist.all_reduce(values, dist.ReduceOp.MAX)
        return values

    def agree(self, number: int | None, *, now: bool = False) -> int | None:
        """Return the largest number > 0 that ranks gave in their previous call, or in this one with `now`.

        The answer, the same on all ranks, comes one call late, so that no step waits for it.
        """
        if self.size == 1:
            return number
        before = self._voted()
        mine = torch.tensor([number or 0])
        work = dist.all_reduce(mine, dist.ReduceOp.MAX, group=self.control, async_op=True)
        assert work is not None
        self.vote = work, mine
        return max(before, self._voted() if now else 0) or None

    def _voted(self) -> int:
        if self.vote is None:
            return 0
        work, largest = self.vote
        work.wait()
        self.vote = None
        return int(largest)


class GradientReducer:
    """Sums the gradients of one step over the ranks: one all-reduce in two buckets.

    The hash grid's gradient, the largest, is complete before the backward pass goes through the surfels: its bucket is
    the tensor itself, and travels meanwhile. All others and the surfels' error sums follow as a second bucket. Both are
    sent in this order on every rank, whatever a rank renders, and all ranks receive the same bits.

    Attributes:
        overlapped: whether the first bucket is sent as soon as it is complete, or after the backward pass.
        sent: the first bucket of a step, from its sending until both have arrived.
        bytes_sent: bytes of the last step's buckets.
    """

    def __init__(self, early: nn.Parameter | None) -> None:
        """Watch for the gradient of `early`, which is complete first; None sends all at the end."""
        self.early = early
        self.overlapped = True
        self.sent: dist.Work | None = None
        self.bytes_sent = 0
        if early is not None:
            early.register_post_accumulate_grad_hook(self._send_early)

    def _send_early(self, parameter: torch.Tensor) -> None:
        if self.overlapped:
            self._send(parameter)

    def _send(self, parameter: torch.Tensor) -> None:
        assert parameter.grad is not None
        self.bytes_sent = parameter.grad.nbytes
        self.sent = dist.all_reduce(parameter.grad, async_op=True)

    def finish(self, parameters: Sequence[nn.Parameter], sums: torch.Tensor | None) -> torch.Tensor | None:
        """Replace the gradients of parameters by their sums over the ranks, after the backward pass.

        Parameters have the same order on all ranks; one without a gradient counts as zero. `sums`, (N,), are further
        numbers to sum, or None on all ranks; their sums are returned.
        """
        for parameter in parameters:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        if self.early is not None and self.sent is None:
            self._send(self.early)
        early = self.sent
        rest = [x for x in parameters if x is not self.early]
        parts = [x.grad for x in rest if x.grad is not None] + ([] if sums is None else [sums])
        flat, places = _flattened(parts)
        self.bytes_sent = (0 if early is None else self.bytes_sent) + flat.nbytes
        last = dist.all_reduce(flat, async_op=True)
        for work in (early, last):
            if work is not None:
                work.wait()
        self.sent = None
        for parameter, place in zip(rest, places, strict=False):
            parameter.grad = place
        return None if sums is None else places[-1]


def _flattened(parts: Sequence[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Return one vector that holds copies of all tensors, and these copies."""
    lengths = [-(-x.numel() // ALIGNMENT) * ALIGNMENT for x in parts]
    flat = parts[0].new_zeros(sum(lengths))
    places = [x[: part.numel()].view(part.shape) for x, part in zip(flat.split(lengths), parts, strict=True)]
    torch._foreach_copy_(places, list(parts))
    return flat, places


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
