"""A training looks for floaters at set times, and its surfels change only where it finds some."""

import dataclasses

import pytest
import torch

from nexwarp.data import Scene
from nexwarp.train import floaters as floaters_module
from nexwarp.train import trainer as trainer_module
from nexwarp.train.trainer import Trainer
from tests.trainer_support import OFTEN, assert_same_state, small, trained

pytestmark = pytest.mark.usefixtures("one_torch_thread", "few_looks")


@pytest.fixture(scope="session")
def scene(tiny_scene: Scene) -> Scene:
    return tiny_scene


def test_floaters_are_looked_for_while_there_is_time_to_learn_what_was_behind(scene, monkeypatch):
    """Every 3 of 60 iterations, from 50 on, where densification ends; at the end a last time."""
    monkeypatch.setattr(trainer_module, "FLOATERS_EVERY", 1)
    looks = []

    def first(model, cameras, nearest, generator, *, last, ranks):
        looks.append((trainer.iteration, len(model.surfels), generator.initial_seed()))
        assert last == (trainer.iteration == 60)
        return torch.arange(len(model.surfels)) == 0

    monkeypatch.setattr(trainer_module, "floaters", first)
    trainer = Trainer(scene, small(iterations=60, densify=dataclasses.replace(OFTEN, floaters=True)), "cpu")
    counts = {}
    trainer.run(observe=lambda progress: counts.update({progress.iteration: progress.surfels}))
    assert [look[0] for look in looks] == [51, 54, 57, 60]
    assert len({seed for _, _, seed in looks}) == 4
    assert all(counts[iteration] == count - 1 for iteration, count, _ in looks)


def test_without_points_nothing_tells_of_floaters(scene, monkeypatch):
    monkeypatch.setattr(trainer_module, "FLOATERS_EVERY", 1)
    monkeypatch.setattr(trainer_module, "floaters", lambda *_, **__: pytest.fail("looked"))
    blind = dataclasses.replace(scene, train=[dataclasses.replace(view, points=None) for view in scene.train])
    trained(blind, small(iterations=30, densify=dataclasses.replace(OFTEN, floaters=True)))


def test_looking_for_floaters_changes_nothing_where_there_are_none(scene, monkeypatch):
    monkeypatch.setattr(trainer_module, "FLOATERS_EVERY", 1)
    monkeypatch.setattr(floaters_module, "LEAST_SHARE", 2.0)
    monkeypatch.setattr(floaters_module, "LAST_SHARE", 2.0)
    with_look, without = (
        trained(scene, small(iterations=30, densify=dataclasses.replace(OFTEN, floaters=on))) for on in (True, False)
    )
    assert_same_state(with_look, without)
