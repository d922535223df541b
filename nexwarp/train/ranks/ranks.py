"""The ranks of a training: processes with a device each, and the few things that they tell each other.

Gradients travel on the default process group, NCCL between GPUs and gloo between CPUs. Everything else, such as
settings, checkpoints and votes, travels between CPUs on a second group, which is always gloo. The content of messages
is JSON or raw bytes; nothing is unpickled.
"""

import json
import os
import socket
from collections.abc import Iterable
from types import TracebackType

import torch
import torch.distributed as dist

from nexwarp.errors import RankError
from nexwarp.train.ranks.join import FOREVER, Place, first_difference, join_store
from nexwarp.train.ranks.liveness import Liveness


class Ranks:
    """The ranks of a training, seen from one of them; a context, in which the death of one rank ends all.

    Attributes:
        rank: number of this one, from 0; rank 0 writes files and shows progress.
        size: how many there are.
        local_rank: number of this one among those on this machine, which have consecutive ranks.
        local_size: how many of them are on this machine.
        device: of this rank.
        backend: of the gradients, "nccl" or "gloo"; "" for a process alone.
        launch: identifies the launch; the same after torchrun has restarted the ranks. "" for a process alone.
        restarted: whether torchrun has restarted the ranks.
    """

    def __init__(self, place: Place, device: torch.device, backend: str) -> None:
        """Use `join`, or `alone`, instead."""
        self.rank, self.size = place.rank, place.size
        self.local_rank, self.local_size = place.local_rank, place.local_size
        self.device, self.backend = device, backend
        self.launch, self.restarted = place.launch, place.restarted
        self.control: dist.ProcessGroup | None = None
        self.liveness: Liveness | None = None
        self.vote: tuple[dist.Work, torch.Tensor] | None = None

    @classmethod
    def alone(cls, device: torch.device) -> "Ranks":
        """Return the only rank of a training in one process: nothing is sent."""
        return cls(Place(0, 1, 0, 1, "", False), device, "")

    @classmethod
    def join(
        cls,
        device: torch.device,
        facts: dict[str, str],
        *,
        fault: str | None = None,
        backend: str | None = None,
        hint: str = "",
    ) -> "Ranks":
        """Join the other ranks that the environment variables of torchrun tell of.

        Args:
            device: of this rank.
            facts: what must be the same on all ranks, such as the version of the code, by name.
            fault: why this rank cannot take part; None if it can.
            backend: of the gradients; None is NCCL for GPUs, else gloo.
            hint: added to the message when a rank has died.

        Raises:
            RankError: not all ranks came, one cannot take part, or their facts differ; all ranks raise the same, unless
                the end of another, which has told why, ends a rank first.
        """
        place = Place.of_environment()
        store = join_store(place)
        backend = backend or ("nccl" if device.type == "cuda" else "gloo")
        ranks = cls(place, device, backend)
        dist.init_process_group(backend, store=store, rank=place.rank, world_size=place.size, timeout=FOREVER)
        ranks.control = dist.new_group(backend="gloo", timeout=FOREVER)
        watched = dist.new_group(backend="gloo", timeout=FOREVER)
        names = [str(name) for name in ranks.gather(f"process {os.getpid()} on {socket.gethostname()}")]
        ranks.liveness = Liveness(place, watched, names, hint)
        try:
            if (told := next((x for x in ranks.gather(fault) if x is not None), None)) is not None:
                raise RankError(str(told))
            ranks.check_same(facts)
        except BaseException as error:  # the caller has no context yet that would tell the others
            ranks.liveness.fail(error)
            raise
        return ranks

    def __enter__(self) -> "Ranks":
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        if self.liveness is None:
            return
        if error is not None:
            self.liveness.fail(error)
        else:
            self.close()

    def close(self) -> None:
        """Part from the other ranks, once all are here; after it, each may end when it likes."""
        if self.liveness is None:
            return
        self.barrier()
        self.liveness.close()
        self.liveness = self.control = None
        dist.destroy_process_group()

    @property
    def first(self) -> bool:
        """Whether this is rank 0."""
        return self.rank == 0

    def leave_together(self) -> None:
        """Wait until all ranks are here; from now on, no rank's end is an error."""
        if self.liveness is not None:
            self.liveness.leaving = True
            self.barrier()

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

    def share(self, value: object) -> object:
        """Return the JSON value that rank 0 gives; the others' is ignored."""
        return json.loads(self.share_bytes(json.dumps(value).encode())) if self.size > 1 else value

    def gather_bytes(self, content: bytes) -> list[bytes]:
        """Return the content of each rank, on all ranks."""
        if self.size == 1:
            return [content]
        sizes = [torch.zeros(1, dtype=torch.int64) for _ in range(self.size)]
        dist.all_gather(sizes, torch.tensor([len(content)], dtype=torch.int64), group=self.control)
        longest = max(int(size) for size in sizes)
        mine = torch.zeros(longest, dtype=torch.uint8)
        mine[: len(content)] = torch.frombuffer(bytearray(content or b"\0"), dtype=torch.uint8)[: len(content)]
        found = [torch.zeros(longest, dtype=torch.uint8) for _ in range(self.size)]
        dist.all_gather(found, mine, group=self.control)
        return [x[: int(size)].numpy().tobytes() for x, size in zip(found, sizes, strict=True)]

    def gather(self, value: object) -> list[object]:
        """Return the JSON value of each rank, on all ranks."""
        return [json.loads(content) for content in self.gather_bytes(json.dumps(value).encode())]

    def check_same(self, facts: dict[str, str]) -> None:
        """Raise RankError, the same one on all ranks, unless each fact is the same on all of them."""
        told = first_difference(self.gather(facts))
        if told is not None:
            raise RankError(told)

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
        """Return the largest number that ranks gave in their previous call; the same on all ranks.

        The answer comes one call late, so that no step waits for it.

        Args:
            number: of this rank, > 0; None is none.
            now: answer by this call's numbers, which waits for the other ranks.
        """
        if self.size == 1:
            return number
        before, given = self._voted(), torch.tensor([number or 0])
        work = dist.all_reduce(given, dist.ReduceOp.MAX, group=self.control, async_op=True)
        assert work is not None
        self.vote = work, given
        return max(before, self._voted() if now else 0) or None

    def _voted(self) -> int:
        if self.vote is None:
            return 0
        work, given = self.vote
        work.wait()
        self.vote = None
        return int(given)
