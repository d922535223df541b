"""Events and values of the panels' controls.

Coroutines run on viser's event loop, one after another. Functions would wait for a thread of its pool, in a queue
without a limit.
"""

import math
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import viser

T = TypeVar("T")


def on_change(control: "viser.GuiInputHandle[T]", act: Callable[[T], None]) -> None:
    """Call `act` with each new value of a control."""

    async def updated(event: "viser.GuiEvent[viser.GuiInputHandle[T]]") -> None:
        act(event.target.value)

    control.on_update(updated)


def on_click(button: "viser.GuiButtonHandle", act: Callable[[], Awaitable[None] | None]) -> None:
    """Call `act`, or await it, at each click."""

    async def clicked(_: object) -> None:
        done = act()
        if done is not None:
            await done

    button.on_click(clicked)


def set_changed(handle: object, name: str, value: object) -> None:
    """Set a property of a control if that changes it."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def within(value: float, ends: tuple[float, float]) -> float:
    """Clamp a number to a range; NaN and infinity become its lower end."""
    return min(max(value, ends[0]), ends[1]) if math.isfinite(value) else ends[0]
