"""A viewer beside a training changes nothing of it and costs little."""

import functools
import math
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from nexwarp.train.trainer import Trainer
from nexwarp.viewer import Viewer
from tests.scenes import make_surfels, make_texture, random_scene
from tests.viewer.support import OPTIONS, WATCHED, Client, ring, wait_for

pytestmark = pytest.mark.usefixtures("one_torch_thread")


def trainer_of(run: Path, **changes: Any) -> Trainer:
    settings: dict[str, Any] = {"iterations": 12, "max_surfels": 120, "densify": DensifyConfig(every=3)} | changes
    texture = TextureConfig(levels=4, table_size=2**10, width=16)
    return Trainer(nw.load_scene(run.parent / "tiny"), Config(**settings, texture=texture), "cpu")


def test_looking_changes_nothing_about_a_training(run):
    pytest.importorskip("viser")
    alone, watched = trainer_of(run), trainer_of(run)
    alone.run()
    described: list[int] = []
    scene = watched.scene
    trainer = watched = trainer_of(run)
    with (
        Viewer(
            trainer.model,
            {"train": {view.name: view.camera for view in scene.train}},
            WATCHED,
            photos={f"train/{view.name}": functools.partial(getattr, view, "image") for view in scene.train},
        ) as viewer,
        Client(viewer) as client,
    ):
        client.look()
        wait_for(lambda: len(viewer.sessions) == 1)
        viewer.share.share = 0.9
        (session,) = viewer.sessions.values()
        drawn = []

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

        watched.run(observe)
        assert len(set(drawn)) > 2 and described, "pictures came while it trained"
        assert session.frustums and len(viewer.thumbnails) == len(scene.train)
        finished = watched.finish()
        viewer.finish("done", lambda: finished)
        asked: list[nw.Model] = []
        shown = viewer.model

        def show() -> nw.Model:
            asked.append(shown())
            return asked[-1]

        viewer.model = show
        start = time.perf_counter()
        viewer.show(
            lambda: (bool(asked) and session.drawn_version == session.version) or time.perf_counter() > start + 20
        )
        assert asked and asked[-1] is finished and finished.surfels is not watched.surfels
    for (name, a), (_, b) in zip(alone._named_parameters(), watched._named_parameters(), strict=True):
        assert torch.equal(a, b), name


def test_nobody_looking_costs_nothing_and_a_pause_ends_when_asked(run):
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
