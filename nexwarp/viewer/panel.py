"""The control panels: one for each client, whose values are clamped to their ranges, and one of a training for all."""

import html
import math
from collections.abc import Awaitable, Callable, Sequence
from typing import TYPE_CHECKING, TypeVar

from nexwarp.kernels.types import MAX_HITS, MAX_SH_DEGREE
from nexwarp.viewer.modes import BY_SLOT, MODES, Picture, viridis
from nexwarp.viewer.pacing import Share

if TYPE_CHECKING:
    import viser

    from nexwarp.viewer.session import Session

FOV_DEGREES = (15.0, 110.0)
SCREENSHOT_HEIGHTS = (64, 2160)
FRUSTUM_SIZES = (0.1, 4.0)
SECONDS, FRAME_RATES, SIDES = (0.1, 600.0), (1, 120), (16, 8192)  # of a path's video
SHARES = (5, 80)  # percent
TELL_SECONDS = 0.5  # between two updates of a training's status line
HELP = """\
**Drag** orbit · **right drag** pan · **scroll** zoom

**W A S D** fly · **Q E** down, up · **arrows** turn

**Click a frustum** to go to the camera of its photo"""

T = TypeVar("T")


class Panel:
    """The controls of one client."""

    def __init__(self, session: "Session", cameras: Sequence[str], fov: float, size: tuple[int, int]) -> None:
        """Add the controls, with an initial field of view in degrees and size of path videos in pixels."""
        self.session, self.gui = session, session.client.gui
        tabs = self.gui.add_tab_group(order=10.0)
        with tabs.add_tab("Look"):
            self._look(fov)
        with tabs.add_tab("Cameras"):
            self._cameras(cameras)
        with tabs.add_tab("Record"):
            self._record(size)
        self.gui.add_divider(order=15.0)
        self.gui.add_markdown(HELP, order=20.0)

    def _look(self, fov: float) -> None:
        gui, settings = self.gui, self.session.settings
        mode = gui.add_dropdown("Show", tuple(MODES), initial_value=settings.mode)
        self.legend = gui.add_html("")
        hint = "Rank of the hit that is shown; 1 has the largest weight"
        self.slot = gui.add_slider("Hit", 1, MAX_HITS, 1, settings.slot, hint=hint)
        hint = "Number of hits per pixel that use the neural texture"
        self.max_hits = gui.add_slider("K", 0, MAX_HITS, 1, settings.max_hits, hint=hint)
        hint = "Degree of the spherical harmonics; 0: no dependence on direction"
        sh_degree = gui.add_slider("SH degree", 0, MAX_SH_DEGREE, 1, settings.sh_degree, hint=hint)
        hint = "Leave out texture detail that is finer than the resolution of the photos"
        as_trained = gui.add_checkbox("Photo detail", settings.as_trained, hint=hint)
        hint = "On: brightness and white balance of the nearby photos. Off: the mean of all photos"
        exposure = gui.add_checkbox("Photo exposure", settings.photo_exposure, hint=hint)
        self.fov = gui.add_slider("Field of view", *FOV_DEGREES, 1.0, _within(round(fov), FOV_DEGREES), hint="Vertical")
        self.status = gui.add_html("")
        self._connect(mode, "mode")
        self._connect(self.slot, "slot")
        self._connect(self.max_hits, "max_hits")
        self._connect(sh_degree, "sh_degree")
        self._connect(as_trained, "as_trained")
        self._connect(exposure, "photo_exposure")
        _on(self.fov, lambda value: self.session.look(_within(value, FOV_DEGREES)))
        self.show(None, None)

    def _connect(self, control: "viser.GuiInputHandle[T]", name: str) -> None:
        """Make a control change a setting, and show the clamped value."""

        def change(value: T) -> None:
            try:
                self.session.change(name, value)
            except ValueError:  # a value that the panel does not offer
                return
            set_changed(control, "value", getattr(self.session.settings, name))
            self.show(None, None)

        _on(control, change)

    def _cameras(self, names: Sequence[str]) -> None:
        from viser import Icon

        gui = self.gui
        _on_click(gui.add_button("Back to the start", icon=Icon.HOME), self.session.reset)
        if not names:
            gui.add_markdown("This run has no cameras.")
            return
        jump = gui.add_dropdown("Go to", tuple(names), hint="Go to the camera of a photo")
        _on(jump, self.session.jump)
        _on_click(gui.add_button("Go there", icon=Icon.CAMERA), lambda: self.session.jump(jump.value))
        visible = gui.add_checkbox("Show cameras", True, hint="Blue: training views. Orange: test views.")
        size = gui.add_slider("Size", *FRUSTUM_SIZES, 0.1, 1.0, hint="Of the frustums")

        def show_cameras(_: object) -> None:
            self.session.show_cameras(bool(visible.value), _within(size.value, FRUSTUM_SIZES))

        _on(visible, show_cameras)
        _on(size, show_cameras)

    def _record(self, size: tuple[int, int]) -> None:
        from viser import Icon

        gui, session = self.gui, self.session
        gui.add_markdown("**Screenshot** of the current view, as PNG")
        height = gui.add_number("Height", 1080, min=SCREENSHOT_HEIGHTS[0], max=SCREENSHOT_HEIGHTS[1], step=1)
        shot = gui.add_button("Save screenshot", icon=Icon.PHOTO, hint="The width follows from the shape of the window")
        _on_click(shot, lambda: session.take_screenshot(int(_within(height.value, SCREENSHOT_HEIGHTS))))
        gui.add_divider()
        gui.add_markdown("**Camera path** through views that you add, for `nexwarp render --path`")
        self.keyframes = gui.add_html("")
        _on_click(gui.add_button("Add this view", icon=Icon.PLUS), session.add_keyframe)
        _on_click(gui.add_button("Remove the last", icon=Icon.BACKSPACE, color="gray"), session.remove_keyframe)
        seconds = gui.add_number("Seconds", 6.0, min=SECONDS[0], max=SECONDS[1], step=0.1)
        fps = gui.add_number("Frames/s", 30, min=FRAME_RATES[0], max=FRAME_RATES[1], step=1)
        width = gui.add_number("Width", size[0], min=SIDES[0], max=SIDES[1], step=2)
        rows = gui.add_number("Height ", size[1], min=SIDES[0], max=SIDES[1], step=2)
        closed = gui.add_checkbox("Closed", False, hint="Return to the first view")
        self.play = gui.add_button("Play", icon=Icon.PLAYER_PLAY, color="gray")
        _on_click(self.play, lambda: session.play(_within(seconds.value, SECONDS), bool(closed.value)))
        save = gui.add_button("Save path", icon=Icon.DOWNLOAD)
        save.on_click(  # on a thread of viser's pool: it writes a file
            lambda _: session.save_path(
                int(_within(width.value, SIDES)),
                int(_within(rows.value, SIDES)),
                int(_within(fps.value, FRAME_RATES)),
                _within(seconds.value, SECONDS),
                bool(closed.value),
            )
        )
        self.saved = gui.add_markdown("")
        self.count_keyframes(0)
        if session.make_page is not None:
            gui.add_divider()
            gui.add_markdown("**Web page** of the scene: one file that any browser opens")
            page = gui.add_button("Download as web page", icon=Icon.WORLD_DOWNLOAD, hint="Takes minutes on a CPU")
            page.on_click(lambda _: session.save_page())  # on a thread of viser's pool

    def count_keyframes(self, count: int) -> None:
        """Show the number of views of the path."""
        text = {0: "no views yet: add two or more", 1: "1 view; add another"}.get(count, f"{count} views")
        self.keyframes.content = _note(text)

    def show(self, picture: Picture | None, status: str | None) -> None:
        """Show the legend of a picture, None before the first one, and a status line; None keeps the present one."""
        mode = self.session.settings.mode
        text = f'<div style="padding:0 0.8em 0.2em;font-size:0.85em;opacity:0.8">{html.escape(MODES[mode])}'
        if picture is not None and picture.span is not None:
            low, high = picture.span
            text += (
                f'<div style="height:0.6em;border-radius:0.2em;margin-top:0.4em;background:{_gradient()}"></div>'
                f'<div style="display:flex;justify-content:space-between">'
                f"<span>{low:.3g}</span><span>{high:.3g}</span></div>"
            )
        set_changed(self.legend, "content", text + "</div>")
        if status is not None:
            set_changed(self.status, "content", _note(status))
        set_changed(self.slot, "visible", mode in BY_SLOT)


class TrainingPanel:
    """The controls of a training: progress, pause, and the share of time for pictures."""

    def __init__(self, gui: "viser.GuiApi", total: int, share: Share, wake: Callable[[], None]) -> None:
        """Add the controls of a training of `total` iterations; `wake` is called when it is paused or resumed."""
        from viser import Icon

        self.total, self.share, self.wake = total, share, wake
        self.paused = False  # held between two steps
        self._last: tuple[float, int] | None = None  # time and step of the last status line
        with gui.add_folder("Training", order=0.0):
            self.progress = gui.add_progress_bar(0.0)
            self.status = gui.add_markdown("starting")
            self.pause = gui.add_button("Pause", icon=Icon.PLAYER_PAUSE)
            hint = "Percent of the training's time, while a browser is connected"
            percent = round(100 * share.share)
            self.share_slider = gui.add_slider("Time for pictures", *SHARES, 5, percent, hint=hint)
        _on_click(self.pause, self.toggle_pause)
        _on(self.share_slider, self._set_share)

    def _set_share(self, percent: float) -> None:
        self.share.share = _within(percent, SHARES) / 100.0

    def toggle_pause(self) -> None:
        """Pause the training, or resume it."""
        from viser import Icon

        self.paused = not self.paused
        self.pause.label = "Resume" if self.paused else "Pause"
        self.pause.icon = Icon.PLAYER_PLAY if self.paused else Icon.PLAYER_PAUSE
        self.wake()

    def tell(self, step: int, describe: Callable[[], str], now: float, force: bool = False) -> None:
        """Show the step and the line of `describe`, unless that was done within `TELL_SECONDS` before `now`."""
        if not force and self._last is not None and now - self._last[0] < TELL_SECONDS:
            return
        how = "paused" if self.paused else "training"
        if self._last is not None and not self.paused and now > self._last[0]:
            how = f"{(step - self._last[1]) / (now - self._last[0]):.1f} it/s"
        set_changed(self.progress, "value", 100.0 * step / max(self.total, 1))
        self.status.content = f"**{step:,}** of {self.total:,} · {how}  \n{describe()}"
        self._last = (now, step)

    def finish(self, text: str) -> None:
        """Resume a paused training, show a status line, and hide the controls."""
        self.paused = False
        self.status.content = text
        set_changed(self.progress, "value", 100.0)
        for handle in (self.pause, self.share_slider):
            handle.visible = False


# Coroutines run on viser's event loop, one after another. Functions would wait for a thread of its pool, in a queue
# without a limit.


def _on(control: "viser.GuiInputHandle[T]", act: Callable[[T], None]) -> None:
    async def updated(event: "viser.GuiEvent[viser.GuiInputHandle[T]]") -> None:
        act(event.target.value)

    control.on_update(updated)


def _on_click(button: "viser.GuiButtonHandle", act: Callable[[], Awaitable[None] | None]) -> None:
    async def clicked(_: object) -> None:
        done = act()
        if done is not None:
            await done

    button.on_click(clicked)


def set_changed(handle: object, name: str, value: object) -> None:
    """Set a property of a control if that changes it."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _gradient() -> str:
    """Viridis as a CSS gradient."""
    stops = (viridis()[::17] * 255).round().int().tolist()
    return "linear-gradient(to right," + ",".join(f"rgb({r},{g},{b})" for r, g, b in stops) + ")"


def _note(text: str) -> str:
    return f'<div style="padding:0 0.8em;font-size:0.85em;opacity:0.8">{html.escape(text)}</div>'


def _within(value: float, ends: tuple[float, float]) -> float:
    """Clamp a number to a range; NaN and infinity become its lower end."""
    return min(max(value, ends[0]), ends[1]) if math.isfinite(value) else ends[0]
