"""Turns trained surfels into a finished model."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any


def counted(views: Sequence[Any], stage: str, observe: Callable[[str, int, int], None]) -> Iterator[Any]:
    """The views, each of which is done when the next one is asked for."""
    for done, view in enumerate(views, 1):
        yield view
        observe(stage, done, len(views))
