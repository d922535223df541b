import math
import threading
import time
from typing import Any

import pytest

import nexwarp as nw
from nexwarp.train.trainer import Trainer
from nexwarp.viewer import Viewer
from tests.scenes import make_surfels, make_texture, random_scene
from tests.trainer_support import assert_same_state, small
from tests.viewer.support import OPTIONS, WATCHED, Client, ring, session_of


def test_looking_changes_nothing_about_a_training(tiny_scene):
    pytest.importorskip("viser")
    alone, trainer = Trainer(tiny_scene, small(), "cpu"), Trainer(tiny_scene, small(), "cpu")
    alone.run()
    cameras = {"train": {view.name: view.camera for view in tiny_scene.train}}
    described: list[int] = []
    drawn: list[int] = []
    with Viewer(trainer.model, cameras, WATCHED) as viewer, Client(viewer) as client:
        client.look()
        session = session_of(viewer)
        viewer.share.share = 0.9

        def observe(step: Any) -> None:
            def describe() -> str:
                described.append(step.iteration)
                return "fine"

            session.changed_at = -math.inf  # still
            viewer.between_steps(step.iteration, describe)
            drawn.append(session.drawn_step)
            if step.iteration == 6:  # paused by somebody, resumed while it waits
                assert viewer.training is not None
                viewer.training.toggle_pause()
                threading.Timer(0.3, viewer.training.toggle_pause).start()

        trainer.run(observe)
        assert len(set(drawn)) > 2 and described, "pictures came while it trained"
        assert session.frustums
        asked: list[nw.Model] = []
        finished = trainer.finish()
        assert finished.surfels is not trainer.surfels

        def show() -> nw.Model:
            asked.append(finished)
            return finished

        viewer.finish("done", show)
        end = time.perf_counter() + 20
        viewer.show(lambda: (bool(asked) and session.drawn_version == session.version) or time.perf_counter() > end)
        assert asked, "the finished model is shown"
    assert_same_state(alone, trainer)


def test_nobody_looking_costs_nothing_and_a_pause_ends_when_asked():
    pytest.importorskip("viser")
    with Viewer(lambda: TINY, ring(), WATCHED) as viewer:
        start = time.perf_counter()
        for i in range(1000):
            viewer.between_steps(i, lambda: pytest.fail("asked although nobody looks"))
        assert time.perf_counter() - start < 0.05, "less than 50 microseconds a step"
        assert viewer.training is not None
        viewer.training.toggle_pause()
        asked: list[int] = []

        def stop() -> bool:
            asked.append(1)
            return len(asked) > 2

        viewer.between_steps(1, lambda: "paused", stop=stop)
        assert len(asked) == 3


TINY = nw.Model(make_surfels(random_scene(4)), make_texture(), options=OPTIONS)
