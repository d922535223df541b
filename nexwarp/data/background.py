"""Colours behind transparent photos, as users give them."""

from collections.abc import Sequence

COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def parse_color(color: str | Sequence[float] | None) -> tuple[float, float, float] | None:
    """Three numbers in [0, 1] of a colour's name, of "R,G,B" or of three numbers; None stays None.

    Raises:
        ValueError: anything else.
    """
    if color is None:
        return None
    if isinstance(color, str) and color in COLORS:
        return COLORS[color]
    try:
        values = tuple(float(x) for x in (color.split(",") if isinstance(color, str) else color))
    except (TypeError, ValueError):
        values = ()
    if len(values) != 3 or not all(0 <= x <= 1 for x in values):
        raise ValueError(f"background: expected white, black, random or three numbers in [0, 1], got {color!r}")
    return values
