"""The viewer: draws pictures for all connected browsers, on its own or between the steps of a training."""

import contextlib
import io
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch

from nexwarp.camera import Camera
from nexwarp.kernels.types import MAX_HITS
from nexwarp.model.model import Model
from nexwarp.viewer import pacing
from nexwarp.viewer.modes import TEXTURED, Picture, Settings, draw
from nexwarp.viewer.panel import set_value
from nexwarp.viewer.server import start_server
from nexwarp.viewer.session import Session
from nexwarp.viewer.world import Viewpoint, World, camera_to_world, vertical_fov

if TYPE_CHECKING:
    import viser

THUMBNAIL = 96  # pixels along the longer side
SHARE = 0.2  # of a training's time for pictures, at the start
TELL_SECONDS = 0.5  # between two updates of the status line
DEFAULT_FOV = 0.9  # radians


class Viewer:
    """A web page that shows a model. Pictures are drawn on the thread that calls `show` or `between_steps`."""

    def __init__(
        self,
        model: Callable[[], Model],
        cameras: Mapping[str, Mapping[str, Camera]],
        *,
        near: float,
        title: str = "nexwarp",
        host: str = "127.0.0.1",
        port: int = 8080,
        photos: Mapping[str, Callable[[], torch.Tensor]] | None = None,
        total: int | None = None,
        save_path: Callable[[bytes], str] | None = None,
    ) -> None:
        """Start the server.

        Args:
            model: returns the current model; called for each picture.
            cameras: the scene's cameras by set ("train", "test") and name; may be empty.
            near: near depth of the viewer's cameras, world units.
            title: text above the panel.
            host: interface to listen on.
            port: port to listen on; 0 is any free port.
            photos: "set/name" -> function that returns the (H, W, 3) uint8 photo, for thumbnails; None renders the
                thumbnails.
            total: number of iterations of the training that is shown; None for a finished model.
            save_path: writes a camera path, JSON in UTF-8, into the run and returns the file's name.

        Raises:
            ValueError: the package viser is missing, or the address cannot be used.
        """
        self.model, self.near, self.title, self.total = model, near, title, total
        self.cameras = {f"{group}/{name}": camera for group, views in cameras.items() for name, camera in views.items()}
        self.photos, self.save_path = photos, save_path
        self.world = World.around(list(self.cameras.values()), model().surfels.means)
        self.home = self._home()
        self.focal_limit = max((camera.focal for camera in self.cameras.values()), default=math.inf)
        self.pace, self.share = pacing.Pace(), pacing.Share(SHARE)
        self.sessions: dict[int, Session] = {}
        self.thumbnails: dict[str, np.ndarray] = {}
        self.step = 0
        self.paused = False
        self._told: tuple[float, int] | None = None
        self._news = threading.Event()
        self._lock = threading.Lock()
        self.server = start_server(host, port)
        self.url = f"http://{'127.0.0.1' if host in ('0.0.0.0', '::') else host}:{self.server.get_port()}"
        self._set_scene()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect all browsers and stop the server."""
        for session in list(self.sessions.values()):
            session.closed.set()
        with contextlib.redirect_stdout(io.StringIO()):  # drops its message
            self.server.stop()

    def show(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Draw pictures for the connected browsers until `stop()` returns True or Ctrl-C."""
        if not self.pace.seconds_per_pixel:  # compiles the kernels before a browser connects
            for _ in range(2):
                self._picture(self.home, pacing.SMALLEST / min(self.home.width, self.home.height), self._settings())
        while not stop():
            self._draw_or_wait()

    def between_steps(self, step: int, describe: Callable[[], str], stop: Callable[[], bool] = lambda: False) -> None:
        """Draw pictures between two steps of a training; call it after each step.

        It costs nothing without connected browsers. While the training is paused, it returns only when the training is
        resumed or `stop()` returns True.

        Args:
            step: number of finished iterations.
            describe: returns a status line; called from time to time while a browser is connected.
            stop: ends a pause.
        """
        self.step = step
        if not self.sessions and not self.paused:
            return
        now = time.perf_counter()
        if self.share.due(now):
            self._tell(step, describe, now)
            if self._draw_next(pacing.TRAINING_SECONDS):
                end = time.perf_counter()
                self.share.spend(end, min(end - now, pacing.LONGEST_WAIT))
        if self.paused:
            self._tell(step, describe, now, force=True)
            while self.paused and not stop():
                self._draw_or_wait()

    def finish(self, text: str, model: Callable[[], Model]) -> None:
        """End the training's display and show another model from now on.

        Args:
            text: status line, such as a summary of the training.
            model: returns the current model, as in the constructor.
        """
        self.model = model
        for session in list(self.sessions.values()):
            session.drawn_version = -1  # its picture shows the previous model
        self._news.set()
        self.paused = False
        self.status.content = text
        set_value(self.progress, 100.0)
        for handle in (self.pause, self.share_slider):
            handle.visible = False

    # Drawing

    def _draw_or_wait(self) -> None:
        self._news.clear()
        if not self._draw_next(None) and not self._draw_thumbnail():
            self._news.wait(0.05 if self.sessions else 0.5)

    def _draw_next(self, longest: float | None) -> bool:
        """Draw one picture, for the client that has waited longest; False if none is due. `longest` is in seconds."""
        for session in sorted(list(self.sessions.values()), key=lambda s: s.drawn_at):
            try:
                if session.screenshots:
                    self._screenshot(session, session.screenshots.pop(0))
                    return True
                scale = self._due(session, longest, time.perf_counter())
                if scale:
                    self._draw(session, scale)
                    return True
            except (MemoryError, RuntimeError, ValueError) as error:  # the other clients continue
                session.drawn_version, session.drawn_scale, session.drawn_step = session.version, 1.0, self.step
                session.tell("This picture could not be drawn", " ".join(str(error).split())[:300])
        return False

    def _due(self, session: Session, longest: float | None, now: float) -> float:
        """Scale of the next picture of a client; 0 if none is due."""
        here = session.viewpoint
        if here is None:
            return 0.0
        kind, size = _kind(session.settings), (here.width, here.height)
        finest = min(1.0, math.sqrt(pacing.MOST_PIXELS / (here.width * here.height)))
        if longest is not None:
            finest = min(finest, self.pace.scale(kind, *size, longest))
        if session.version != session.drawn_version:
            return min(self.pace.scale(kind, *size, pacing.MOVING_SECONDS), finest)
        still = now - session.changed_at
        if longest is not None:
            return finest if session.drawn_step != self.step and still > pacing.STILL_AFTER else 0.0
        if session.drawn_scale >= finest and session.drawn_step == self.step:
            return 0.0
        return min(2.0 * session.drawn_scale, finest) if still > pacing.STILL_AFTER else 0.0

    def _draw(self, session: Session, scale: float) -> None:
        # Read before drawing: a later change makes the picture stale.
        version, settings, here = session.version, session.settings, session.viewpoint
        assert here is not None  # `_due` returns 0 without a viewpoint
        session.drawn_at = time.perf_counter()
        start = time.perf_counter()
        picture = self._picture(here, scale, settings, lambda: session.version != version or session.closed.is_set())
        seconds = time.perf_counter() - start
        if picture is None:
            return
        height, width = picture.pixels.shape[:2]
        quality = 90 if scale >= 1.0 else 75
        session.client.scene.set_background_image(picture.pixels, format="jpeg", jpeg_quality=quality)
        session.drawn_version, session.drawn_scale, session.drawn_step = version, scale, self.step
        text = f"{width} x {height}, {1e3 * seconds:.0f} ms"
        session.panel.show(picture, text if scale >= 1.0 else f"{text} (window: {here.width} x {here.height})")

    def _picture(
        self, here: Viewpoint, scale: float, settings: Settings, stale: Callable[[], bool] = lambda: False
    ) -> Picture | None:
        """Draw a picture; None if it became stale and was cancelled."""
        model = self.model()
        kind, pixels = _kind(settings), here.width * here.height * scale**2
        limit = self.focal_limit if settings.as_trained else math.inf
        bands = here.bands(scale, self.near, model.surfels.means, self.pace.bands(kind, pixels), limit)
        if model.device.type == "cuda":
            torch.cuda.synchronize(model.device)  # excludes the queued work of the training from the measured time
        start = time.perf_counter()
        picture = draw(model, bands, settings, stale)
        if picture is not None:
            self.pace.observe(kind, picture.pixels.size // 3, time.perf_counter() - start)
        return picture

    def _screenshot(self, session: Session, height: int) -> None:
        from PIL import Image

        here, settings = session.viewpoint, session.settings
        if here is None:
            return
        picture = self._picture(here, height / here.height, settings)
        assert picture is not None  # never stale
        file = io.BytesIO()
        Image.fromarray(picture.pixels).save(file, format="PNG")
        name = f"{self.title}_{settings.mode}.png".replace(" ", "_")
        session.client.send_file_download(name, file.getvalue(), save_immediately=True)

    def _draw_thumbnail(self) -> bool:
        """Draw one thumbnail if a browser is connected; False if there is none left to draw."""
        if self.photos is not None or not self.sessions:
            return False
        name = next((name for name in self.cameras if name not in self.thumbnails), None)
        if name is None:
            return False
        camera = self.cameras[name]
        here = Viewpoint(camera_to_world(camera), vertical_fov(camera), camera.width, camera.height)
        model = self.model()
        small = here.bands(min(THUMBNAIL / max(camera.width, camera.height), 1.0), self.near, model.surfels.means)
        picture = draw(model, small, Settings(max_hits=model.options.max_hits))
        assert picture is not None
        with self._lock:
            self.thumbnails[name] = picture.pixels
            for session in self.sessions.values():
                session.show_thumbnail(name, picture.pixels)
        return True

    # The page

    def _home(self) -> Viewpoint:
        """The initial view: the first camera, or a view of the surfels' middle if there are no cameras."""
        first = next(iter(self.cameras.values()), None)
        if first is not None:
            return Viewpoint(camera_to_world(first), vertical_fov(first), first.width, first.height)
        pose = np.eye(4)
        pose[:3, 3] = self.world.focus - np.array([0.0, 0.0, 3.0 * self.world.unit])
        return Viewpoint(pose, DEFAULT_FOV, 1280, 720)

    def _set_scene(self) -> None:
        server, start, position = self.server, self.server.initial_camera, self.home.pose[:3, 3]
        server.scene.set_up_direction(self.world.up)
        forward = self.home.pose[:3, 2]
        distance = max(float((self.world.focus - position) @ forward), 0.1 * self.world.unit)
        start.position = self.world.to_browser(position)
        start.look_at = self.world.to_browser(position + forward * distance)
        start.fov = self.home.fov
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        server.gui.set_panel_label(f"nexwarp · {self.title}")
        if self.total is not None:
            self._add_training()
        server.on_client_disconnect(self._goodbye)
        server.on_client_connect(self._welcome)

    def _add_training(self) -> None:
        from viser import Icon

        gui = self.server.gui
        with gui.add_folder("Training", order=0.0):
            self.progress = gui.add_progress_bar(0.0)
            self.status = gui.add_markdown("starting")
            self.pause = gui.add_button("Pause", icon=Icon.PLAYER_PAUSE)
            self.share_slider = gui.add_slider(
                "Time for pictures",
                5,
                80,
                5,
                int(100 * SHARE),
                hint="Percent of the training's time, while a browser is connected",
            )
        self.pause.on_click(lambda _: self._toggle_pause())
        self.share_slider.on_update(lambda event: self.share.set(float(event.target.value)))

    def _toggle_pause(self) -> None:
        from viser import Icon

        self.paused = not self.paused
        self.pause.label = "Resume" if self.paused else "Pause"
        self.pause.icon = Icon.PLAYER_PLAY if self.paused else Icon.PLAYER_PAUSE
        self._news.set()

    def _tell(self, step: int, describe: Callable[[], str], now: float, force: bool = False) -> None:
        if not force and self._told is not None and now - self._told[0] < TELL_SECONDS:
            return
        how = "paused" if self.paused else "training"
        if self._told is not None and not self.paused and now > self._told[0]:
            how = f"{(step - self._told[1]) / (now - self._told[0]):.1f} it/s"
        set_value(self.progress, 100.0 * step / max(self.total or 1, 1))
        self.status.content = f"**{step:,}** of {self.total:,} · {how}  \n{describe()}"
        self._told = (now, step)

    def _welcome(self, client: "viser.ClientHandle") -> None:
        if self.photos is not None and not self.thumbnails:
            self.thumbnails = {name: _thumbnail(photo()) for name, photo in self.photos.items()}
        session = Session(client, self.world, self.cameras, self._settings(), self.home, self._news.set, self.save_path)
        with self._lock:
            if client.client_id not in self.server.get_clients():  # it has disconnected
                return
            self.sessions[client.client_id] = session
            for name, pixels in self.thumbnails.items():
                session.show_thumbnail(name, pixels)
        self._news.set()

    def _settings(self) -> Settings:
        """Initial settings of a client: the model's own K."""
        return Settings(max_hits=self.model().options.max_hits)

    def _goodbye(self, client: "viser.ClientHandle") -> None:
        with self._lock:
            session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.closed.set()


def _kind(settings: Settings) -> tuple[bool, int]:
    """Kind of a picture for `Pace`: the settings that decide the cost of a pixel."""
    return settings.mode in TEXTURED, MAX_HITS if settings.mode == "hit count" else settings.max_hits


def _thumbnail(photo: torch.Tensor) -> np.ndarray:
    """Reduce a photo (H, W, 3) uint8 to at most `THUMBNAIL` pixels a side."""
    from PIL import Image

    image = Image.fromarray(photo.numpy())
    image.thumbnail((THUMBNAIL, THUMBNAIL))
    return np.asarray(image)
