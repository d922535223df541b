"""A viewer that serves, a client that speaks its protocol as a browser does, and cameras to look from."""

import io
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

import nexwarp as nw
from nexwarp.viewer import Viewer, ViewerOptions
from nexwarp.viewer.session import Session
from tests.export.web import support

OPTIONS = nw.RenderOptions(background=(0.1, 0.2, 0.3))
WATCHED = ViewerOptions(0.01, port=0, total=10)  # of a training


def ring() -> dict[str, dict[str, nw.Camera]]:
    """Cameras around the random scene, turned and off the origin."""
    return {"train": support.ring(6)}


class Client:
    """What a browser says and hears, without the browser."""

    def __init__(self, viewer: Viewer, **arguments: Any) -> None:
        import viser
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        protocol = Subprotocol(f"viser-v{viser.__version__}")
        url = viewer.url.replace("http", "ws")
        settings = {"subprotocols": [protocol], "compression": None, "max_size": None, "max_queue": None} | arguments
        self.socket = connect(url, **settings)

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, kind: str, **values: Any) -> None:
        import msgspec

        self.socket.send(msgspec.msgpack.encode({"type": kind, **values}))

    def look(self, **changes: Any) -> None:
        values = {"wxyz": (1, 0, 0, 0), "position": (0, 0, -4), "fov": 0.8, "image_width": 96, "image_height": 72}
        values |= {"near": 0.01, "far": 1000.0, "look_at": (0, 0, 0), "up_direction": (0, -1, 0)}
        self.send("ViewerCameraMessage", **(values | changes))

    @classmethod
    def that_reads_nothing(cls, viewer: Viewer) -> "Client":
        """A client behind small buffers whose messages wait at the server."""
        url = urlsplit(viewer.url)
        narrow = socket.socket()
        narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**14)
        narrow.connect((url.hostname, url.port))
        return cls(viewer, sock=narrow, max_queue=1, close_timeout=0.1)

    def hear(self, seconds: float = 20.0) -> Iterator[dict[str, Any]]:
        """Messages as they come; TimeoutError after some time."""
        import msgspec
        import zstandard

        end = time.monotonic() + seconds
        while True:
            raw = self.socket.recv(timeout=max(end - time.monotonic(), 0.01))
            assert isinstance(raw, bytes)
            length = int.from_bytes(raw[8:16], "little")
            data = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + length]))
            yield from data["messages"]

    def picture(self) -> np.ndarray:
        for message in self.hear():
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                return np.asarray(Image.open(io.BytesIO(message["rgb_data"])))
        raise AssertionError

    def control(self, label: str) -> str:
        """Identifier of a control; panels are sent first."""
        for message in self.hear():
            if message.get("props", {}).get("label") == label:
                return message["uuid"]
        raise AssertionError


@contextmanager
def shown(viewer: Viewer) -> Iterator[None]:
    """Let a viewer draw on a thread of its own."""
    over = threading.Event()
    thread = threading.Thread(target=viewer.show, args=(over.is_set,))
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def serving(model: nw.Model, host: str = "127.0.0.1", **arguments: Any) -> Iterator[Viewer]:
    """A viewer of a model that draws."""
    pytest.importorskip("viser")
    options = ViewerOptions(0.01, host=host, port=0, **arguments)
    with Viewer(lambda: model, ring(), options) as viewer, shown(viewer):
        yield viewer


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def session_of(viewer: Viewer) -> Session:
    """The session of the client that came last."""
    wait_for(lambda: bool(viewer.sessions))
    return viewer.sessions[max(viewer.sessions)]
