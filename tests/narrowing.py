"""What a type checker cannot see by itself: an optional value that is there, a sum that is a tensor."""

from collections.abc import Iterable
from typing import TypeVar

import torch

import nexwarp as nw

T = TypeVar("T")


def present(value: T | None) -> T:
    """Return `value`, which must not be None."""
    assert value is not None
    return value


def neural(texture: object) -> nw.NeuralTexture:
    """Return a texture, which must be ours."""
    assert isinstance(texture, nw.NeuralTexture)
    return texture


def total(terms: Iterable[torch.Tensor | None]) -> torch.Tensor:
    """Sum one or more terms, none of which may be None."""
    first, *rest = map(present, terms)
    return sum(rest, first)
