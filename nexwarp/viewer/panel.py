"""The control panel of one client; values out of range are clamped."""

import html
import math
from collections.abc import Awaitable, Callable, Sequence
from typing import TYPE_CHECKING, Protocol, TypeVar, cast

from nexwarp.kernels.types import MAX_HITS, MAX_SH_DEGREE
from nexwarp.viewer.modes import BY_SLOT, MODES, Picture, Settings, viridis

if TYPE_CHECKING:
    import viser

FOV_DEGREES = (15.0, 110.0)
SCREENSHOT_HEIGHTS = (64, 2160)
HELP = """\
**Drag** orbit · **right drag** pan · **scroll** zoom

**W A S D** fly · **Q E** down, up · **arrows** turn

**Click a frustum** to go to the camera of its photo"""

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class Control(Protocol[T_co]):
    """A control of viser with a value."""

    @property
    def value(self) -> T_co:
        """The present value."""


class _Settable(Protocol[T]):
    value: T


class Actions(Protocol):
    """The session's actions that a panel calls."""

    settings: Settings
    make_page: Callable[[], bytes] | None

    def change(self, **values: object) -> None:
        """Change display settings; ValueError for an invalid value."""

    def look(self, degrees: float) -> None:
        """Set the vertical field of view."""

    def jump(self, name: str) -> None:
        """Go to a camera of the scene."""

    def reset(self) -> None:
        """Go to the initial view."""

    def show_cameras(self, visible: bool, size: float) -> None:
        """Show or hide the frustums."""

    def take_screenshot(self, height: int) -> None:
        """Render the current view at a height in pixels and send it as a PNG file."""

    def add_keyframe(self) -> None:
        """Append the current view to the path."""

    def remove_keyframe(self) -> None:
        """Remove the path's last keyframe."""

    async def play(self, seconds: float, closed: bool) -> None:
        """Start or stop moving along the path."""

    def save_path(self, width: int, height: int, fps: float, seconds: float, closed: bool) -> None:
        """Save the path as a file."""

    def save_page(self) -> None:
        """Send the scene as a web page."""


class Panel:
    """The controls of one client."""

    def __init__(
        self, gui: "viser.GuiApi", actions: Actions, cameras: Sequence[str], fov: float, size: tuple[int, int]
    ) -> None:
        """Add the controls.

        Args:
            gui: the client's GUI.
            actions: called by the controls.
            cameras: names of the scene's cameras.
            fov: initial vertical field of view, degrees.
            size: initial width and height of path videos, pixels.
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
            "Hit", 1, MAX_HITS, 1, settings.slot, hint="Rank of the hit that is shown; 1 has the largest weight"
        )
        self.max_hits = gui.add_slider(
            "K", 0, MAX_HITS, 1, settings.max_hits, hint="Number of hits per pixel that use the neural texture"
        )
        self.sh_degree = gui.add_slider(
            "SH degree",
            0,
            MAX_SH_DEGREE,
            1,
            settings.sh_degree,
            hint="Degree of the spherical harmonics; 0: no dependence on direction",
        )
        self.as_trained = gui.add_checkbox(
            "Photo detail",
            settings.as_trained,
            hint="Leave out texture detail that is finer than the resolution of the photos",
        )
        self.photo_exposure = gui.add_checkbox(
            "Photo exposure",
            settings.photo_exposure,
            hint="On: brightness and white balance of the nearby photos. Off: the mean of all photos",
        )
        self.fov = gui.add_slider("Field of view", *FOV_DEGREES, 1.0, _within(round(fov), FOV_DEGREES), hint="Vertical")
        self.status = gui.add_html("")
        self._controls: dict[str, Control[object]] = {
            "mode": self.mode,
            "slot": self.slot,
            "max_hits": self.max_hits,
            "sh_degree": self.sh_degree,
            "as_trained": self.as_trained,
            "photo_exposure": self.photo_exposure,
        }
        self._on(self.mode, lambda value: self._change("mode", value))
        self._on(self.slot, lambda value: self._change("slot", value))
        self._on(self.max_hits, lambda value: self._change("max_hits", value))
        self._on(self.sh_degree, lambda value: self._change("sh_degree", value))
        self._on(self.as_trained, lambda value: self._change("as_trained", value))
        self._on(self.photo_exposure, lambda value: self._change("photo_exposure", value))
        self._on(self.fov, lambda value: self.actions.look(_within(value, FOV_DEGREES)))
        self.show(None, None)

    def _cameras(self, names: Sequence[str]) -> None:
        from viser import Icon

        gui = self.gui
        reset = gui.add_button("Back to the start", icon=Icon.HOME)
        self._on_click(reset, self.actions.reset)
        if not names:
            gui.add_markdown("This run has no cameras.")
            return
        jump = gui.add_dropdown("Go to", tuple(names), hint="Go to the camera of a photo")
        self._on(jump, self.actions.jump)
        again = gui.add_button("Go there", icon=Icon.CAMERA)
        self._on_click(again, lambda: self.actions.jump(jump.value))
        visible = gui.add_checkbox("Show cameras", True, hint="Blue: training views. Orange: test views.")
        size = gui.add_slider("Size", 0.1, 4.0, 0.1, 1.0, hint="Of the frustums")

        def show_cameras(_: object) -> None:
            self.actions.show_cameras(bool(visible.value), _within(size.value, (0.1, 4.0)))

        self._on(visible, show_cameras)
        self._on(size, show_cameras)

    def _record(self, size: tuple[int, int]) -> None:
        from viser import Icon

        gui = self.gui
        gui.add_markdown("**Screenshot** of the current view, as PNG")
        height = gui.add_number("Height", 1080, min=SCREENSHOT_HEIGHTS[0], max=SCREENSHOT_HEIGHTS[1], step=1)
        shot = gui.add_button("Save screenshot", icon=Icon.PHOTO, hint="The width follows from the shape of the window")
        self._on_click(shot, lambda: self.actions.take_screenshot(int(_within(height.value, SCREENSHOT_HEIGHTS))))
        gui.add_divider()
        gui.add_markdown("**Camera path** through views that you add, for `nexwarp render --path`")
        self.keyframes = gui.add_html("")
        self._on_click(gui.add_button("Add this view", icon=Icon.PLUS), self.actions.add_keyframe)
        remove = gui.add_button("Remove the last", icon=Icon.BACKSPACE, color="gray")
        self._on_click(remove, self.actions.remove_keyframe)
        seconds = gui.add_number("Seconds", 6.0, min=0.1, max=600.0, step=0.1)
        fps = gui.add_number("Frames/s", 30, min=1, max=120, step=1)
        width = gui.add_number("Width", size[0], min=16, max=8192, step=2)
        rows = gui.add_number("Height ", size[1], min=16, max=8192, step=2)
        closed = gui.add_checkbox("Closed", False, hint="Return to the first view")
        self.play = gui.add_button("Play", icon=Icon.PLAYER_PLAY, color="gray")
        self._on_click(self.play, lambda: self.actions.play(_within(seconds.value, (0.1, 600.0)), bool(closed.value)))
        save = gui.add_button("Save path", icon=Icon.DOWNLOAD)
        save.on_click(  # on a thread of viser's pool: it writes a file
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
        if self.actions.make_page is not None:
            gui.add_divider()
            gui.add_markdown("**Web page** of the scene: one file that any browser opens")
            page = gui.add_button("Download as web page", icon=Icon.WORLD_DOWNLOAD, hint="Takes minutes on a CPU")
            page.on_click(lambda _: self.actions.save_page())  # on a thread of viser's pool

    def count_keyframes(self, count: int) -> None:
        """Show the number of views of the path."""
        text = {0: "no views yet: add two or more", 1: "1 view; add another"}.get(count, f"{count} views")
        self.keyframes.content = _note(text)

    def show(self, picture: Picture | None, status: str | None) -> None:
        """Show the legend of a picture and a status line; only changed controls are sent.

        Args:
            picture: the picture that is shown; None before the first one.
            status: the status line; None keeps the present one.
        """
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

    def _change(self, name: str, value: object) -> None:
        try:
            self.actions.change(**{name: value})
        except ValueError:  # a value that the panel does not offer
            return
        # The control shows the clamped value.
        _set(self._controls[name], "value", getattr(self.actions.settings, name))
        self.show(None, None)

    # Coroutines run on viser's event loop, one after another. Functions would wait for a thread of its pool, in a queue
    # without a limit.

    @staticmethod
    def _on(control: "viser.GuiInputHandle[T]", act: Callable[[T], None]) -> None:
        async def updated(event: "viser.GuiEvent[viser.GuiInputHandle[T]]") -> None:
            act(event.target.value)

        control.on_update(updated)

    @staticmethod
    def _on_click(button: "viser.GuiButtonHandle", act: Callable[[], Awaitable[None] | None]) -> None:
        async def clicked(_: object) -> None:
            done = act()
            if done is not None:
                await done

        button.on_click(clicked)


def set_value(control: Control[T], value: T) -> None:
    """Set the value of a control; mypy takes the property of viser's stubs for read-only."""
    cast(_Settable[T], control).value = value


def _gradient() -> str:
    """Viridis as a CSS gradient."""
    stops = (viridis()[::17] * 255).round().int().tolist()
    return "linear-gradient(to right," + ",".join(f"rgb({r},{g},{b})" for r, g, b in stops) + ")"


def _note(text: str) -> str:
    return f'<div style="padding:0 0.8em;font-size:0.85em;opacity:0.8">{html.escape(text)}</div>'


def _set(handle: object, name: str, value: object) -> None:
    """Set a property of a control if that changes it."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _within(value: float, ends: tuple[float, float]) -> float:
    """Clamp a number to a range; NaN and infinity become its lower end."""
    return min(max(value, ends[0]), ends[1]) if math.isfinite(value) else ends[0]
