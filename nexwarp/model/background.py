"""The colour behind everything."""

import numbers
from collections.abc import Iterable, Sequence

import torch

from nexwarp.errors import check_finite

Color = float | Sequence[float] | torch.Tensor


def color_tensor(background: Color, like: torch.Tensor) -> torch.Tensor:
    """Return the background as a (3,) tensor; a tensor keeps its graph."""
    if isinstance(background, torch.Tensor):
        if background.device.type == "cpu":
            check_finite("background", background.detach())
        return background.expand(3) if background.ndim == 0 else background
    return torch.stack([like.new_full((), x) for x in background_numbers(background, like.dtype)])


def background_numbers(background: float | Sequence[float], dtype: torch.dtype) -> list[float]:
    """Return a background that is no tensor as three numbers; raise TypeError or ValueError where it is none."""
    values: Sequence[object]
    if isinstance(background, numbers.Real):
        values = [background] * 3
    elif isinstance(background, Iterable) and not isinstance(background, str):
        values = list(background)
    else:
        raise TypeError(f"background: expected numbers or a tensor, got {type(background).__name__}")
    if len(values) != 3:
        raise ValueError(f"background: expected 3 values, got {len(values)}")
    numbers_ = [float(x) for x in values if isinstance(x, numbers.Real)]
    if len(numbers_) != 3:
        raise TypeError(f"background: expected three numbers or a tensor, got {values}")
    for x in numbers_:
        if not abs(x) <= torch.finfo(dtype).max:
            raise ValueError(f"background: expected finite values, got {x}")
    return numbers_
