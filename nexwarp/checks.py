"""Argument checks; each message names the argument, the expected value and the given one."""

from collections.abc import Mapping

import torch


def check_tensors(
    tensors: Mapping[str, tuple[torch.Tensor, tuple[int | str, ...]]],
    *,
    dtype: torch.dtype | None = None,
    device: torch.device | None = None,
) -> dict[str, int]:
    """Check the types, shapes, dtypes and devices of several tensors.

    Args:
        tensors: argument name -> (tensor, shape); a string in a shape names a dimension, which must
            have the same size wherever the name occurs.
        dtype: dtype of all tensors; by default that of the first one, which must be floating.
        device: device of all tensors; by default that of the first one.

    Returns:
        The sizes of the named dimensions.

    Raises:
        TypeError: a value is not a tensor or has another dtype.
        ValueError: a tensor has another shape or is on another device.
    """
    sizes: dict[str, int] = {}
    for name, (tensor, shape) in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name}: expected a torch.Tensor, got {type(tensor).__name__}")
        if dtype is None:
            if not tensor.is_floating_point():
                raise TypeError(f"{name}: expected a floating dtype, got {tensor.dtype}")
            dtype = tensor.dtype
        if device is None:
            device = tensor.device
        if tensor.dtype != dtype:
            raise TypeError(f"{name}: expected dtype {dtype}, got {tensor.dtype}")
        if tensor.device != device:
            raise ValueError(f"{name}: expected a tensor on {device}, got one on {tensor.device}")
        fits = tensor.ndim == len(shape)
        for size, want in zip(tensor.shape, shape, strict=False):
            expected = sizes.setdefault(want, size) if isinstance(want, str) else want
            fits &= size == expected
        if not fits:
            text = ", ".join(
                f"{want}={sizes[want]}" if isinstance(want, str) and want in sizes else str(want) for want in shape
            )
            raise ValueError(f"{name}: expected shape ({text}), got {tuple(tensor.shape)}")
    return sizes


def check_finite(name: str, tensor: torch.Tensor) -> None:
    """Raise ValueError naming the first element of `tensor` that is NaN or infinite."""
    bad = ~torch.isfinite(tensor)
    if bool(bad.any()):
        where = tuple(torch.nonzero(bad)[0].tolist())
        raise ValueError(f"{name}: expected finite values, got {tensor[where].item()} at index {where}")


def check_values(name: str, tensor: torch.Tensor, low: float, high: float) -> None:
    """Raise ValueError naming the first element of `tensor` that is NaN or not in [low, high]."""
    if tensor.numel() == 0:
        return
    least, most = tensor.aminmax()  # both are NaN if an element is
    if not (least >= low and most <= high):
        where = tuple(torch.nonzero(~((tensor >= low) & (tensor <= high)))[0].tolist())
        raise ValueError(
            f"{name}: expected values from {low:g} to {high:g}, got {tensor[where].item():g} at index {where}"
        )


def check_version(value: object, known: int) -> None:
    """Raise ValueError unless a file's format version is an integer from 1 to the newest known one."""
    if type(value) is not int or not 1 <= value <= known:
        newer = type(value) is int and value > known
        reason = "; a newer nexwarp wrote the file, update nexwarp to read it" if newer else ""
        expected = "1" if known == 1 else f"1 to {known}"
        raise ValueError(f"expected format version {expected}, got {value!r:.60}{reason}")


def check_range(name: str, value: float, low: float, high: float = float("inf")) -> None:
    """Raise ValueError unless low <= value <= high."""
    if not low <= value <= high:
        upper = "" if high == float("inf") else f" and at most {high:g}"
        raise ValueError(f"{name}: expected at least {low:g}{upper}, got {value!s:.60}")
