"""Clients that attack a viewer: each repeats one kind of misuse until it is stopped."""

import os
import random
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any
from urllib.parse import urlsplit

from nexwarp.viewer import Viewer
from tests.viewer.support import Client

WRONG: dict[str, Any] = {"fov": "wide", "wxyz": None, "position": [1e308] * 3, "image_width": -1, "near": {}}
WINDOWS = ((8192, 8192), (8192, 1), (1, 8192), (1920, 1080))


def come_and_go(viewer: Viewer, generator: random.Random, over: threading.Event) -> None:
    """Connect, say something or nothing, and leave with or without a farewell."""
    client = Client(viewer, close_timeout=0.1)
    for _ in range(generator.randrange(3)):
        client.look()
    if generator.random() < 0.5:
        client.socket.close()
    else:
        client.socket.socket.close()


def send_garbage(viewer: Viewer, generator: random.Random, over: threading.Event) -> None:
    """Send what is no message, what is one with wrong values, and what is no HTTP."""
    url = urlsplit(viewer.url)
    with socket.create_connection((str(url.hostname), int(url.port or 0)), timeout=1.0) as raw:
        raw.sendall(generator.randbytes(generator.randrange(1, 2000)))
    with Client(viewer, close_timeout=0.1) as client:
        for name, value in WRONG.items():
            client.look(**{name: value})
        client.look()
        client.send("GuiUpdateMessage", uuid=[], updates=7)
        client.send("SceneNodeClickMessage", name=None)
        client.send("NoSuchMessage")
        client.socket.send(generator.choice([b"", b"\xc1", generator.randbytes(500), bytes(2**17)]))


def flood(viewer: Viewer, generator: random.Random, over: threading.Event) -> None:
    """Move the camera and all controls as fast as the network allows, with windows of any size.

    But for the training's own controls: whoever may open the viewer may pause the training.
    """
    with Client(viewer, close_timeout=0.1) as client:
        client.look()
        heard = [m for m in messages(client, 0.5) if m["type"].startswith("Gui") and "label" in m.get("props", {})]
        controls = [m["uuid"] for m in heard if m["props"]["label"] not in ("Pause", "Time for pictures")]
        while not over.is_set():
            width, height = generator.choice(WINDOWS)
            client.look(position=generator.choices(range(-5, 5), k=3), image_width=width, image_height=height)
            value = generator.choice([1, 1e9, float("nan"), "normal", "depth", True, []])
            client.send("GuiUpdateMessage", uuid=generator.choice(controls), updates={"value": value})


def take_screenshots(viewer: Viewer, generator: random.Random, over: threading.Event) -> None:
    """Ask for screenshots as large as possible, and never read them."""
    client = Client.that_reads_nothing(viewer)
    try:
        client.look(image_width=8192, image_height=generator.choice((1, 8192)))
        while not over.wait(0.05):
            for session in list(viewer.sessions.values()):
                session.take_screenshot(2160)
    finally:
        client.socket.close()


def messages(client: Client, seconds: float) -> Iterator[dict[str, Any]]:
    """What a client hears within some time."""
    with suppress(TimeoutError):
        yield from client.hear(seconds)


ATTACKS = (come_and_go, send_garbage, flood, take_screenshots)


@contextmanager
def attacked(viewer: Viewer, seed: int = 0) -> Iterator[dict[str, int]]:
    """Inside the context, one thread for each attack repeats it; yields how often each has begun."""
    over, counts = threading.Event(), {attack.__name__: 0 for attack in ATTACKS}

    def repeat(attack: Callable[[Viewer, random.Random, threading.Event], None]) -> None:
        generator = random.Random(f"{seed}{attack.__name__}")
        while not over.is_set():
            counts[attack.__name__] += 1
            # What a refused, closed or overtaken client meets is its own affair.
            with suppress(Exception):
                attack(viewer, generator, over)

    threads = [threading.Thread(target=repeat, args=(attack,)) for attack in ATTACKS]
    for thread in threads:
        thread.start()
    try:
        yield counts
    finally:
        over.set()
        for thread in threads:
            thread.join()


def resources() -> dict[str, int]:
    """Open files, threads and resident bytes of this process."""
    import psutil

    process = psutil.Process()
    files = process.num_fds() if os.name == "posix" else process.num_handles()
    return {"files": files, "threads": process.num_threads(), "bytes": process.memory_info().rss}
