"""Forks the ranks of a training: a fork needs no second to import torch."""

import hashlib
import json
import multiprocessing
import os
import socket
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path

import torch
from torch import nn

from nexwarp.data import Scene
from nexwarp.kernels.launch import set_num_threads
from nexwarp.model.model import Model
from nexwarp.train.parallel import ParallelTrainer
from nexwarp.train.ranks.ranks import GradientReducer, Ranks
from nexwarp.train.recipe import Config
from nexwarp.train.trainer import Trainer
from tests.trainer_support import state_of

CPU = torch.device("cpu")
SECONDS = 240.0


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def environment(rank: int, size: int, port: int) -> dict[str, str]:
    """The variables that torchrun sets."""
    numbers = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": size, "LOCAL_WORLD_SIZE": size, "MASTER_PORT": port}
    named = {name: str(number) for name, number in numbers.items()}
    return {**named, "MASTER_ADDR": "127.0.0.1", "TORCH_CPP_LOG_LEVEL": "ERROR"}


def start_ranks(size: int, work: Callable[[int], int], folder: Path) -> list[BaseProcess]:
    """Fork ranks that end with the code that `work` returns; what each prints is in `folder/RANK.out` and `.err`."""
    port = free_port()
    folder.mkdir(parents=True, exist_ok=True)

    def run(rank: int) -> None:
        code = 99
        try:
            os.environ.update(environment(rank, size, port))
            for stream, name in ((sys.stdout, "out"), (sys.stderr, "err")):
                number = os.open(folder / f"{rank}.{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                stream.flush()
                os.dup2(number, 1 if stream is sys.stdout else 2)
            # pytest's own streams do not end at the file descriptors.
            sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
            torch.set_num_threads(1)
            set_num_threads(1)
            code = work(rank)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    fork = multiprocessing.get_context("fork")
    processes: list[BaseProcess] = [fork.Process(target=run, args=(rank,)) for rank in range(size)]
    for process in processes:
        process.start()
    return processes


def wait(processes: list[BaseProcess], seconds: float = SECONDS) -> list[int | None]:
    """Return the exit codes; whoever has not ended after so many seconds is killed."""
    until = time.monotonic() + seconds
    for process in processes:
        process.join(max(until - time.monotonic(), 0.0))
    codes = [process.exitcode for process in processes]
    for process in processes:
        process.kill()
        process.join()
    return codes


def printed(folder: Path, kind: str = "err") -> list[str]:
    """Lines that all ranks printed, without Warp's about a missing driver."""
    lines = [line for file in sorted(folder.glob(f"*.{kind}")) for line in file.read_text().splitlines()]
    return [line for line in lines if line and not line.startswith("Warp CUDA warning")]


def run_ranks(size: int, work: Callable[[Ranks], object], folder: Path) -> list[object]:
    """Let ranks do some work, and return what it returned on each, as JSON."""

    def joined(rank: int) -> int:
        with Ranks.join(CPU) as ranks:
            found = work(ranks)
        (folder / f"{rank}.json").write_text(json.dumps(found))
        return 0

    codes = wait(start_ranks(size, joined, folder))
    assert codes == [0] * size, (codes, printed(folder))
    return [json.loads((folder / f"{rank}.json").read_text()) for rank in range(size)]


def digest(trainer: Trainer) -> str:
    """Digest of everything that a training's future depends on."""
    found = hashlib.sha256()
    for name, value in sorted(state_of(trainer).items()):
        found.update(name.encode() + value.cpu().contiguous().numpy().tobytes())
    return found.hexdigest()


class Unsent(GradientReducer):
    """Leaves gradients as they are."""

    def finish(self, parameters: Sequence[nn.Parameter], sums: torch.Tensor | None) -> torch.Tensor | None:
        return sums


@contextmanager
def kept_gradients(trainer: Trainer) -> Iterator[list[dict[str, torch.Tensor]]]:
    """Gradients with which each step of the context updates the parameters, by name."""
    kept: list[dict[str, torch.Tensor]] = []
    step = trainer.optimizer.step

    def keep() -> None:
        kept.append({name: x.grad.clone() for name, x in trainer._named_parameters() if x.grad is not None})
        step()

    trainer.optimizer.step = keep  # type: ignore[method-assign,assignment]
    yield kept
    trainer.optimizer.step = step  # type: ignore[method-assign]


def alone_as(rank: int, size: int, scene: Scene, config: Config, teachers: Sequence[Model] = ()) -> ParallelTrainer:
    """A trainer in one process that takes the views of one of several ranks and sends nothing."""
    ranks = Ranks.alone(CPU)
    trainer = ParallelTrainer(scene, config, CPU, ranks, teachers=teachers)
    ranks.rank, ranks.size = rank, size
    trainer.reducer.overlapped, trainer.reducer = False, Unsent(None)
    return trainer
