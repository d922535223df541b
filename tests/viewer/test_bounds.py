import gc
import math
import os
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import psutil
import pytest

from nexwarp.errors import OutOfMemoryError
from nexwarp.viewer import Viewer, security
from nexwarp.viewer import viewer as viewer_module
from nexwarp.viewer.modes import Picture, draw
from nexwarp.viewer.pacing import BAND_PIXELS, FIRST_PIXELS, MOST_PIXELS, MOST_SIDE, Pace, limited
from nexwarp.viewer.session import Session
from tests.viewer.support import WATCHED, Client, ring, serving, session_of, shown, wait_for

WINDOWS = [(1920, 1080), (8192, 8192), (8192, 1), (1, 8192), (1, 1), (8192, 100)]


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("rows", [64, 2160])
def test_pictures_have_at_most_8_megapixels(window, rows):
    width, height = window
    scale = limited(rows / height, width, height)
    assert (width * scale) * (height * scale) <= MOST_PIXELS * 1.001 and max(window) * scale <= MOST_SIDE
    assert scale == rows / height or limited(1.01 * scale, width, height) == scale, "as large as it may be"
    pace = Pace()
    assert pace.scale("new", width, height, 0.1) ** 2 * width * height <= max(FIRST_PIXELS, 32 * max(window))
    assert pace.bands("new", MOST_PIXELS) == math.ceil(MOST_PIXELS / BAND_PIXELS), "a rendering has a bounded size"


@pytest.fixture
def heavy_pictures(monkeypatch) -> Iterator[list[int]]:
    """Pictures of noise of a megapixel, drawn in no time; the client of each."""
    noise = np.random.default_rng(0).integers(0, 256, (1000, 1000, 3), dtype=np.uint8)
    drawn: list[int] = []
    original = Viewer._draw

    def count(viewer: Viewer, session: Session, scale: float) -> None:
        drawn.append(session.client.client_id)
        original(viewer, session, scale)

    monkeypatch.setattr(Viewer, "_draw", count)
    monkeypatch.setattr(viewer_module, "draw", lambda *_: Picture(noise))
    yield drawn


def test_a_client_that_reads_slowly_gets_few_pictures(model, heavy_pictures):
    with serving(model) as viewer, Client(viewer) as good:
        good.look()
        assert good.picture().ndim == 3
        with Client.that_reads_nothing(viewer) as slow:
            slow.look()
            wait_for(lambda: len(viewer.sessions) == 2)
            mine, other = (viewer.sessions[number] for number in sorted(viewer.sessions))
            other._take_screenshot(64)
            end = time.monotonic() + 20.0
            while heavy_pictures.count(mine.client.client_id) < 9:
                assert time.monotonic() < end
                for session in (mine, other):
                    session._changed()
                next(good.hear())
            assert heavy_pictures.count(other.client.client_id) <= 5
        wait_for(lambda: len(viewer.sessions) == 1)
        mine._changed()
        assert good.picture().ndim == 3


def test_large_messages_close_their_connection(model):
    from websockets.exceptions import ConnectionClosed

    with serving(model) as viewer, Client(viewer) as good:
        for send, reason in ((b"\x00" * (security.MAX_MESSAGE_BYTES + 1), "too big"), ("text", "1011")):
            with Client(viewer) as bad, pytest.raises(ConnectionClosed, match=reason):
                bad.socket.send(send)
                list(bad.hear())
        good.look()
        assert good.picture().ndim == 3


@pytest.mark.parametrize("error", [MemoryError(), OutOfMemoryError("too little"), OSError("encoder"), KeyError("x")])
@pytest.mark.parametrize("where", ["draw", "status", "welcome"])
def test_no_error_of_the_viewer_ends_a_training(model, monkeypatch, error, where):
    def fail(*_: Any, **__: Any) -> Any:
        raise error

    pytest.importorskip("viser")
    with Viewer(lambda: model, ring(), WATCHED) as viewer:
        if where == "draw":
            monkeypatch.setattr(viewer_module, "draw", fail)
        if where == "welcome":
            monkeypatch.setattr(viewer_module, "Session", fail)
        with Client(viewer) as client:
            client.look()
            if where == "welcome":
                note = next(m for m in client.hear() if m["type"] == "NotificationShowMessage")
                assert "reload" in str(note) and not viewer.sessions
            else:
                wait_for(lambda: bool(viewer.sessions))
            viewer.share.share = 0.9
            for step in range(3):
                wait_for(lambda: not any(s.waiting() for s in viewer.sessions.values()))
                viewer.share.free_at = -math.inf
                viewer.between_steps(step, fail if where == "status" else lambda: "fine")
            if where == "draw":
                assert any("could not be drawn" in str(message) for message in client.hear())
            monkeypatch.setattr(viewer_module, "draw", draw)
            if where != "welcome":
                session_of(viewer).change("mode", "alpha")
                with shown(viewer):
                    assert client.picture().ndim == 3, "it recovers"


def clients() -> dict[int, object]:
    """All objects that stand for a client."""
    viser = pytest.importorskip("viser")
    from websockets.asyncio.server import ServerConnection

    kinds = {Session, viser.ClientHandle, ServerConnection}
    return {id(thing): thing for thing in gc.get_objects() if type(thing) in kinds}


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("count", [30, pytest.param(2000, marks=pytest.mark.slow)])
def test_sessions_leave_nothing_behind(model, count):
    """Files, threads and memory after many sessions: connect, one picture, disconnect."""
    process, others = psutil.Process(), clients()  # of other tests
    with serving(model) as viewer:

        def used_after(sessions: int) -> tuple[int, int, int]:
            for number in range(sessions):
                with Client(viewer, close_timeout=1.0) as client:
                    client.look(position=(0.01 * (number % 50), 0.0, -4.0))
                    assert client.picture().ndim == 3
            wait_for(lambda: not viewer.sessions and not viewer.server._websock_server._live_connections)
            gc.collect()
            files = process.num_fds() if os.name == "posix" else process.num_handles()
            return files, process.num_threads(), process.memory_info().rss

        before, after = used_after(max(count // 10, 10)), used_after(count)
        server = viewer.server._websock_server
        assert not server._client_state_from_id and not server._live_connections
        assert clients().keys() <= others.keys(), "nothing refers to a client that has left"
    growth = [new - old for new, old in zip(after, before, strict=True)]
    assert growth[0] <= 2 and growth[1] <= 32 and growth[2] <= 32 * 2**20, "viser's pool has 32 threads"
