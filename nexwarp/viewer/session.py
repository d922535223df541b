"""One browser tab: its view, its settings, its camera path and the state of its picture."""

import asyncio
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from nexwarp.cameras.camera import Camera
from nexwarp.viewer.camera_path import Keyframe, interpolate, path_json
from nexwarp.viewer.modes import Settings
from nexwarp.viewer.panel import Panel, set_value
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
    """The state of a client. viser's event loop calls its methods; another thread draws its pictures."""

    def __init__(
        self,
        client: "viser.ClientHandle",
        world: World,
        cameras: Mapping[str, Camera],
        settings: Settings,
        home: Viewpoint,
        wake: Callable[[], None],
        waiting: Callable[[], int],
        save: Callable[[bytes], str] | None,
        make_page: Callable[[], bytes] | None,
    ) -> None:
        """Add the panel and the frustums of a client.

        Args:
            client: the connected client.
            world: the browser's frame.
            cameras: the scene's cameras by name, "train/..." or "test/...".
            settings: initial display settings.
            home: initial view.
            wake: called when a new picture is needed.
            waiting: returns the number of messages that the client has not taken yet.
            save: writes a camera path into the run and returns the file's name; None only sends it to the browser.
            make_page: returns the scene as a web page; None offers none.
        """
        self.client, self.world, self.cameras, self.home = client, world, cameras, home
        self.settings, self.wake, self.waiting, self.save = settings, wake, waiting, save
        self.make_page = make_page
        self.viewpoint: Viewpoint | None = None
        self.version = 0
        self.changed_at = time.perf_counter()
        self.drawn_version, self.drawn_step, self.drawn_scale, self.drawn_at = -1, -1, 0.0, 0.0
        self.screenshots: list[int] = []
        self.has_download = False  # a file was sent and may not have arrived
        # Replaced, never changed: handlers of several threads read it, each once.
        self.keyframes: tuple[Keyframe, ...] = ()
        self.closed = threading.Event()
        self.playing = self.saving = False
        self.frustums: dict[str, viser.CameraFrustumHandle] = {}
        self.frustum_shape = (True, 1.0)
        size = (home.width // 2 * 2, home.height // 2 * 2)  # video codecs need even sizes
        self.panel = Panel(client.gui, self, list(cameras), float(np.rad2deg(home.fov)), size)
        self._add_frustums()
        client.camera.on_update(self.moved)
        self.look_from(client.camera)

    # Messages of the browser

    async def moved(self, camera: "viser.CameraHandle") -> None:
        """Take over the browser's camera."""
        self.look_from(camera)

    def look_from(self, camera: "viser.CameraHandle") -> None:
        """Take over a camera; an invalid one is ignored."""
        try:
            here = Viewpoint.of(
                camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height, self.world
            )
        except (TypeError, ValueError):
            return
        self.viewpoint = here
        self._changed()
        self._hide_near()

    def change(self, **values: object) -> None:
        """Change display settings; ValueError for an invalid value."""
        settings = self.settings.changed(**values)
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
        """Move to a (4, 4) camera-to-world pose in the scene's frame, and orbit a point in front of it.

        Args:
            pose: (4, 4) float64, x right, y down, z forward.
            fov: vertical field of view, radians.
        """
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        position, forward = self.world.to_browser(pose[:3, 3]), pose[:3, 2]
        distance = max(float((self.world.to_browser(self.world.focus) - position) @ forward), 0.5)
        camera = self.client.camera
        try:
            with self.client.atomic():
                camera.position = position
                camera.wxyz = np.array([w, x, y, z])
                camera.look_at = position + forward * distance
                camera.fov = fov
        except ValueError:  # the browser had sent an invalid camera
            return
        set_value(self.panel.fov, float(round(float(np.rad2deg(fov)))))

    # Frustums

    def _add_frustums(self) -> None:
        names = list(self.cameras)
        chosen = names[:: -(-len(names) // MOST_FRUSTUMS) or 1]
        poses = np.array([camera_to_world(self.cameras[name]) for name in chosen]).reshape(-1, 4, 4)
        self.places = self.world.to_browser(poses[:, :3, 3])
        self.frustum_size = frustum_size(self.places)
        self.shown = np.ones(len(chosen), dtype=bool)
        self.group = self.client.scene.add_frame("/cameras", show_axes=False)
        for name, pose, place in zip(chosen, poses, self.places, strict=True):
            camera = self.cameras[name]
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
            frustum = self.client.scene.add_camera_frustum(
                f"/cameras/{name}",
                fov=vertical_fov(camera),
                aspect=camera.width / camera.height * camera.fy / camera.fx,
                scale=self.frustum_size,
                thickness=1.5,
                thickness_units="screen",
                color=COLOURS.get(name.partition("/")[0], (160, 160, 160)),
                wxyz=(w, x, y, z),
                position=place,
                format="jpeg",
                cast_shadow=False,
                receive_shadow=False,
            )
            frustum.on_click(partial(self._clicked, name))
            self.frustums[name] = frustum

    async def _clicked(self, name: str, _: object) -> None:
        self.jump(name)

    def show_thumbnail(self, name: str, pixels: np.ndarray) -> None:
        """Show an (h, w, 3) uint8 picture on the frustum of a camera."""
        if name in self.frustums:
            self.frustums[name].image = pixels

    def show_cameras(self, visible: bool, size: float) -> None:
        """Show or hide the frustums; `size` is relative to their first one."""
        self.group.visible = visible
        if size != self.frustum_shape[1]:
            for frustum in self.frustums.values():
                frustum.scale = self.frustum_size * size
        self.frustum_shape = (visible, size)
        self._hide_near()

    def _hide_near(self) -> None:
        """Hide the frustums around the browser's camera, which would cover the view."""
        if self.viewpoint is None:
            return
        eye = self.world.to_browser(self.viewpoint.pose[:3, 3])
        reach = 1.5 * self.frustum_size * self.frustum_shape[1]
        far = np.linalg.norm(self.places - eye, axis=1) > reach
        frustums = list(self.frustums.values())
        for i in np.flatnonzero(far != self.shown):
            frustums[i].visible = bool(far[i])
        self.shown = far

    # Screenshot and path

    def take_screenshot(self, height: int) -> None:
        """Request a picture of this height in pixels, unless `MOST_SCREENSHOTS` are requested already."""
        if len(self.screenshots) < MOST_SCREENSHOTS:
            self.screenshots.append(height)
            self.wake()

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
        keys = self.keyframes
        self.panel.count_keyframes(len(keys))
        self.client.scene.remove_by_name("/path")
        if not keys:
            return
        points = [key.pose[:3, 3] for key in keys]
        self.client.scene.add_point_cloud(
            "/path/views",
            points=self.world.to_browser(np.stack(points)).astype(np.float32),
            colors=PATH_COLOUR,
            point_size=0.03,
            point_shape="circle",
        )
        if len(keys) > 1:
            way = interpolate(keys, 24 * len(keys))
            line = self.world.to_browser(np.stack([key.pose[:3, 3] for key in way])).astype(np.float32)
            self.client.scene.add_line_segments(
                "/path/way",
                points=np.stack([line[:-1], line[1:]], axis=1),
                colors=PATH_COLOUR,
                thickness=2.0,
                thickness_units="screen",
            )

    async def play(self, seconds: float, closed: bool) -> None:
        """Move along the path once; if that is in progress, stop it.

        Args:
            seconds: duration.
            closed: return to the first view.
        """
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

    def save_path(self, width: int, height: int, fps: float, seconds: float, closed: bool) -> None:
        """Send the path to the browser as a file, and write it into the run.

        A request is ignored while the client has not received its previous file.

        Args:
            width: width of the frames, pixels.
            height: height of the frames, pixels.
            fps: frames a second.
            seconds: duration of the video.
            closed: return to the first view.
        """
        keys = self.keyframes
        if len(keys) < 2:
            self.tell("Add at least two views first", "")
            return
        if self.saving or (self.has_download and self.waiting()):
            return
        self.saving = True
        try:
            content = path_json(keys, width, height, fps, seconds, closed)
            where = self.save(content) if self.save is not None else None
        except (OSError, ValueError, MemoryError) as error:
            self.tell("The path was not saved", str(error))
            return
        finally:
            self.saving = False
        self.has_download = True
        self.client.send_file_download("camera_path.json", content, save_immediately=True)
        self.panel.saved.content = f"`{where or 'nexwarp render RUN --path camera_path.json'}`"

    def save_page(self) -> None:
        """Send the scene as a web page; ignored while another file is made or on its way."""
        if self.make_page is None or self.saving or (self.has_download and self.waiting()):
            return
        self.saving = True
        self.tell("The web page is being made", "The download starts when it is ready.")
        try:
            content = self.make_page()
        except (OSError, ValueError, MemoryError) as error:
            self.tell("There is no web page", str(error))
            return
        finally:
            self.saving = False
        self.has_download = True
        self.client.send_file_download("scene.html", content, save_immediately=True)

    def tell(self, title: str, text: str) -> None:
        """Show a notification in the browser, unless it takes no messages."""
        if self.waiting() > MOST_WAITING:
            return
        self.client.add_notification(title, text, auto_close_seconds=10.0)
