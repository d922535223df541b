"""Sums gradients over the ranks: one all-reduce in two buckets, the first of which overlaps the backward pass."""

from collections.abc import Sequence

import torch
import torch.distributed as dist
from torch import nn

ALIGNMENT = 4  # numbers; vector loads need addresses that are multiples of 16 bytes


class GradientReducer:
    """Sums the gradients of one step over the ranks.

    The hash grid's gradient, the largest, is complete before the backward pass goes through the surfels: its bucket is
    the tensor itself, and travels meanwhile. All others and the surfels' error sums follow as a second bucket. Both are
    sent in this order on every rank, whatever a rank renders, and all ranks receive the same bits.

    Attributes:
        sent: the first bucket of a step, from its sending until both have arrived.
        bytes_sent: bytes of the last step's buckets.
    """

    def __init__(self, early: nn.Parameter | None) -> None:
        """Watch for the gradient that is complete first.

        Args:
            early: the parameter whose gradient is sent as soon as it is complete; None sends all at the end.
        """
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
        self.bytes_sent = _bytes(parameter.grad)
        self.sent = dist.all_reduce(parameter.grad, async_op=True)

    def finish(self, parameters: Sequence[nn.Parameter], sums: torch.Tensor | None) -> torch.Tensor | None:
        """Replace the gradients of parameters by their sums over the ranks, after the backward pass.

        Args:
            parameters: all trained ones, in the same order on all ranks; one without a gradient counts as zero.
            sums: (N,) further numbers to sum, or None on all ranks.

        Returns:
            The summed `sums`.
        """
        for parameter in parameters:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        if self.early is not None and self.sent is None:
            self._send(self.early)
        early, rest = self.sent, [x for x in parameters if x is not self.early]
        parts = [x.grad for x in rest if x.grad is not None] + ([] if sums is None else [sums])
        flat, places = _flattened(parts)
        self.bytes_sent = (0 if early is None else self.bytes_sent) + _bytes(flat)
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


def _bytes(tensor: torch.Tensor) -> int:
    return tensor.numel() * tensor.element_size()
