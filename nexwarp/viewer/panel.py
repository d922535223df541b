"""The panel beside the picture: one for each client, its values taken to what can be meant."""

import html
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from nexwarp.kernels.types import MAX_HITS
from nexwarp.viewer.modes import BY_SLOT, MODES, Picture, Settings, viridis

if TYPE_CHECKING:
    import viser

FOV_DEGREES = (15.0, 110.0)
SCREENSHOT_HEIGHTS = (64, 2160)
HELP = """\
**Drag** orbit · **right drag** pan · **scroll** zoom

**W A S D** fly · **Q E** down, up · **arrows** turn

**Click a frustum** to stand where its photo was taken"""


class Actions(Protocol):
    """What a panel asks its client's session to do."""

    settings: Settings

    def change(self, **values: Any) -> None:
        """Change what is shown."""

    def look(self, degrees: float) -> None:
        """Set the vertical field of view."""

    def jump(self, name: str) -> None:
        """Go to a camera of the scene."""

    def reset(self) -> None:
        """Go to where the client started."""

    def show_cameras(self, visible: bool, size: float) -> None:
        """Show or hide the frustums."""

    def take_screenshot(self, height: int) -> None:
        """Render the present view at a height and send it as a PNG file."""

    def add_keyframe(self) -> None:
        """Add the present view to the path."""

    def remove_keyframe(self) -> None:
        """Remove the path's last keyframe."""

    def play(self, seconds: float, closed: bool) -> None:
        """Move along the path, or stop doing so."""

    def save_path(self, width: int, height: int, fps: float, seconds: float, closed: bool) -> None:
        """Write the path."""


class Panel:
    """The controls of one client."""

    def __init__(
        self, gui: "viser.GuiApi", actions: Actions, cameras: Sequence[str], fov: float, size: tuple[int, int]
    ) -> None:
        """Make the controls.

        Args:
            gui: of the client.
            actions: what they do.
            cameras: names of the scene's cameras.
            fov: field of view to start with, degrees.
            size: width and height that path videos start with.
        """
        self.gui, self.actions = gui, actions
        tabs = gui.add_tab_group(order=10.0)
        with tabs.add_tab("Look"):
            self._look(fov)
        with tabs.add_tab("Cameras"):
            self._cameras(cameras)
        with tabs.add_tab("Record"):
            self._record(size)
        gui.add_divider(order=15.0)
        gui.add_markdown(HELP, order=20.0)

    def _look(self, fov: float) -> None:
        gui, settings = self.gui, self.actions.settings
        self.mode = gui.add_dropdown("Show", tuple(MODES), initial_value=settings.mode)
        self.legend = gui.add_html("")
        self.slot = gui.add_slider(
            "Hit", 1, MAX_HITS, 1, settings.slot, hint="Which of a pixel's hits to show; 1 is the heaviest"
        )
        self.max_hits = gui.add_slider(
            "K", 0, MAX_HITS, 1, settings.max_hits, hint="How many hits a pixel takes from the neural texture"
        )
        self.sh_degree = gui.add_slider(
            "SH degree", 0, 3, 1, settings.sh_degree, hint="How much colours may change with the direction of view"
        )
        self.as_trained = gui.add_checkbox(
            "Photo detail",
            settings.as_trained,
            hint="Where pixels are finer than the photos', leave out texture detail that no photo has shown",
        )
        self.photo_exposure = gui.add_checkbox(
            "Photo exposure",
            settings.photo_exposure,
            hint="Brightness and white balance of the photos around, which differ from place to place; off: their mean",
        )
        self.fov = gui.add_slider("Field of view", *FOV_DEGREES, 1.0, _within(round(fov), FOV_DEGREES), hint="Vertical")
        self.status = gui.add_html("")
        for name in ("mode", "slot", "max_hits", "sh_degree", "as_trained", "photo_exposure"):
            self._on(getattr(self, name), lambda value, name=name: self._change(**{name: value}))
        self._on(self.fov, lambda value: self.actions.look(_within(value, FOV_DEGREES)))
        self.show(None, None)

    def _cameras(self, names: Sequence[str]) -> None:
        gui = self.gui
        reset = gui.add_button("Back to the start", icon="home")
        reset.on_click(lambda _: self.actions.reset())
        if not names:
            gui.add_markdown("This run holds no cameras.")
            return
        jump = gui.add_dropdown("Go to", tuple(names), hint="Stand where a photo was taken")
        self._on(jump, self.actions.jump)
        again = gui.add_button("Go there", icon="camera")
        again.on_click(lambda _: self.actions.jump(jump.value))
        visible = gui.add_checkbox("Show cameras", True, hint="Blue: training views. Orange: test views.")
        size = gui.add_slider("Size", 0.1, 4.0, 0.1, 1.0, hint="Of the frustums")
        for handle in (visible, size):
            self._on(handle, lambda _: self.actions.show_cameras(bool(visible.value), _within(size.value, (0.1, 4.0))))

    def _record(self, size: tuple[int, int]) -> None:
        gui = self.gui
        gui.add_markdown("**Screenshot** of what is shown, as PNG")
        height = gui.add_number("Height", 1080, min=SCREENSHOT_HEIGHTS[0], max=SCREENSHOT_HEIGHTS[1], step=1)
        shot = gui.add_button("Save screenshot", icon="photo", hint="The width follows the window")
        shot.on_click(lambda _: self.actions.take_screenshot(int(_within(height.value, SCREENSHOT_HEIGHTS))))
        gui.add_divider()
        gui.add_markdown("**Camera path** through views that you add, for `nexwarp render --path`")
        self.keyframes = gui.add_html("")
        gui.add_button("Add this view", icon="plus").on_click(lambda _: self.actions.add_keyframe())
        gui.add_button("Remove the last", icon="backspace", color="gray").on_click(
            lambda _: self.actions.remove_keyframe()
        )
        seconds = gui.add_number("Seconds", 6.0, min=0.1, max=600.0, step=0.1)
        fps = gui.add_number("Frames/s", 30, min=1, max=120, step=1)
        width = gui.add_number("Width", size[0], min=16, max=8192, step=2)
        rows = gui.add_number("Height ", size[1], min=16, max=8192, step=2)
        closed = gui.add_checkbox("Closed", False, hint="Return to the first view")
        self.play = gui.add_button("Play", icon="player-play", color="gray")
        self.play.on_click(lambda _: self.actions.play(_within(seconds.value, (0.1, 600.0)), bool(closed.value)))
        save = gui.add_button("Save path", icon="download")
        save.on_click(
            lambda _: self.actions.save_path(
                int(_within(width.value, (16, 8192))),
                int(_within(rows.value, (16, 8192))),
                int(_within(fps.value, (1, 120))),
                _within(seconds.value, (0.1, 600.0)),
                bool(closed.value),
            )
        )
        self.saved = gui.add_markdown("")
        self.count_keyframes(0)

    def count_keyframes(self, count: int) -> None:
        """Tell how many views the path has."""
        text = {0: "no views yet: add two or more", 1: "1 view; add another"}.get(count, f"{count} views")
        self.keyframes.content = _note(text)

    def show(self, picture: Picture | None, status: str | None) -> None:
        """Tell how to read a picture, and how it was made; only what has changed is sent."""
        settings = self.actions.settings
        text = f'<div style="padding:0 0.8em 0.2em;font-size:0.85em;opacity:0.8">{html.escape(MODES[settings.mode])}'
        if picture is not None and picture.span is not None:
            low, high = picture.span
            text += (
                f'<div style="height:0.6em;border-radius:0.2em;margin-top:0.4em;background:{_gradient()}"></div>'
                f'<div style="display:flex;justify-content:space-between">'
                f"<span>{low:.3g}</span><span>{high:.3g}</span></div>"
            )
        _set(self.legend, "content", text + "</div>")
        if status is not None:
            _set(self.status, "content", _note(status))
        _set(self.slot, "visible", settings.mode in BY_SLOT)

    def _change(self, **values: Any) -> None:
        try:
            self.actions.change(**values)
        except ValueError:  # nothing that the panel offers
            return
        for name in values:  # a value out of range comes back as what it was taken to
            _set(getattr(self, name), "value", getattr(self.actions.settings, name))
        self.show(None, None)

    @staticmethod
    def _on(handle: Any, act: Callable[[Any], None]) -> None:
        handle.on_update(lambda event: act(event.target.value))


def _gradient() -> str:
    """Viridis as a CSS gradient."""
    stops = (viridis()[::17] * 255).round().int().tolist()
    return "linear-gradient(to right," + ",".join(f"rgb({r},{g},{b})" for r, g, b in stops) + ")"


def _note(text: str) -> str:
    return f'<div style="padding:0 0.8em;font-size:0.85em;opacity:0.8">{html.escape(text)}</div>'


def _set(handle: Any, name: str, value: Any) -> None:
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _within(value: float, ends: tuple[float, float]) -> float:
    """Take a number to the nearest end of a range; what is no number, to the first."""
    return min(max(value, ends[0]), ends[1]) if math.isfinite(value) else ends[0]
