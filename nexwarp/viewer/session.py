"""One browser tab: its view, its settings, its frustums and the state of its picture."""

import threading
import time
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from nexwarp.viewer.modes import Settings
from nexwarp.viewer.panel import Panel, set_changed
from nexwarp.viewer.world import Viewpoint, camera_to_world, frustum_size, vertical_fov

if TYPE_CHECKING:
    import viser

    from nexwarp.viewer.viewer import Viewer

COLOURS = {"train": (64, 130, 240), "test": (245, 150, 40)}
MOST_FRUSTUMS = 500


class Session:
    """The state of a client. viser's event loop calls its methods; another thread draws its pictures."""

    def __init__(self, viewer: "Viewer", client: "viser.ClientHandle", settings: Settings) -> None:
        self.viewer, self.client, self.settings = viewer, client, settings
        self.world, self.cameras, self.home = viewer.world, viewer.cameras, viewer.home
        self.viewpoint: Viewpoint | None = None
        self.version = 0
        self.changed_at = time.perf_counter()
        self.drawn_version = self.drawn_step = -1
        self.drawn_scale = self.drawn_at = 0.0
        self.screenshot: int | None = None  # height of the one that is requested and not drawn yet, pixels
        self.closed = threading.Event()
        self.panel = Panel(self)
        self._add_frustums()
        client.camera.on_update(self._moved)
        self._take_over(client.camera)

    def waiting(self) -> int:
        """Number of messages that the client has not taken yet."""
        return self.viewer.web.waiting(self.client.client_id)

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
            camera = self.cameras[name]
            self.go(camera_to_world(camera), vertical_fov(camera))

    def go(self, pose: np.ndarray, fov: float) -> None:
        """Move to a (4, 4) camera-to-world pose in the scene's frame, and orbit a point in front of it; fov in rad."""
        position, forward = self.world.to_browser(pose[:3, 3]), pose[:3, 2]
        distance = max(float((self.world.to_browser(self.world.focus) - position) @ forward), 0.5)
        camera = self.client.camera
        with suppress(TypeError, ValueError):  # the browser had sent an invalid camera
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
        self.frustum_size = frustum_size(self.places)
        self.shown = np.ones(len(chosen), dtype=bool)
        self.group = self.client.scene.add_frame("/cameras", show_axes=False)
        self.frustums: dict[str, viser.CameraFrustumHandle] = {}
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
                image=self.viewer.thumbnails.get(name),
                wxyz=_wxyz(pose),
                position=place,
                format="jpeg",
                cast_shadow=False,
                receive_shadow=False,
            )
            self.frustums[name].on_click(partial(self._clicked, name))

    async def _clicked(self, name: str, _: object) -> None:
        self.jump(name)

    def show_cameras(self, visible: bool) -> None:
        """Show or hide the frustums."""
        self.group.visible = bool(visible)

    def _hide_near(self) -> None:
        """Hide the frustums around the browser's camera, which would cover the view."""
        if self.viewpoint is None:
            return
        eye = self.world.to_browser(self.viewpoint.pose[:3, 3])
        far = np.linalg.norm(self.places - eye, axis=1) > 1.5 * self.frustum_size
        frustums = list(self.frustums.values())
        for i in np.flatnonzero(far != self.shown):
            frustums[i].visible = bool(far[i])
        self.shown = far

    def take_screenshot(self, height: int) -> None:
        """Request a picture of this height in pixels, in place of one that is not drawn yet."""
        self.screenshot = height
        self.viewer.wake()


def _wxyz(pose: np.ndarray) -> tuple[float, float, float, float]:
    """Return the rotation of a (4, 4) pose as a quaternion."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return w, x, y, z
