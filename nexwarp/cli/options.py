"""Options that several commands share, and the device that they name."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import torch
import tyro
import warp as wp

from nexwarp.cli import __version__
from nexwarp.data.option import option
from nexwarp.errors import RankError, SettingError, require
from nexwarp.kernels.launch import get_num_threads, set_num_threads
from nexwarp.train.ranks.ranks import Ranks, is_rank

Run_ = Annotated[
    Path, tyro.conf.Positional, option("RUN", text="Run folder, or a model's folder or .safetensors file.")
]
Device_ = Annotated[str | None, option("{cuda,cpu}", "cuda if there is one")]
Preset_ = Annotated[str, option("NAME")]
Port_ = Annotated[int, option("PORT")]
Host_ = Annotated[str, option("ADDRESS")]


def pick_device(name: str | None) -> torch.device:
    """Return the device of this name; None selects CUDA if available, else the CPU. SettingError if there is none."""
    require(name in (None, "cuda", "cpu"), f"--device: expected cuda or cpu, got {name!r}")
    available = torch.cuda.is_available()
    missing = "--device: expected a CUDA device, but torch finds no CUDA device; use --device cpu"
    require(available or name != "cuda", missing)
    if name == "cpu" or not available:
        return torch.device("cpu")
    return torch.device("cuda", torch.cuda.current_device())


@contextmanager
def joined_ranks(name: str | None, gpus: int | None) -> Iterator[Ranks]:
    """Join the other ranks of a training, if torchrun has started this process as one of several.

    `name` is that of `pick_device`; `gpus` is the number of ranks that the command asks for, None for what there is.
    """
    if not is_rank():
        yield Ranks.alone(pick_device(name))
        return
    if gpus not in (None, int(os.environ["WORLD_SIZE"])):
        raise SettingError(f"--gpus: expected {os.environ['WORLD_SIZE']}, as many as torchrun has started, got {gpus}")
    local_rank = int(os.environ.get("LOCAL_RANK", os.environ["RANK"]))
    local_size = int(os.environ.get("LOCAL_WORLD_SIZE", os.environ["WORLD_SIZE"]))
    if pick_device(name).type == "cpu":
        set_num_threads(max(1, get_num_threads() // local_size))
    elif local_rank >= (count := torch.cuda.device_count()):
        raise RankError(
            f"rank {os.environ['RANK']}: expected a GPU of its own, but {count} are there for {local_size} ranks"
        )
    else:
        torch.cuda.set_device(local_rank)
        wp.set_device(f"cuda:{local_rank}")
    with Ranks.join(pick_device(name)) as ranks:
        ranks.check_same({"nexwarp": __version__, "torch": torch.__version__, "Warp": wp.__version__})
        yield ranks
