"""Watching a training: numbers that are no longer finite, and memory that does not suffice."""

import math
import re
from collections.abc import Mapping

import torch

ALLOCATION = re.compile(r"(?:tried|failed|unable) to allocate ([\d.]+ ?(?:[KMGT]iB|bytes))", re.I)

# Of CUDA's own calls, and of its libraries, which do not say how much they wanted.
EXHAUSTED = re.compile(
    r"CUDA (driver )?error:? .*out of memory|_ALLOC_FAILED|cudaErrorMemoryAllocation|bad_alloc", re.I
)

UNKNOWN = "more than there is"


class LossLog:
    """Losses of the iterations since they were last looked at; looking costs one wait for the GPU, noting none."""

    def __init__(self) -> None:
        self.noted: list[tuple[int, str, torch.Tensor]] = []

    def note(self, iteration: int, losses: Mapping[str, torch.Tensor]) -> None:
        """Keep the terms (scalars) of an iteration."""
        self.noted += [(iteration, name, value.detach()) for name, value in losses.items()]

    def first_bad(self) -> tuple[int, str, float] | None:
        """Return iteration, term and value of the first loss that is not finite, if any; forget all."""
        noted, self.noted = self.noted, []
        if not noted:
            return None
        values = torch.stack([value for _, _, value in noted]).tolist()
        bad = ((i, name, x) for (i, name, _), x in zip(noted, values, strict=True) if not math.isfinite(x))
        return next(bad, None)


def not_finite(tensors: Mapping[str, torch.Tensor]) -> list[str]:
    """Return the names of the tensors that hold NaN or infinity: one reduction of each, one wait for the GPU."""
    filled = {name: x.detach() for name, x in tensors.items() if x.numel()}
    if not filled:
        return []
    # A maximum hands NaN on, and cannot overflow as a sum does.
    largest = torch.stack([torch.linalg.vector_norm(x, math.inf).float() for x in filled.values()])
    return [name for name, x in zip(filled, largest.tolist(), strict=True) if not math.isfinite(x)]


def describe(name: str, tensor: torch.Tensor) -> str:
    """Tell how many values of a tensor are not finite, and where the first one is."""
    bad = (~torch.isfinite(tensor.detach())).nonzero()
    where = tuple(bad[0].tolist())
    return f"{name}: {len(bad):,} of {tensor.numel():,} values, the first {tensor[where].item()} at index {where}"


def needed_memory(error: BaseException) -> str | None:
    """Return what an error of torch or Warp says of the memory that it did not get; None for other errors."""
    if not isinstance(error, (MemoryError, RuntimeError)):
        return None
    match = ALLOCATION.search(str(error))
    if match is not None:
        return _readable(match[1])
    exhausted = isinstance(error, (MemoryError, torch.OutOfMemoryError)) or EXHAUSTED.search(str(error))
    return UNKNOWN if exhausted else None


def _readable(amount: str) -> str:
    match = re.fullmatch(r"(\d+) ?bytes", amount, re.I)
    if match is None:
        return amount
    size = int(match[1])
    return f"{size / 2**30:.2f} GiB" if size >= 2**30 else f"{size / 2**20:.2f} MiB"
