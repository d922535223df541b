"""Training steps as CUDA graphs: the bits of launched steps, whatever changes on the way; launches where one fails."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from nexwarp import ops, step_graphs
from nexwarp.config import Config, TextureConfig
from nexwarp.data import Scene, View
from nexwarp.densify import DensifyConfig
from nexwarp.trainer import Trainer
from tests.test_trainer import assert_same_state

pytestmark = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]

TEXTURE = TextureConfig(levels=4, table_size=2**10, width=16)
SETTINGS: dict[str, Any] = {
    "iterations": 120,
    "max_surfels": 400,
    "texture": TEXTURE,
    "densify": DensifyConfig(every=60),  # rounds every ten steps
    "deterministic": True,
}


def trained(scene: Scene, **changes: Any) -> Trainer:
    trainer = Trainer(scene, Config(**(SETTINGS | changes)), "cuda")
    trainer.run()
    return trainer


def graphs_of(trainer: Trainer) -> int:
    assert trainer.graphs is not None
    return sum(stage.graph is not None for stage in trainer.graphs.stages.values())


def masked(scene: Scene) -> Scene:
    def view(v: View) -> View:
        mask = torch.ones(v.image.shape[:2], dtype=torch.bool)
        mask[: len(mask) // 4] = False
        return dataclasses.replace(v, mask=mask)

    return dataclasses.replace(scene, train=[view(v) for v in scene.train])


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"max_hits": 0},
        {"max_hits": 4, "depth_jitter": 0.0, "border": 0.0},
        {"low_pass": True, "losses.depth": 0.0},
        {"coarse": 0.5},
        {"background": (0.1, 0.2, 0.3), "sh_every": 5_000},
    ],
    ids=str,
)
def test_graphs_give_the_bits_of_launches(tiny_scene: Scene, changes: dict[str, Any]) -> None:
    if "losses.depth" in changes:
        changes = {k: v for k, v in changes.items() if k != "losses.depth"}
        changes["losses"] = dataclasses.replace(Config().losses, depth=0.0)
    launched = trained(tiny_scene, cuda_graphs=False, **changes)
    replayed = trained(tiny_scene, **changes)
    assert launched.graphs is None and graphs_of(replayed) > 0
    assert_same_state(replayed, launched)


@pytest.mark.parametrize("mode", ["ignore", "background"])
def test_masks_too(tiny_scene: Scene, mode: str) -> None:
    scene = masked(tiny_scene)
    launched = trained(scene, cuda_graphs=False, mask_mode=mode)
    assert_same_state(trained(scene, mask_mode=mode), launched)


def test_each_step_has_its_own_losses(tiny_scene: Scene) -> None:
    """They are read later, when the graph has long written others."""
    seen: dict[bool, list[dict[str, torch.Tensor]]] = {}
    for graphs in (False, True):
        trainer = Trainer(tiny_scene, Config(**(SETTINGS | {"cuda_graphs": graphs})), "cuda")
        seen[graphs] = [trainer.step().losses for _ in range(40)]
    for launched, replayed in zip(seen[False], seen[True], strict=True):
        assert {k: v.item() for k, v in launched.items()} == {k: v.item() for k, v in replayed.items()}


def test_resuming_changes_nothing(tiny_scene: Scene, tmp_path: Any) -> None:
    straight = trained(tiny_scene)
    first = Trainer(tiny_scene, Config(**SETTINGS), "cuda")
    for _ in range(57):
        first.step()
    first.save(tmp_path)
    second = Trainer(tiny_scene, Config(**SETTINGS), "cuda")
    second.restore(tmp_path)
    second.run()
    assert_same_state(second, straight)


def test_sizes_beyond_the_first_few_are_launched(tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    launched = trained(tiny_scene, cuda_graphs=False)
    monkeypatch.setattr(step_graphs, "MOST_KINDS", 1)
    replayed = trained(tiny_scene)
    assert replayed.graphs is not None and len(replayed.graphs.stages) == 1
    assert_same_state(replayed, launched)


@pytest.mark.parametrize("error", [RuntimeError("no"), torch.OutOfMemoryError("out of memory")], ids=str)
def test_a_capture_that_fails_leaves_training_as_it_is(
    tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch, error: RuntimeError
) -> None:
    """In the middle of a step, too: what it did to the gradients is gone."""
    launched = trained(tiny_scene, cuda_graphs=False)
    replayed = Trainer(tiny_scene, Config(**SETTINGS), "cuda")
    real = ops.captured

    @contextmanager
    def failing(*arguments: Any) -> Iterator[None]:
        with real(*arguments):
            yield
            raise error

    monkeypatch.setattr(ops, "captured", failing)
    if isinstance(error, torch.OutOfMemoryError):
        replayed.run()
    else:
        with pytest.warns(UserWarning, match="launched kernel by kernel, which is slower: no"):
            replayed.run()
    assert replayed.graphs is not None and not replayed.graphs.able and not replayed.graphs.stages
    assert_same_state(replayed, launched)


def test_lists_that_outgrow_a_graph_are_recorded_anew(tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too little room is slow but right; the next steps have more."""
    launched = trained(tiny_scene, cuda_graphs=False)
    trainer = Trainer(tiny_scene, Config(**SETTINGS), "cuda")
    answers = iter(bool(i % 7) for i in range(10_000))
    monkeypatch.setattr(ops, "roomy", lambda tiles: next(answers))
    trainer.run()
    assert next(answers) is not None
    assert_same_state(trainer, launched)
