"""Helpers run short trainings, and compare all that a training's future depends on."""

import dataclasses
from pathlib import Path
from typing import Any

import torch

import nexwarp as nw
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from tests.tolerances import assert_equal

TEXTURE = TextureConfig(levels=4, table_size=2**10, width=16)
# Rounds of density control at 3, 6 and 9 of 12 iterations, so that a short run has them all.
OFTEN = DensifyConfig(every=3)


def small(**changes: Any) -> Config:
    settings: dict[str, Any] = {"iterations": 12, "max_surfels": 120, "texture": TEXTURE, "densify": OFTEN}
    return Config(**(settings | changes))


def state_of(trainer: nw.Trainer) -> dict[str, torch.Tensor]:
    """Every tensor that the future of a run depends on."""
    state: dict[str, torch.Tensor] = dict(trainer._named_parameters())
    for name, parameter in list(state.items()):
        state |= {f"adam.{name}.{k}": v for k, v in trainer.optimizer.state[parameter].items()}
    state |= {"errors": trainer.densifier.errors, "generator": trainer.generator.get_state()}
    state |= {"order": torch.tensor(trainer.order), "iteration": torch.tensor(trainer.iteration)}
    return {name: value.detach().clone() for name, value in state.items()}


def assert_same_state(one: nw.Trainer, other: nw.Trainer) -> None:
    assert_equal(state_of(one), state_of(other))


def trained(scene: nw.Scene, config: Config) -> nw.Trainer:
    trainer = nw.Trainer(scene, config, "cpu")
    trainer.run()
    return trainer


def rescaled(scene: nw.Scene, factor: float) -> nw.Scene:
    """The same scene in other units."""

    def moved(view: nw.View) -> nw.View:
        c = view.camera
        viewmat = c.viewmat.clone()
        viewmat[:3, 3] *= factor
        camera = nw.Camera(viewmat, c.K, c.width, c.height, near=c.near * factor)
        assert view.points is not None
        return dataclasses.replace(view, camera=camera, points=view.points * factor)

    train, test = ([moved(view) for view in views] for views in (scene.train, scene.test))
    return dataclasses.replace(scene, train=train, test=test, points=scene.points * factor, scale=scene.scale * factor)


def assert_resumed_alike(straight: nw.Trainer, folder: Path, stop: int = 7, **options: Any) -> None:
    """Stopped after some steps, restored elsewhere and gone on: the state of an uninterrupted run, bit for bit."""
    first, second = (nw.Trainer(straight.scene, straight.config, "cpu", **options) for _ in range(2))
    first.run(until=stop)
    first.save(folder)
    torch.manual_seed(99)
    second.restore(folder)
    assert_same_state(second, first)
    second.run()
    assert_same_state(second, straight)
