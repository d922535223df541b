"""One browser tab: its view, its settings, its camera path and the state of its picture."""

import asyncio
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from nexwarp.cameras.camera import Camera
from nexwarp.viewer.camera_path import Keyframe, interpolate, path_json
from nexwarp.viewer.modes import Settings
from nexwarp.viewer.panel import Panel, set_changed
from nexwarp.viewer.world import Viewpoint, World, camera_to_world, frustum_size, vertical_fov

if TYPE_CHECKING:
    import viser

COLOURS = {"train": (64, 130, 240), "test": (245, 150, 40)}
PATH_COLOUR = (230, 70, 120)
PLAY_FPS = 20
MOST_FRUSTUMS = 500
MOST_KEYFRAMES = 200
MOST_SCREENSHOTS = 4  # requested and not drawn yet
MOST_WAITING = 2000  # messages that a client has not taken yet, above which it gets no notifications


class Session:
    """The state of a client. viser's event loop calls its methods; another thread draws its pictures.

    Attributes:
        waiting: returns the number of messages that the client has not taken yet.
        save: writes a camera path into the run and returns the file's name; None only sends it to the browser.
        make_page: returns the scene as a web page; None offers none.
    """

    waiting: Callable[[], int]
    save: Callable[[bytes], str] | None
    make_page: Callable[[], bytes] | None

    def __init__(
        self,
        client: "viser.ClientHandle",
        world: World,
        cameras: Mapping[str, Camera],
        settings: Settings,
        home: Viewpoint,
        wake: Callable[[], None],
    ) -> None:
        """Take up a client, whose panel and frustums `start` adds; `wake` is called when a new picture is needed."""
        self.client, self.world, self.cameras, self.home = client, world, cameras, home
        self.settings, self.wake = settings, wake
        self.viewpoint: Viewpoint | None = None
        self.version = 0
        self.changed_at = time.perf_counter()
        self.drawn_version = self.drawn_step = -1
        self.drawn_scale = self.drawn_at = 0.0
        self.screenshots: list[int] = []
        self.has_download = False  # a file was sent and may not have arrived
        # Replaced, never changed: handlers of several threads read it, each once.
        self.keyframes: tuple[Keyframe, ...] = ()
        self.closed = threading.Event()
        self.playing = self.saving = False
        self.frustums: dict[str, viser.CameraFrustumHandle] = {}

    def start(
        self, waiting: Callable[[], int], save: Callable[[bytes], str] | None, make_page: Callable[[], bytes] | None
    ) -> None:
        """Add the panel and the frustums; the arguments become the attributes of their names."""
        self.waiting, self.save, self.make_page = waiting, save, make_page
        size = (self.home.width // 2 * 2, self.home.height // 2 * 2)  # video codecs need even sizes
        self.panel = Panel(self, list(self.cameras), float(np.rad2deg(self.home.fov)), size)
        self._add_frustums()
        self.client.camera.on_update(self.moved)
        self.look_from(self.client.camera)

    async def moved(self, camera: "viser.CameraHandle") -> None:
        """Take over the browser's camera."""
        self.look_from(camera)

    def look_from(self, camera: "viser.CameraHandle") -> None:
        """Take over a camera; an invalid one is ignored."""
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
        self.wake()

    # The view

    def look(self, degrees: float) -> None:
        """Set the vertical field of view."""
        self.client.camera.fov = float(np.deg2rad(degrees))

    def jump(self, name: str) -> None:
        """Go to a camera of the scene; an unknown name is ignored."""
        if name in self.cameras:
            camera = self.cameras[name]
            self.go(camera_to_world(camera), vertical_fov(camera))

    def reset(self) -> None:
        """Go to the initial view."""
        self.go(self.home.pose, self.home.fov)

    def go(self, pose: np.ndarray, fov: float) -> None:
        """Move to a (4, 4) camera-to-world pose in the scene's frame, and orbit a point in front of it; fov in rad."""
        position, forward = self.world.to_browser(pose[:3, 3]), pose[:3, 2]
        distance = max(float((self.world.to_browser(self.world.focus) - position) @ forward), 0.5)
        camera = self.client.camera
        with suppress(ValueError):  # the browser had sent an invalid camera
            with self.client.atomic():
                camera.position = position
                camera.wxyz = np.array(_wxyz(pose))
                camera.look_at = position + forward * distance
                camera.fov = fov
            set_changed(self.panel.fov, "value", float(round(float(np.rad2deg(fov)))))

    # Frustums

    def _add_frustums(self) -> None:
        names = list(self.cameras)
        chosen = names[:: -(-len(names) // MOST_FRUSTUMS) or 1]
        poses = np.array([camera_to_world(self.cameras[name]) for name in chosen]).reshape(-1, 4, 4)
        self.places = self.world.to_browser(poses[:, :3, 3])
        self.frustum_size, self.frustum_scale = frustum_size(self.places), 1.0
        self.shown = np.ones(len(chosen), dtype=bool)
        self.group = self.client.scene.add_frame("/cameras", show_axes=False)
        for name, pose, place in zip(chosen, poses, self.places, strict=True):
            camera = self.cameras[name]
            self.frustums[name] = self.client.scene.add_camera_frustum(
                f"/cameras/{name}",
                fov=vertical_fov(camera),
                aspect=camera.width / camera.height * camera.fy / camera.fx,
                scale=self.frustum_size,
                thickness=1.5,
                thickness_units="screen",
                color=COLOURS.get(name.partition("/")[0], (160, 160, 160)),
                wxyz=_wxyz(pose),
                position=place,
                format="jpeg",
                cast_shadow=False,
                receive_shadow=False,
            )
            self.frustums[name].on_click(partial(self._clicked, name))

    async def _clicked(self, name: str, _: object) -> None:
        self.jump(name)

    def show_thumbnail(self, name: str, pixels: np.ndarray) -> None:
        """Show an (h, w, 3) uint8 picture on the frustum of a camera."""
        if name in self.frustums:
            self.frustums[name].image = pixels

    def show_cameras(self, visible: bool, scale: float) -> None:
        """Show or hide the frustums, at `scale` times their first size."""
        self.group.visible = visible
        self.frustum_scale = scale
        for frustum in self.frustums.values():
            set_changed(frustum, "scale", self.frustum_size * scale)
        self._hide_near()

    def _hide_near(self) -> None:
        """Hide the frustums around the browser's camera, which would cover the view."""
        if self.viewpoint is None:
            return
        eye = self.world.to_browser(self.viewpoint.pose[:3, 3])
        far = np.linalg.norm(self.places - eye, axis=1) > 1.5 * self.frustum_size * self.frustum_scale
        frustums = list(self.frustums.values())
        for i in np.flatnonzero(far != self.shown):
            frustums[i].visible = bool(far[i])
        self.shown = far

    # Camera path

    def add_keyframe(self) -> None:
        """Append the current view to the path."""
        if len(self.keyframes) >= MOST_KEYFRAMES:
            self.tell(f"A path has at most {MOST_KEYFRAMES} views", "")
        elif self.viewpoint is not None:
            self.keyframes = (*self.keyframes, Keyframe(self.viewpoint.pose, self.viewpoint.fov))
            self._show_path()

    def remove_keyframe(self) -> None:
        """Remove the path's last keyframe."""
        if self.keyframes:
            self.keyframes = self.keyframes[:-1]
            self._show_path()

    def _show_path(self) -> None:
        keys, scene = self.keyframes, self.client.scene
        self.panel.count_keyframes(len(keys))
        scene.remove_by_name("/path")
        if not keys:
            return
        points = self._positions(keys)
        scene.add_point_cloud("/path/views", points, PATH_COLOUR, point_size=0.03, point_shape="circle")
        if len(keys) > 1:
            line = self._positions(interpolate(keys, 24 * len(keys)))
            way = np.stack([line[:-1], line[1:]], axis=1)
            scene.add_line_segments("/path/way", way, PATH_COLOUR, thickness=2.0, thickness_units="screen")

    def _positions(self, keys: Sequence[Keyframe]) -> np.ndarray:
        return self.world.to_browser(np.stack([key.pose[:3, 3] for key in keys])).astype(np.float32)

    async def play(self, seconds: float, closed: bool) -> None:
        """Move along the path once, back to the first view if `closed`; stop if that is in progress."""
        if self.playing:
            self.playing = False
            return
        try:
            way = interpolate(self.keyframes, max(round(seconds * PLAY_FPS), 2), closed)
        except ValueError:
            self.tell("Add at least two views first", "")
            return
        self.playing = True
        self.panel.play.label = "Stop"
        self.client.scene.remove_by_name("/path")  # the line would cover the view
        start = time.perf_counter()
        for i, key in enumerate(way):
            self.go(key.pose, key.fov)
            await asyncio.sleep(max(start + (i + 1) / PLAY_FPS - time.perf_counter(), 0.0))
            if self.closed.is_set() or not self.playing:
                break
        self.playing = False
        self.panel.play.label = "Play"
        self._show_path()

    # Files; a request is ignored while another file is made or on its way.

    def take_screenshot(self, height: int) -> None:
        """Request a picture of this height in pixels, unless `MOST_SCREENSHOTS` are requested already."""
        if len(self.screenshots) < MOST_SCREENSHOTS:
            self.screenshots.append(height)
            self.wake()

    def save_path(self, width: int, height: int, fps: float, seconds: float, closed: bool) -> None:
        """Send the path to the browser as a file, and write it into the run; the arguments are those of `path_json`."""
        keys = self.keyframes
        if len(keys) < 2:
            self.tell("Add at least two views first", "")
            return
        where = None

        def make() -> bytes:
            nonlocal where
            content = path_json(keys, width, height, fps, seconds, closed)
            where = self.save(content) if self.save is not None else None
            return content

        if self._send("camera_path.json", make, "The path was not saved"):
            self.panel.saved.content = f"`{where or 'nexwarp render RUN --path camera_path.json'}`"

    def save_page(self) -> None:
        """Send the scene as a web page."""
        if self.make_page is None or self._is_busy():
            return
        self.tell("The web page is being made", "The download starts when it is ready.")
        self._send("scene.html", self.make_page, "There is no web page")

    def _is_busy(self) -> bool:
        return self.saving or (self.has_download and bool(self.waiting()))

    def _send(self, name: str, make: Callable[[], bytes], failure: str) -> bool:
        """Make a file and send it to the browser; False, and a notification of an error, if it is not sent."""
        if self._is_busy():
            return False
        self.saving = True
        try:
            content = make()
        except (OSError, ValueError, MemoryError) as error:
            self.tell(failure, str(error))
            return False
        finally:
            self.saving = False
        self.has_download = True
        self.client.send_file_download(name, content, save_immediately=True)
        return True

    def tell(self, title: str, text: str) -> None:
        """Show a notification in the browser, unless it takes no messages."""
        if self.waiting() <= MOST_WAITING:
            self.client.add_notification(title, text, auto_close_seconds=10.0)


def _wxyz(pose: np.ndarray) -> tuple[float, float, float, float]:
    """Return the rotation of a (4, 4) pose as a quaternion."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return w, x, y, z
