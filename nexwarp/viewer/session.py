"""One browser tab: its view, its settings, its controls, its frustums and the state of its picture.

The panel of each tab has values that are clamped to their ranges, and an editor of camera paths: views that a browser
adds, to play and to keep for `nexwarp render --path`. Another one, of a training, is for all. Events that are
coroutines run on viser's event loop, one after another. Functions would wait for a thread of its pool, in a queue
without a limit. What needs a rendering, such as a measured point, waits for the thread that draws.
"""

import asyncio
import html
import math
import shlex
import statistics
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import through
from nexwarp.io.pictures import viridis
from nexwarp.viewer.modes import BY_SLOT, MODES, RANGES, Picture, Settings
from nexwarp.viewer.world import Viewpoint, camera_to_world, frustum_size, vertical_fov

if TYPE_CHECKING:
    import viser

    from nexwarp.viewer.viewer import Viewer

T = TypeVar("T")
COLOURS = {"train": (64, 130, 240), "test": (245, 150, 40)}
MOST_FRUSTUMS = 500
MOST_LISTED = 500  # photos, the worst ones
FPS, PLAY_FPS = 30, 20  # of a camera path, as it is kept and played
SECONDS = (0.1, 600.0)
MOST_VIEWS = 200  # of a path
FOV_DEGREES = (15.0, 110.0)
CROP_RADII, CROP_REACH = (0.05, 10.0), 100.0  # of a sphere, and of its centre's coordinates; browser units
LENGTHS = (1e-3, 1e6)  # known, between measured points
MARK = 0.008  # radius of a measured point, in distances from the camera
SCREENSHOT_HEIGHTS = (64, 2160)
TELL_SECONDS = 0.5  # between two updates of a training's status line
# Settings with a control, its label and hint; `Settings` has the values of a checkbox, `RANGES` those of a slider.
CONTROLS = (
    ("slot", "Hit", "Rank of the hit that is shown; 1 has the largest weight"),
    ("max_hits", "K", "Number of hits per pixel that use the neural texture"),
    ("sh_degree", "SH degree", "Degree of the spherical harmonics; 0: no dependence on direction"),
    ("as_trained", "Photo detail", "Leave out texture detail that is finer than the resolution of the photos"),
    ("photo_exposure", "Photo exposure", "On: brightness and white balance of the nearby photos. Off: their mean"),
)
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


def add_button(
    gui: "viser.GuiApi", label: str, icon: str, act: Callable[[], Awaitable[None] | None], **options: Any
) -> "viser.GuiButtonHandle":
    """Add a button with an icon, by its name at Tabler; `act` is called, or awaited, at each click."""
    from viser import IconName

    async def clicked(_: object) -> None:
        done = act()
        if done is not None:
            await done

    button = gui.add_button(label, icon=IconName(icon), **options)
    button.on_click(clicked)
    return button


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
        self.session, self.save = session, save
        self.views: tuple[Camera, ...] = ()  # replaced, never changed: two threads read it
        self.playing = False
        gui = session.client.gui
        self.note = gui.add_markdown("**Camera path** through views that you add, for `nexwarp render --path`")
        add_button(gui, "Add this view", "plus", self.add)
        add_button(gui, "Remove the last", "backspace", lambda: self._set_views(self.views[:-1]), color="gray")
        self.seconds = gui.add_number("Seconds", 6.0, min=SECONDS[0], max=SECONDS[1], step=0.1)
        add_button(gui, "Play, stop", "player-play", self.play, color="gray")
        add_button(gui, "Save path", "device-floppy", lambda: asyncio.to_thread(self.keep))  # it writes

    def add(self) -> None:
        """Append the current view, with the size of the home view; video codecs need even sizes."""
        here, home = self.session.viewpoint, self.session.home
        if here is not None and len(self.views) < MOST_VIEWS:
            size = (max(home.width // 2 * 2, 2), max(home.height // 2 * 2, 2))
            (view,) = Viewpoint(here.pose, here.fov, *size).bands(1.0, 0.01, torch.zeros(0))
            self._set_views((*self.views, view))

    def _set_views(self, views: tuple[Camera, ...]) -> None:
        self.views = views
        self.note.content = f"{len(self.views)} of at most {MOST_VIEWS} views"

    def path(self, fps: int) -> list[Camera]:
        """Return the path at some frames a second; ValueError without two different views."""
        return through(self.views, max(round(within(self.seconds.value, SECONDS) * fps), 2))

    async def play(self) -> None:
        """Move along the path once; stop if that is in progress."""
        self.playing = not self.playing
        start = time.perf_counter()
        try:
            for number, camera in enumerate(self.path(PLAY_FPS) if self.playing else (), 1):
                self.session.go(Viewpoint.of_camera(camera))
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


class CropEditor:
    """A sphere that one client sees, and the command that crops by it."""

    def __init__(self, session: "Session", command: Callable[[np.ndarray, float], str]) -> None:
        self.world, self.command = session.world, command
        gui = session.client.gui
        self.shown = gui.add_checkbox("Show sphere", False, hint="What lies inside stays")
        self.radius = gui.add_slider("Radius", *CROP_RADII, 0.01, 1.0)
        self.centre = gui.add_vector3("Centre", _triple(self.world.to_browser(self.world.focus)), step=0.01)
        self.note = gui.add_markdown("")
        self.ball = session.client.scene.add_icosphere(
            "/crop", 1.0, COLOURS["test"], wireframe=True, cast_shadow=False, receive_shadow=False, visible=False
        )
        controls: tuple[viser.GuiInputHandle[Any], ...] = (self.shown, self.radius, self.centre)
        for control in controls:
            on_change(control, lambda _: self.update())
        self.update()

    def update(self) -> None:
        """Draw the sphere of the controls, and show its command."""
        radius = within(float(self.radius.value), CROP_RADII)
        centre = np.array([within(float(x), (-CROP_REACH, CROP_REACH)) for x in self.centre.value])
        self.ball.scale, self.ball.position, self.ball.visible = radius, _triple(centre), bool(self.shown.value)
        self.note.content = f"`{self.command(self.world.to_scene(centre), radius * self.world.unit)}`"


class MeasureEditor:
    """Two points of the scene that one client clicks, and what the run says of them."""

    def __init__(self, session: "Session", describe: Callable[[np.ndarray, float], list[str]]) -> None:
        self.session, self.describe = session, describe
        self.clicks: deque[tuple[Viewpoint, tuple[float, float]]] = deque(maxlen=2)  # not looked up yet
        self.points = np.zeros((0, 3))  # in the scene's frame
        gui, scene = session.client.gui, session.client.scene
        self.active = gui.add_checkbox("Measure", False, hint="Clicks choose points, and no cameras")
        self.length = gui.add_number("Known length", 1.0, min=LENGTHS[0], max=LENGTHS[1], step=0.001)
        self.note = gui.add_markdown("")
        colour, ends = COLOURS["test"], ("/first", "/second")
        self.balls = [scene.add_icosphere(end, 1.0, colour, cast_shadow=False, receive_shadow=False) for end in ends]
        self.line = scene.add_line_segments(
            "/between", np.zeros((1, 2, 3)), colour, thickness=2.0, thickness_units="screen"
        )
        on_change(self.active, self.toggle)
        on_change(self.length, lambda _: self.update())
        self.update()

    def toggle(self, active: bool) -> None:
        """Begin to listen to clicks on the picture, or end it and forget the points."""
        self.session.client.scene.remove_click_callback(self.clicked)
        if active:
            self.session.client.scene.on_click()(self.clicked)  # type: ignore[arg-type]  # a coroutine
        self.clicks = deque(maxlen=2)  # another thread may read the old one
        self.points = self.points[:0]
        self.update()

    async def clicked(self, event: "viser.SceneClickEvent") -> None:
        """Let the thread that draws look up the point of a click, at (x, y) from 0 to 1; others are ignored."""
        view = self.session.viewpoint
        with suppress(TypeError, ValueError):
            x, y = (within(at, (0.0, 1.0)) for at in event.screen_pos)
            if view is not None:
                self.clicks.append((view, (x, y)))
                self.session.viewer.wake()

    def add(self, view: Viewpoint, point: np.ndarray | None) -> None:
        """Take up the point (3,) of a click in a view, None where nothing is; the third one begins anew."""
        if not self.active.value:
            return
        if point is None:
            self.note.content = "No surface is there: click again"
            return
        number = len(self.points) % 2
        self.points = np.concatenate([self.points[:number], point[None]])
        self.balls[number].position = _triple(self.session.world.to_browser(point))
        self.balls[number].scale = MARK * float(np.linalg.norm(point - view.pose[:3, 3])) / self.session.world.unit
        self.update()

    def update(self) -> None:
        """Mark the points, and show what the run says of them."""
        points = self.points
        if len(points) == 2:
            self.line.points = self.session.world.to_browser(points)[None].astype(np.float32)
        self.balls[0].visible, self.balls[1].visible = len(points) > 0, len(points) == 2
        self.line.visible = len(points) == 2
        lines = self.describe(points, within(float(self.length.value), LENGTHS)) if len(points) else []
        self.note.content = "  \n".join(lines) or "Click two points of the picture"


class TrainingPanel:
    """The controls of a training: progress and pause."""

    def __init__(self, gui: "viser.GuiApi", total: int, wake: Callable[[], None]) -> None:
        """Add the controls of a training of `total` iterations; `wake` is called when it is paused or resumed."""
        self.total, self.wake = total, wake
        self.paused = False  # held between two steps
        self._last: tuple[float, int] | None = None  # time and step of the last status line
        with gui.add_folder("Training", order=0.0):
            self.progress = gui.add_progress_bar(0.0)
            self.status = gui.add_markdown("starting")
            self.pause = add_button(gui, "Pause", "player-pause", self.toggle_pause)

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


class Session:
    """The state of a client. viser's event loop calls its methods; another thread draws its pictures."""

    def __init__(self, viewer: "Viewer", client: "viser.ClientHandle") -> None:
        self.viewer, self.client, self.options = viewer, client, viewer.options
        self.settings = Settings(max_hits=viewer.model().options.max_hits)
        self.world, self.cameras, self.home = viewer.world, viewer.cameras, viewer.home
        self.viewpoint: Viewpoint | None = None
        self.version = 0
        self.changed_at = time.perf_counter()
        self.drawn_version = self.drawn_step = -1
        self.drawn_scale = self.drawn_at = 0.0
        self.screenshot: int | None = None  # height of the one that is requested and not drawn yet, pixels
        self.measure: MeasureEditor | None = None
        self.closed = threading.Event()
        self.controls: dict[str, viser.GuiInputHandle[Any]] = {}  # by the name of the setting
        gui = client.gui
        tabs = gui.add_tab_group(order=10.0)
        for label, add in (("Look", self._look), ("Cameras", self._cameras), ("Record", self._record)):
            with tabs.add_tab(label):
                add()
        if self.options.crop_command is not None or self.options.measured is not None:
            with tabs.add_tab("Edit"):
                self._edit()
        gui.add_divider(order=15.0)
        gui.add_markdown(HELP, order=20.0)
        self._add_frustums()
        client.camera.on_update(self._moved)
        self._take_over(client.camera)

    def waiting(self) -> int:
        """Number of messages that the client has not taken yet; 0 if it has left."""
        server, client = self.viewer.server._websock_server, self.client.client_id
        state, connection = server._client_state_from_id.get(client), server._live_connections.get(client)
        if state is None or connection is None:
            return 0
        return len(state.message_buffer.message_from_id) + (connection.transport.get_write_buffer_size() > 0)

    async def _moved(self, camera: "viser.CameraHandle") -> None:
        self._take_over(camera)

    def _take_over(self, camera: "viser.CameraHandle") -> None:
        """Take over the browser's camera; an invalid one is ignored."""
        size = (camera.image_width, camera.image_height)
        with suppress(TypeError, ValueError):
            self.viewpoint = Viewpoint.of(camera.wxyz, camera.position, camera.fov, *size, self.world)
            self._changed()
            self._hide_near()

    def change(self, name: str, value: object) -> None:
        """Change a display setting; ValueError for an invalid value."""
        settings = self.settings.changed(name, value)
        if settings != self.settings:
            self.settings = settings
            self._changed()

    def _changed(self) -> None:
        self.version += 1
        self.changed_at = time.perf_counter()
        self.viewer.wake()

    # The view

    def jump(self, name: str) -> None:
        """Go to a camera of the scene; an unknown name is ignored."""
        if name in self.cameras:
            self.go(Viewpoint.of_camera(self.cameras[name]))

    def go(self, view: Viewpoint) -> None:
        """Move to a view, and orbit a point in front of it."""
        position, forward = self.world.to_browser(view.pose[:3, 3]), view.pose[:3, 2]
        distance = max(float((self.world.to_browser(self.world.focus) - position) @ forward), 0.5)
        camera = self.client.camera
        with suppress(TypeError, ValueError):  # the browser had sent an invalid camera
            with self.client.atomic():
                camera.position = position
                camera.wxyz = np.array(_wxyz(view.pose))
                camera.look_at = position + forward * distance
                camera.fov = view.fov
            set_changed(self.fov, "value", float(round(float(np.rad2deg(view.fov)))))

    # Frustums

    def _add_frustums(self) -> None:
        chosen = list(self.cameras)[:: -(-len(self.cameras) // MOST_FRUSTUMS) or 1]
        poses = np.array([camera_to_world(self.cameras[name]) for name in chosen]).reshape(-1, 4, 4)
        self.places = self.world.to_browser(poses[:, :3, 3])
        self.frustum_size = frustum_size(self.places)
        self.shown = np.ones(len(chosen), dtype=bool)
        self.group = self.client.scene.add_frame("/cameras", show_axes=False)
        self.frustums: list[viser.CameraFrustumHandle] = []
        for name, pose, place in zip(chosen, poses, self.places, strict=True):
            camera = self.cameras[name]
            frustum = self.client.scene.add_camera_frustum(
                f"/cameras/{name}",
                fov=vertical_fov(camera),
                aspect=camera.width / camera.height * camera.fy / camera.fx,
                scale=self.frustum_size,
                thickness=1.5,
                thickness_units="screen",
                color=COLOURS.get(name.partition("/")[0], (160, 160, 160)),
                wxyz=_wxyz(pose),
                position=place,
                cast_shadow=False,
                receive_shadow=False,
            )
            frustum.on_click(partial(self._clicked, name))
            self.frustums.append(frustum)

    async def _clicked(self, name: str, _: object) -> None:
        if self.measure is None or not self.measure.active.value:
            self.jump(name)

    def _hide_near(self) -> None:
        """Hide the frustums around the browser's camera, which would cover the view."""
        assert self.viewpoint is not None
        eye = self.world.to_browser(self.viewpoint.pose[:3, 3])
        far = np.linalg.norm(self.places - eye, axis=1) > 1.5 * self.frustum_size
        for i in np.flatnonzero(far != self.shown):
            self.frustums[i].visible = bool(far[i])
        self.shown = far

    # The controls

    def _look(self) -> None:
        gui, settings = self.client.gui, self.settings
        mode = gui.add_dropdown("Show", tuple(MODES), initial_value=settings.mode)
        self._connect(mode, "mode")
        self.legend = gui.add_html("")
        for name, label, hint in CONTROLS:
            value = getattr(settings, name)
            if name in RANGES:
                low, high = RANGES[name]
                self.controls[name] = gui.add_slider(label, low, high, 1, value, hint=hint)
            else:
                self.controls[name] = gui.add_checkbox(label, value, hint=hint)
            self._connect(self.controls[name], name)
        fov = within(round(float(np.rad2deg(self.home.fov))), FOV_DEGREES)
        self.fov = gui.add_slider("Field of view", *FOV_DEGREES, 1.0, fov, hint="Vertical")
        on_change(self.fov, self._set_fov)
        self.status = gui.add_html("")
        self.show(None, None)

    def _set_fov(self, degrees: float) -> None:
        self.client.camera.fov = float(np.deg2rad(within(degrees, FOV_DEGREES)))

    def _connect(self, control: "viser.GuiInputHandle[T]", name: str) -> None:
        """Make a control change a setting, and show the clamped value."""

        def change(value: T) -> None:
            try:
                self.change(name, value)
            except ValueError:  # a value that the panel does not offer
                return
            set_changed(control, "value", getattr(self.settings, name))
            self.show(None, None)

        on_change(control, change)

    def _cameras(self) -> None:
        gui = self.client.gui
        add_button(gui, "Back to the start", "home", lambda: self.go(self.home))
        if not self.cameras:
            gui.add_markdown("This run has no cameras.")
            return
        jump = gui.add_dropdown("Go to", tuple(self.cameras), hint="Go to the camera of a photo")
        on_change(jump, self.jump)
        add_button(gui, "Go there", "camera", lambda: self.jump(jump.value))
        visible = gui.add_checkbox("Show cameras", True, hint="Blue: training views. Orange: test views.")
        on_change(visible, lambda shown: set_changed(self.group, "visible", bool(shown)))
        if self.options.figures:
            with gui.add_folder("Photos"):
                self._photos(self.options.figures)

    def _photos(self, figures: Mapping[str, tuple[float, float]]) -> None:
        """Add the list of the worst photos: a choice goes to the camera, and shows how to leave the photo out."""
        gui = self.client.gui
        names = {f"{figures[name][0]:.2f} dB {name}": name for name in list(figures)[:MOST_LISTED]}
        typical = [statistics.median(column) for column in zip(*figures.values(), strict=True)]
        chosen = gui.add_dropdown("Worst first", tuple(names), hint="PSNR of each photo")
        note = gui.add_html("")

        def show(label: str) -> None:
            name = names[label]
            psnr, sharp = figures[name]
            option = html.escape(f"--exclude {shlex.quote(name.partition('/')[2])}")
            text = f"PSNR {psnr:.2f} dB, sharpness {sharp:.3g}; medians {typical[0]:.2f} dB, {typical[1]:.3g}"
            note.content = f'<div style="{SMALL}">{text}<br><code>{option}</code></div>'

        def go(label: str) -> None:
            if label in names:  # else it is none that the panel offers
                show(label)
                self.jump(names[label])

        show(chosen.value)
        on_change(chosen, go)
        add_button(gui, "Go to the photo", "camera", lambda: go(chosen.value))

    def _record(self) -> None:
        gui = self.client.gui
        gui.add_markdown("**Screenshot** of the current view, as PNG")
        height = gui.add_number("Height", 1080, min=SCREENSHOT_HEIGHTS[0], max=SCREENSHOT_HEIGHTS[1], step=1)
        hint = "The width follows from the shape of the window"
        add_button(gui, "Save screenshot", "photo", lambda: self._take_screenshot(height.value), hint=hint)
        if self.options.save_path is not None:
            gui.add_divider()
            self.path = PathEditor(self, self.options.save_path)

    def _edit(self) -> None:
        if self.options.measured is not None:
            self.measure = MeasureEditor(self, self.options.measured)
            self.client.gui.add_divider()
        if self.options.crop_command is not None:
            self.crop = CropEditor(self, self.options.crop_command)

    def _take_screenshot(self, height: float) -> None:
        """Request a picture of this height in pixels, in place of one that is not drawn yet."""
        self.screenshot = int(within(height, SCREENSHOT_HEIGHTS))
        self.viewer.wake()

    def show(self, picture: Picture | None, status: str | None) -> None:
        """Show the legend of a picture, None before the first one, and a status line; None keeps the present one."""
        mode = self.settings.mode
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
        set_changed(self.controls["slot"], "visible", mode in BY_SLOT)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _wxyz(pose: np.ndarray) -> tuple[float, float, float, float]:
    """Return the rotation of a (4, 4) pose as a quaternion."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return w, x, y, z
