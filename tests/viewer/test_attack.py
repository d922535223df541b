"""A training under attack by its viewer's clients, and what a viewer keeps of many clients that have left."""

import functools
import gc
import math
import time
from typing import Any

import pytest
import torch

from nexwarp.viewer import Viewer, ViewerOptions, pacing, security
from nexwarp.viewer.session import Session
from tests.viewer.attack import attacked, resources
from tests.viewer.support import Client, serving, wait_for
from tests.viewer.test_training import trainer_of

pytestmark = pytest.mark.usefixtures("one_torch_thread")

FULL = {"iterations": 300, "pixels": pacing.MOST_PIXELS, "flood": security.FLOOD_SECONDS}
SMALL = {"iterations": 20, "pixels": 2**18, "flood": 1.0}


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("size", [SMALL, pytest.param(FULL, marks=pytest.mark.slow)], ids=["small", "full"])
def test_a_training_under_attack_gives_the_same_bits(tiny_folder, size, monkeypatch, capfd):
    """Clients come and go, send garbage, flood, ask for huge screenshots, and read nothing."""
    pytest.importorskip("viser")
    monkeypatch.setattr(pacing, "MOST_PIXELS", size["pixels"])
    monkeypatch.setattr(security, "FLOOD_SECONDS", size["flood"])
    run = tiny_folder.parent / "run"  # beside the scene; it is not there
    start = time.perf_counter()
    alone = trainer_of(run, iterations=size["iterations"])
    alone.run()
    calm = time.perf_counter() - start
    trainer = trainer_of(run, iterations=size["iterations"])
    views = {view.name: view for view in trainer.scene.train}
    with Viewer(
        trainer.model,
        {"train": {name: view.camera for name, view in views.items()}},
        ViewerOptions(0.01, port=0, total=size["iterations"]),
        photos={f"train/{name}": functools.partial(getattr, view, "image") for name, view in views.items()},
    ) as viewer:
        with attacked(viewer) as counts:
            wait_for(lambda: len(viewer.sessions) > 1 and all(counts.values()))
            drawn: list[float] = []
            draw = viewer._draw_next

            def draw_next(longest: float | None) -> float | None:
                seconds = draw(longest)
                drawn.extend([] if seconds is None else [seconds])
                return seconds

            monkeypatch.setattr(viewer, "_draw_next", draw_next)
            start = time.perf_counter()
            trainer.run(lambda step: viewer.between_steps(step.iteration, lambda: f"loss {step.loss():.3f}"))
            attacked_seconds = time.perf_counter() - start
        figures = f"{calm:.1f} s alone, {attacked_seconds:.1f} s attacked, {sum(drawn):.1f} s of {len(drawn)} pictures"
        with capfd.disabled():
            print(f"\n{size['iterations']} iterations: {figures}, {counts}")
        assert drawn and len(drawn) <= size["iterations"]
        # A fifth of the time is for pictures; the last one may end late. The clients take the rest on the same cores.
        assert attacked_seconds - sum(drawn) < 20.0 * calm + 10.0
        finished = trainer.finish()
        viewer.finish("done", lambda: finished)
        # Sessions end after their connections: viser says goodbye on a thread of its own.
        wait_for(lambda: not viewer.web.gate.clients and not viewer.sessions)
        with Client(viewer) as good:
            good.look()
            wait_for(lambda: len(viewer.sessions) == 1)
            (session,) = viewer.sessions.values()
            session.changed_at = -math.inf
            seen = time.perf_counter() + 20.0
            viewer.show(lambda: session.drawn_version == session.version or time.perf_counter() > seen)
            assert session.drawn_version == session.version
            assert good.picture().ndim == 3, "it still serves"
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err and "exception" not in out + err, out + err
    for (name, a), (_, b) in zip(alone._named_parameters(), trainer._named_parameters(), strict=True):
        assert torch.equal(a, b), name


def clients() -> list[object]:
    """All objects that stand for a client."""
    viser = pytest.importorskip("viser")
    kinds = {Session, viser.ClientHandle, security.Connection}
    return [thing for thing in gc.get_objects() if type(thing) in kinds]


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("count", [30, pytest.param(2000, marks=pytest.mark.slow)])
def test_sessions_leave_nothing_behind(model, count, record_property):
    """Files, threads and memory after many sessions: connect, one picture, disconnect."""
    warm = max(count // 10, 10)
    others = {id(thing): thing for thing in clients()}  # of other tests
    with serving(model) as viewer:

        def visit(number: int) -> None:
            with Client(viewer, close_timeout=1.0) as client:
                client.look(position=(0.01 * (number % 50), 0.0, -4.0))
                assert client.picture().ndim == 3

        def settled() -> dict[str, int]:
            wait_for(lambda: not viewer.sessions and not viewer.web.gate.connections)
            gc.collect()
            return resources()

        for number in range(warm):
            visit(number)
        before = settled()
        for number in range(count):
            visit(number)
        after: dict[str, Any] = settled()
        record_property("sessions", {"before": before, "after": after})
        print(f"after {warm} sessions {before}, after {count} more {after}")
        server = viewer.server._websock_server
        assert not server._client_state_from_id and not server._live_connections
        kept = {id(thing): thing for thing in clients()}
        assert kept.keys() <= others.keys(), "nothing refers to a client that has left"
    assert after["files"] <= before["files"] + 2
    assert after["threads"] <= before["threads"] + 32, "viser's pool"
    assert after["bytes"] <= before["bytes"] + 32 * 2**20
