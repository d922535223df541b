"""The panel of a training, which all clients share: progress, pause, and the share of time for pictures."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from nexwarp.viewer.pacing import Share
from nexwarp.viewer.panel import set_value

if TYPE_CHECKING:
    import viser

TELL_SECONDS = 0.5  # between two updates of the status line


class TrainingPanel:
    """Controls of a training.

    Attributes:
        paused: whether the training is held between two steps.
    """

    def __init__(self, gui: "viser.GuiApi", total: int, share: Share, wake: Callable[[], None]) -> None:
        """Add the controls.

        Args:
            gui: of the server.
            total: number of iterations.
            share: share of time for pictures, which a slider sets.
            wake: called when the training is paused or resumed.
        """
        from viser import Icon

        self.total, self.share, self.wake = total, share, wake
        self.paused = False
        self._told: tuple[float, int] | None = None
        with gui.add_folder("Training", order=0.0):
            self.progress = gui.add_progress_bar(0.0)
            self.status = gui.add_markdown("starting")
            self.pause = gui.add_button("Pause", icon=Icon.PLAYER_PAUSE)
            self.share_slider = gui.add_slider(
                "Time for pictures",
                5,
                80,
                5,
                round(100 * share.share),
                hint="Percent of the training's time, while a browser is connected",
            )

        async def pause(_: object) -> None:
            self.toggle_pause()

        async def set_share(event: "viser.GuiEvent[viser.GuiSliderHandle[int]]") -> None:
            if math.isfinite(event.target.value):
                self.share.set(event.target.value)

        self.pause.on_click(pause)
        self.share_slider.on_update(set_share)

    def toggle_pause(self) -> None:
        """Pause the training, or resume it."""
        from viser import Icon

        self.paused = not self.paused
        self.pause.label = "Resume" if self.paused else "Pause"
        self.pause.icon = Icon.PLAYER_PLAY if self.paused else Icon.PLAYER_PAUSE
        self.wake()

    def tell(self, step: int, describe: Callable[[], str], now: float, force: bool = False) -> None:
        """Show the progress, unless that was done within `TELL_SECONDS`.

        Args:
            step: number of finished iterations.
            describe: returns a status line.
            now: the time, seconds.
            force: show it in any case.
        """
        if not force and self._told is not None and now - self._told[0] < TELL_SECONDS:
            return
        how = "paused" if self.paused else "training"
        if self._told is not None and not self.paused and now > self._told[0]:
            how = f"{(step - self._told[1]) / (now - self._told[0]):.1f} it/s"
        set_value(self.progress, 100.0 * step / max(self.total, 1))
        self.status.content = f"**{step:,}** of {self.total:,} · {how}  \n{describe()}"
        self._told = (now, step)

    def finish(self, text: str) -> None:
        """Resume a paused training, show a status line, and hide the controls."""
        self.paused = False
        self.status.content = text
        set_value(self.progress, 100.0)
        for handle in (self.pause, self.share_slider):
            handle.visible = False
