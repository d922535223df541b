"""The editor of camera paths: views that a browser adds, to play and to keep for `nexwarp render --path`."""

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import interpolate
from nexwarp.viewer.controls import on_click, within
from nexwarp.viewer.world import Viewpoint, camera_to_world, vertical_fov

if TYPE_CHECKING:
    from nexwarp.viewer.session import Session

FPS, PLAY_FPS = 30, 20
SECONDS = (0.1, 600.0)
MOST_VIEWS = 200


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
