"""Choice and set-up of the device that a command runs on."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
import warp as wp

from nexwarp.errors import SettingError
from nexwarp.kernels.launch import get_num_threads, set_num_threads
from nexwarp.train.ranks.join import Place, code_digest, is_rank
from nexwarp.train.ranks.launch import check_count
from nexwarp.train.ranks.ranks import Ranks


def pick_device(name: str | None) -> torch.device:
    """Return the device of this name; None selects CUDA if available, else the CPU. SettingError if there is none."""
    if name not in (None, "cuda", "cpu"):
        raise SettingError(f"--device: expected cuda or cpu, got {name!r}")
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise SettingError("--device: expected a CUDA device, but torch finds no CUDA device; use --device cpu")
    if name == "cpu" or not available:
        return torch.device("cpu")
    return torch.device("cuda", torch.cuda.current_device())


@contextmanager
def joined_ranks(name: str | None, gpus: int | None) -> Iterator[Ranks]:
    """Join the other ranks of a training, if torchrun has started this process as one of several.

    `name` is that of `pick_device`; `gpus` is the number of ranks that the command asks for, None for what there is.
    """
    if not is_rank():
        if gpus is not None:
            check_count(gpus, name)
        yield Ranks.alone(pick_device(name))
        return
    place = Place.of_environment()
    if gpus not in (None, place.size):
        raise SettingError(f"--gpus: expected {place.size}, as many as torchrun has started, got {gpus}")
    facts = {"code of nexwarp": code_digest(), "version of torch": torch.__version__, "version of Warp": wp.__version__}
    device = pick_device(name)
    fault = None
    if device.type == "cuda" and place.local_rank >= (count := torch.cuda.device_count()):
        fault = f"rank {place.rank}: expected a GPU of its own, but {count} are there for {place.local_size} ranks"
    elif device.type == "cuda":
        torch.cuda.set_device(place.local_rank)
        wp.set_device(f"cuda:{place.local_rank}")
        properties = torch.cuda.get_device_properties(place.local_rank)
        facts["GPU"] = f"{properties.name} with {properties.total_memory / 2**30:.0f} GiB"
    else:
        facts["device"] = "a CPU"
        set_num_threads(max(1, get_num_threads() // place.local_size))
    hint = "; --resume continues from the last checkpoint"
    with Ranks.join(pick_device(name), facts, fault=fault, hint=hint) as ranks:
        yield ranks
