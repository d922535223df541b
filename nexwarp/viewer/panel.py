"""The control panels: one for each client, whose values are clamped to their ranges, and one of a training for all.

A panel has an editor of camera paths: views that a browser adds, to play and to keep for `nexwarp render --path`.
Events that are coroutines run on viser's event loop, one after another. Functions would wait for a thread of its pool,
in a queue without a limit.
"""

import asyncio
import html
import math
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import interpolate
from nexwarp.io.pictures import viridis
from nexwarp.kernels.types import MAX_HITS, MAX_SH_DEGREE
from nexwarp.viewer.modes import BY_SLOT, MODES, Picture
from nexwarp.viewer.world import Viewpoint, camera_to_world, vertical_fov

if TYPE_CHECKING:
    import viser

    from nexwarp.viewer.session import Session

T = TypeVar("T")
FPS, PLAY_FPS = 30, 20  # of a camera path, as it is kept and played
SECONDS = (0.1, 600.0)
MOST_VIEWS = 200  # of a path
FOV_DEGREES = (15.0, 110.0)
SCREENSHOT_HEIGHTS = (64, 2160)
TELL_SECONDS = 0.5  # between two updates of a training's status line
HELP = """\
**Drag** orbit · **right drag** pan · **scroll** zoom

**W A S D** fly · **Q E** down, up · **arrows** turn

**Click a frustum** to go to the camera of its photo"""
SMALL = "padding:0 0.8em 0.2em;font-size:0.85em;opacity:0.8"


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


class PathEditor:
    """A path through views of one client, and its controls."""

    def __init__(self, session: "Session", save: Callable[[Sequence[Camera]], str]) -> None:
        from viser import Icon

        self.session, self.save = session, save
        self.views: tuple[Camera, ...] = ()  # replaced, never changed: two threads read it
        self.playing = False
        gui = session.client.gui
        self.note = gui.add_markdown("**Camera path** through views that you add, for `nexwarp render --path`")
        on_click(gui.add_button("Add this view", icon=Icon.PLUS), self.add)
        on_click(gui.add_button("Remove the last", icon=Icon.BACKSPACE, color="gray"), self.remove)
        self.seconds = gui.add_number("Seconds", 6.0, min=SECONDS[0], max=SECONDS[1], step=0.1)
        on_click(gui.add_button("Play, stop", icon=Icon.PLAYER_PLAY, color="gray"), self.play)
        gui.add_button("Save path", icon=Icon.DEVICE_FLOPPY).on_click(lambda _: self.keep())  # on a thread: it writes

    def add(self) -> None:
        """Append the current view, with the size of the home view; video codecs need even sizes."""
        here, home = self.session.viewpoint, self.session.home
        if here is not None and len(self.views) < MOST_VIEWS:
            size = (max(home.width // 2 * 2, 2), max(home.height // 2 * 2, 2))
            (view,) = Viewpoint(here.pose, here.fov, *size).bands(1.0, 0.01, torch.zeros(0))
            self.views = (*self.views, view)
            self.note.content = f"{len(self.views)} of at most {MOST_VIEWS} views"

    def remove(self) -> None:
        """Remove the last view."""
        self.views = self.views[:-1]
        self.note.content = f"{len(self.views)} of at most {MOST_VIEWS} views"

    def path(self, fps: int) -> list[Camera]:
        """Return the path at some frames a second; ValueError without two different views."""
        return interpolate(self.views, max(round(within(self.seconds.value, SECONDS) * fps), 2), len(self.views) or 2)

    async def play(self) -> None:
        """Move along the path once; stop if that is in progress."""
        self.playing = not self.playing
        start = time.perf_counter()
        try:
            for number, camera in enumerate(self.path(PLAY_FPS) if self.playing else (), 1):
                self.session.go(camera_to_world(camera), vertical_fov(camera))
                await asyncio.sleep(max(start + number / PLAY_FPS - time.perf_counter(), 0.0))
                if self.session.closed.is_set() or not self.playing:
                    break
        except ValueError:
            self.note.content = "Add at least two different views first"
        self.playing = False

    def keep(self) -> None:
        """Write the path into the run, and show the command that renders it."""
        try:
            self.note.content = f"`{self.save(self.path(FPS))}`"
        except (OSError, ValueError) as error:
            self.note.content = f"The path was not saved: {error}"


class Panel:
    """The controls of one client."""

    def __init__(self, session: "Session") -> None:
        self.session, self.gui = session, session.client.gui
        tabs = self.gui.add_tab_group(order=10.0)
        with tabs.add_tab("Look"):
            self._look()
        with tabs.add_tab("Cameras"):
            self._cameras()
        with tabs.add_tab("Record"):
            self._record()
        self.gui.add_divider(order=15.0)
        self.gui.add_markdown(HELP, order=20.0)

    def _look(self) -> None:
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
        fov = within(round(float(np.rad2deg(self.session.home.fov))), FOV_DEGREES)
        self.fov = gui.add_slider("Field of view", *FOV_DEGREES, 1.0, fov, hint="Vertical")
        self.status = gui.add_html("")
        self._connect(mode, "mode")
        self._connect(self.slot, "slot")
        self._connect(self.max_hits, "max_hits")
        self._connect(sh_degree, "sh_degree")
        self._connect(as_trained, "as_trained")
        self._connect(exposure, "photo_exposure")
        on_change(self.fov, self._set_fov)
        self.show(None, None)

    def _set_fov(self, degrees: float) -> None:
        self.session.client.camera.fov = float(np.deg2rad(within(degrees, FOV_DEGREES)))

    def _connect(self, control: "viser.GuiInputHandle[T]", name: str) -> None:
        """Make a control change a setting, and show the clamped value."""

        def change(value: T) -> None:
            try:
                self.session.change(name, value)
            except ValueError:  # a value that the panel does not offer
                return
            set_changed(control, "value", getattr(self.session.settings, name))
            self.show(None, None)

        on_change(control, change)

    def _cameras(self) -> None:
        from viser import Icon

        gui, session = self.gui, self.session
        home = session.home
        on_click(gui.add_button("Back to the start", icon=Icon.HOME), lambda: session.go(home.pose, home.fov))
        if not session.cameras:
            gui.add_markdown("This run has no cameras.")
            return
        jump = gui.add_dropdown("Go to", tuple(session.cameras), hint="Go to the camera of a photo")
        on_change(jump, session.jump)
        on_click(gui.add_button("Go there", icon=Icon.CAMERA), lambda: session.jump(jump.value))
        visible = gui.add_checkbox("Show cameras", True, hint="Blue: training views. Orange: test views.")
        on_change(visible, session.show_cameras)

    def _record(self) -> None:
        from viser import Icon

        gui, session = self.gui, self.session
        gui.add_markdown("**Screenshot** of the current view, as PNG")
        height = gui.add_number("Height", 1080, min=SCREENSHOT_HEIGHTS[0], max=SCREENSHOT_HEIGHTS[1], step=1)
        shot = gui.add_button("Save screenshot", icon=Icon.PHOTO, hint="The width follows from the shape of the window")
        on_click(shot, lambda: session.take_screenshot(int(within(height.value, SCREENSHOT_HEIGHTS))))
        if session.viewer.save_path is not None:
            gui.add_divider()
            self.path = PathEditor(session, session.viewer.keep_path)

    def show(self, picture: Picture | None, status: str | None) -> None:
        """Show the legend of a picture, None before the first one, and a status line; None keeps the present one."""
        mode = self.session.settings.mode
        text = html.escape(MODES[mode])
        if picture is not None and picture.span is not None:
            low, high = picture.span
            stops = (viridis()[::17] * 255).round().int().tolist()
            gradient = ",".join(f"rgb({r},{g},{b})" for r, g, b in stops)
            text += (
                '<div style="height:0.6em;border-radius:0.2em;margin-top:0.4em;'
                f'background:linear-gradient(to right,{gradient})"></div>'
                f'<div style="display:flex;justify-content:space-between"><span>{low:.3g}</span>'
                f"<span>{high:.3g}</span></div>"
            )
        set_changed(self.legend, "content", f'<div style="{SMALL}">{text}</div>')
        if status is not None:
            set_changed(self.status, "content", f'<div style="{SMALL}">{html.escape(status)}</div>')
        set_changed(self.slot, "visible", mode in BY_SLOT)


class TrainingPanel:
    """The controls of a training: progress and pause."""

    def __init__(self, gui: "viser.GuiApi", total: int, wake: Callable[[], None]) -> None:
        """Add the controls of a training of `total` iterations; `wake` is called when it is paused or resumed."""
        from viser import Icon

        self.total, self.wake = total, wake
        self.paused = False  # held between two steps
        self._last: tuple[float, int] | None = None  # time and step of the last status line
        with gui.add_folder("Training", order=0.0):
            self.progress = gui.add_progress_bar(0.0)
            self.status = gui.add_markdown("starting")
            self.pause = gui.add_button("Pause", icon=Icon.PLAYER_PAUSE)
        on_click(self.pause, self.toggle_pause)

    def toggle_pause(self) -> None:
        """Pause the training, or resume it."""
        self.paused = not self.paused
        self.pause.label = "Resume" if self.paused else "Pause"
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
        self.pause.visible = False
