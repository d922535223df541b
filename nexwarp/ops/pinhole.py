"""The image plane that the passes see: a camera without its pose."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics and size of an image.

    Attributes:
        fx, fy, cx, cy: pixels; pixel centres lie at +0.5.
        width, height: pixels.
        near: hits with a z-depth of at most this (world units) are ignored.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy)."""
        return self.fx, self.fy, self.cx, self.cy
