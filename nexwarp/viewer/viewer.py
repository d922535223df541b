"""The viewer: draws pictures for all connected browsers, on its own or between the steps of a training."""

import contextlib
import errno
import io
import logging
import math
import socket
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import surrounding
from nexwarp.errors import check_package
from nexwarp.io.files import one_line
from nexwarp.io.pictures import encoded
from nexwarp.model.model import Model
from nexwarp.viewer import pacing
from nexwarp.viewer.modes import TEXTURED, Picture, Settings, draw
from nexwarp.viewer.session import Session, TrainingPanel
from nexwarp.viewer.world import Viewpoint, World, clearest, surface_point

if TYPE_CHECKING:
    import viser

    from nexwarp.viewer.security import Gate

SHARE = 0.2  # of a training's time for pictures
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ViewerOptions:
    """Options of a viewer, and what it offers for the run that it shows: nothing where that is None."""

    near: float  # near depth of the viewer's cameras, world units
    title: str = "nexwarp"  # text above the panel
    host: str = "127.0.0.1"  # interface to listen on
    port: int = 8080  # 0 is any free port
    total: int | None = None  # iterations of the training that is shown; None for a finished model
    # Writes a camera path into the run and returns the command that renders it.
    save_path: Callable[[Sequence[Camera]], str] | None = None
    # Returns the command that crops by a sphere, of its centre (3,) and radius.
    crop_command: Callable[[np.ndarray, float], str] | None = None
    # Returns lines that describe one or two points (N, 3), and the command that makes their distance a given length.
    measured: Callable[[np.ndarray, float], list[str]] | None = None
    figures: Mapping[str, tuple[float, float]] | None = None  # "set/name" -> PSNR [dB], sharpness; worst photo first


class Viewer:
    """A web page that shows a model. Pictures are drawn on the thread that calls `show` or `between_steps`."""

    def __init__(
        self,
        model: Callable[[], Model],
        cameras: Mapping[str, Mapping[str, Camera]],
        options: ViewerOptions,
    ) -> None:
        """Start the server. ValueError: the package viser is missing, or the address cannot be used.

        Args:
            model: returns the current model; called for each picture.
            cameras: the scene's cameras by set ("train", "test") and name; may be empty.
            options: title, address and the like.
        """
        self.model, self.options = model, options
        self.cameras = {f"{group}/{name}": camera for group, views in cameras.items() for name, camera in views.items()}
        means = model().surfels.means
        placed = list(self.cameras.values()) or surrounding(means, options.near)
        self.world = World.around(placed, means)
        self.home = Viewpoint.of_camera(clearest(placed))
        self.focal_limit = max((camera.focal for camera in self.cameras.values()), default=math.inf)
        self.pace, self.share = pacing.Pace(), pacing.Share(SHARE)
        self.sessions: dict[int, Session] = {}
        self.step = 0
        self.training: TrainingPanel | None = None
        self._news, self._lock = threading.Event(), threading.Lock()
        self.server, self.url, self.gate = start_server(options.host, options.port)
        self._set_scene()
        if options.total is not None:
            self.training = TrainingPanel(self.server.gui, options.total, self.wake)
        self.server.on_client_disconnect(self._goodbye)
        self.server.on_client_connect(self._welcome)
        self.gate.is_open = True

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect all browsers and stop the server."""
        for session in list(self.sessions.values()):
            session.closed.set()
        with contextlib.redirect_stdout(io.StringIO()):  # drops viser's message
            self.server.stop()

    def wake(self) -> None:
        """Say that a new picture is needed."""
        self._news.set()

    def show(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Draw pictures for the connected browsers until `stop()` returns True or Ctrl-C."""
        if not self.pace.seconds_per_pixel:  # compiles the kernels before a browser connects
            settings = Settings(max_hits=self.model().options.max_hits)
            for _ in range(2):
                self._picture(self.home, pacing.SMALLEST / min(self.home.width, self.home.height), settings)
        while not stop():
            self._draw_or_wait()

    def between_steps(self, step: int, describe: Callable[[], str], stop: Callable[[], bool] = lambda: False) -> None:
        """Draw pictures after `step` iterations of a training; `describe` returns a status line.

        It costs nothing without connected browsers. While the training is paused, it returns only when the training is
        resumed or `stop()` returns True. Errors of the viewer are logged: they do not end the training.
        """
        self.step = step
        if self.training is None or not (self.sessions or self.training.paused):
            return
        training, now = self.training, time.perf_counter()
        try:
            if self.share.due(now):
                training.tell(self.step, describe, now)
                seconds = self._draw_next(pacing.TRAINING_SECONDS)
                if seconds is not None:
                    self.share.spend(time.perf_counter(), seconds)
            if training.paused:
                training.tell(self.step, describe, now, force=True)
                while training.paused and not stop():
                    self._draw_or_wait()
        except Exception as error:  # for example out of memory
            log.warning("the viewer failed: %s", _reason(error))
            self.share.spend(time.perf_counter(), pacing.FIRST_SECONDS)

    def finish(self, text: str, model: Callable[[], Model]) -> None:
        """End the training's display with a status line, and show another model from now on."""
        self.model = model
        for session in list(self.sessions.values()):
            session.drawn_version = -1  # its picture shows the previous model
        self.wake()
        if self.training is not None:
            self.training.finish(text)

    # Drawing

    def _draw_or_wait(self) -> None:
        self._news.clear()
        if self._draw_next(None) is None:
            self._news.wait(0.05 if self.sessions else 0.5)

    def _draw_next(self, longest: float | None) -> float | None:
        """Draw one picture, for the client that has waited longest, of those that have taken their last one.

        It should take `longest` seconds at most; screenshots may take any time. Returns the time for `Share`; None if
        no picture is due.
        """
        for session in sorted(list(self.sessions.values()), key=lambda s: s.drawn_at):
            if session.waiting():
                continue
            start = time.perf_counter()
            is_first = _kind(session.settings) not in self.pace.seconds_per_pixel
            try:
                if session.measure is not None and (clicks := session.measure.clicks):
                    session.drawn_at = start
                    view, place = clicks.popleft()
                    session.measure.add(view, surface_point(self.model(), view, place, self.options.near))
                elif session.screenshot is not None:
                    self._screenshot(session, session.screenshot)
                elif scale := self._due(session, longest, start):
                    self._draw(session, scale)
                else:
                    continue
            except Exception as error:  # for example out of memory; the other clients continue
                session.drawn_version, session.drawn_scale, session.drawn_step = session.version, 1.0, self.step
                session.show(None, f"This picture could not be drawn: {_reason(error)}")
            seconds = time.perf_counter() - start
            return min(seconds, pacing.FIRST_SECONDS) if is_first else seconds
        return None

    def _due(self, session: Session, longest: float | None, now: float) -> float:
        """Scale of the next picture of a client; 0 if none is due."""
        here = session.viewpoint
        if here is None:
            return 0.0
        kind, size = _kind(session.settings), (here.width, here.height)
        finest = pacing.limited(1.0, *size)
        if longest is not None:
            finest = min(finest, self.pace.scale(kind, *size, longest))
        if session.version != session.drawn_version:
            return min(self.pace.scale(kind, *size, pacing.MOVING_SECONDS), finest)
        is_still = now - session.changed_at > pacing.STILL_AFTER
        is_current = session.drawn_step == self.step
        if longest is not None:
            return finest if is_still and not is_current else 0.0
        if not is_still or (is_current and session.drawn_scale >= finest):
            return 0.0
        return min(2.0 * session.drawn_scale, finest)

    def _draw(self, session: Session, scale: float) -> None:
        # Read before drawing: a later change makes the picture stale.
        version, settings, here = session.version, session.settings, session.viewpoint
        assert here is not None  # `_due` returns 0 without a viewpoint
        session.drawn_at = start = time.perf_counter()
        picture = self._picture(here, scale, settings, lambda: session.version != version or session.closed.is_set())
        seconds = time.perf_counter() - start
        if picture is None:
            return
        height, width = picture.pixels.shape[:2]
        quality = 90 if scale >= 1.0 else 75
        session.client.scene.set_background_image(picture.pixels, format="jpeg", jpeg_quality=quality)
        session.drawn_version, session.drawn_scale, session.drawn_step = version, scale, self.step
        text = f"{width} x {height}, {1e3 * seconds:.0f} ms"
        session.show(picture, text if scale >= 1.0 else f"{text} (window: {here.width} x {here.height})")

    def _picture(
        self, here: Viewpoint, scale: float, settings: Settings, stale: Callable[[], bool] = lambda: False
    ) -> Picture | None:
        """Draw a picture; None if it became stale and was cancelled."""
        model = self.model()
        kind, pixels = _kind(settings), here.width * here.height * scale**2
        limit = self.focal_limit if settings.as_trained else math.inf
        bands = here.bands(scale, self.options.near, model.surfels.means, self.pace.bands(kind, pixels), limit)
        if model.device.type == "cuda":
            torch.cuda.synchronize(model.device)  # excludes the queued work of the training from the measured time
        start = time.perf_counter()
        picture = draw(model, bands, settings, stale)
        if picture is not None:
            self.pace.observe(kind, picture.pixels.size // 3, time.perf_counter() - start)
        return picture

    def _screenshot(self, session: Session, height: int) -> None:
        session.screenshot = None
        here, settings = session.viewpoint, session.settings
        if here is None:
            return
        session.drawn_at = time.perf_counter()
        picture = self._picture(here, pacing.limited(height / here.height, here.width, here.height), settings)
        assert picture is not None  # never stale
        name = f"{self.options.title}_{settings.mode}.png".replace(" ", "_")
        session.client.send_file_download(name, encoded(picture.pixels, format="PNG"), save_immediately=True)

    # The page

    def _set_scene(self) -> None:
        server, start = self.server, self.server.initial_camera
        position, forward = self.home.pose[:3, 3], self.home.pose[:3, 2]
        distance = max(float((self.world.focus - position) @ forward), 0.1 * self.world.unit)
        server.scene.set_up_direction(self.world.up)
        start.position = self.world.to_browser(position)
        start.look_at = self.world.to_browser(position + forward * distance)
        start.fov = self.home.fov
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        server.gui.set_panel_label(f"nexwarp · {self.options.title}")

    def _welcome(self, client: "viser.ClientHandle") -> None:
        try:
            session = Session(self, client)
            with self._lock:
                if client.client_id in self.server.get_clients():  # else it has disconnected
                    self.sessions[client.client_id] = session
            self.wake()
        except Exception as error:  # for example out of memory
            client.add_notification("The viewer could not serve this tab: reload it", _reason(error))

    def _goodbye(self, client: "viser.ClientHandle") -> None:
        with self._lock:
            session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.closed.set()


def _kind(settings: Settings) -> tuple[bool, int]:
    """Kind of a picture for `Pace`: the settings that decide the cost of a pixel."""
    return settings.mode in TEXTURED, settings.max_hits


def _reason(error: Exception) -> str:
    """The message of an error, or its type if it has none."""
    return one_line(error) or type(error).__name__


# The server


def start_server(host: str, port: int) -> tuple["viser.ViserServer", str, "Gate"]:
    """Start viser on exactly this address; return it, the address to open, with a token if it needs one, and its gate.

    The gate admits requests by the rules of security.py, none until `is_open` is set. Errors are of `listen`.
    """
    listener = listen(host, port)
    import viser

    from nexwarp.viewer.security import Access, Gate, accept_only_known

    # Broken connections and invalid messages are errors of the page: they are not logged.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", ".* on a closed connection", UserWarning)  # a tab was closed
    address, bound = listener.getsockname()[:2]
    gate = Gate(Access.to(address))
    with contextlib.redirect_stdout(io.StringIO()), gate.before_viser(listener):  # drops its banner
        server = viser.ViserServer(host=address, port=bound, verbose=False)
    if not gate.attached:
        server.stop()
        raise ValueError(f"the viewer needs viser as in constraints.txt, found {viser.__version__}")
    accept_only_known(server)
    return server, _url(address, bound, gate.access.token), gate


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens on an address of a host, an IPv4 one if it has several; viser would try other ports.

    ValueError: viser is missing, or the address cannot be used.
    """
    check_package("the viewer", "viser", "viewer")
    if not 0 <= port <= 65535:
        raise ValueError(f"--port: expected 0 to 65535, got {port}")
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, *_, address = min(addresses, key=lambda entry: entry[0] != socket.AF_INET)
        return socket.create_server(address, family=family)
    except (OSError, UnicodeError) as error:  # UnicodeError: a name that DNS cannot hold
        number = getattr(error, "errno", None)
        if number == errno.EADDRINUSE:
            expected = f"--port: expected a free port, but {port} is in use on {host}"
            raise ValueError(f"{expected}; give another --port") from None
        if number in (errno.EACCES, errno.EPERM):
            raise ValueError(f"--port: expected a port that may be used, but {port} is refused ({error})") from None
        raise ValueError(f"--host: expected an address of this machine, got {host!r} ({error})") from None


def _url(address: str, port: int, token: str) -> str:
    """Address to open; of all interfaces, the loopback one."""
    name = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(address, address)
    return f"http://{f'[{name}]' if ':' in name else name}:{port}" + (f"/?token={token}" if token else "")
