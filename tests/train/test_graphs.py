import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.model import graphs as step_graphs
from nexwarp.train import target as training_views
from nexwarp.train.recipe import Config, DensifyConfig, with_settings
from tests.subprocesses import run_python
from tests.trainer_support import TEXTURE, assert_same_state

pytestmark = pytest.mark.cuda

SETTINGS: dict[str, Any] = {
    "iterations": 120,
    "max_surfels": 400,
    "texture": TEXTURE,
    "densify": DensifyConfig(every=60),  # rounds every ten steps
    "deterministic": True,
}


def trained(scene: nw.Scene, own_losses: Any = None, teachers: Any = (), **changes: Any) -> nw.Trainer:
    trainer = nw.Trainer(scene, Config(**(SETTINGS | changes)), "cuda", losses=own_losses, teachers=teachers)
    trainer.run()
    return trainer


def graphs_of(trainer: nw.Trainer) -> int:
    assert trainer.graphs is not None
    return sum(stage.captured is not None for stage in trainer.graphs.stages.values())


def half(view: nw.View) -> nw.View:
    camera, width = view.camera, view.camera.width // 2
    small = nw.Camera(camera.viewmat, camera.K, width, camera.height, near=camera.near)
    return dataclasses.replace(view, camera=small, image=view.image[:, :width].contiguous())


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"max_hits": 0},
        {"max_hits": 4, "depth_jitter": 0.0},
        {"losses.depth": 0.0},
        {"refine_poses": True},
        {"background": (0.1, 0.2, 0.3), "sh_every": 5_000},
    ],
    ids=str,
)
def test_graphs_give_the_bits_of_launches(tiny_scene: nw.Scene, changes: dict[str, Any]) -> None:
    parts = {name: x for name, x in changes.items() if "." in name}
    config = with_settings(Config(**SETTINGS), parts)
    changes = {name: x for name, x in changes.items() if name not in parts}
    changes |= {part: getattr(config, part) for part in {name.split(".")[0] for name in parts}}
    launched = trained(tiny_scene, cuda_graphs=False, **changes)
    replayed = trained(tiny_scene, **changes)
    assert launched.graphs is None and graphs_of(replayed) > 0
    assert_same_state(replayed, launched)


def test_own_losses_are_captured(tiny_scene: nw.Scene) -> None:
    def loss(rendering: nw.Rendering, target: nw.Target) -> torch.Tensor:
        return 0.1 * (rendering.image - target.photo).square().mean()

    launched, replayed = (trained(tiny_scene, {"own": loss}, cuda_graphs=graphs) for graphs in (False, True))
    assert graphs_of(replayed) > 0
    assert_same_state(replayed, launched)


def test_photos_with_and_without_depth_maps_share_a_graph(tiny_scene: nw.Scene) -> None:
    maps = [torch.full(view.image.shape[:2], 3.0).half() for view in tiny_scene.train]
    pairs = enumerate(zip(tiny_scene.train, maps, strict=True))
    views = [dataclasses.replace(view, depth=depth if index % 2 else None) for index, (view, depth) in pairs]
    scene = dataclasses.replace(tiny_scene, train=views)
    launched, replayed = trained(scene, cuda_graphs=False), trained(scene)
    assert graphs_of(replayed) == 1
    assert_same_state(replayed, launched)


def test_the_first_step_after_a_round_is_captured(tiny_scene: nw.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounds replace tensors, and nothing else of what a step launches."""
    trainer = nw.Trainer(tiny_scene, Config(**SETTINGS), "cuda")
    optimize = trainer._optimize
    launched: list[int] = []
    rounds: list[int] = []

    def noted(target: nw.Target) -> step_graphs.StepResult:
        if not torch.cuda.is_current_stream_capturing():
            launched.append(trainer.iteration)
        return optimize(target)

    monkeypatch.setattr(trainer, "_optimize", noted)
    for _ in range(100):
        count = len(trainer.surfels)
        trainer.step()
        if len(trainer.surfels) != count:
            rounds.append(trainer.iteration)
    assert len(rounds) >= 4
    # Launched where there may be twice as many surfels, whose lists are of unknown length.
    assert sum(iteration + 1 in launched for iteration in rounds) <= len(rounds) // 2


def test_teachers_too(tiny_scene: nw.Scene) -> None:
    """Steps with a teacher's picture have the graph of steps with photos."""
    teachers = [trained(tiny_scene, seed=seed).finish() for seed in (1, 2)]
    launched, replayed = (trained(tiny_scene, None, teachers, cuda_graphs=graphs) for graphs in (False, True))
    assert graphs_of(replayed) == 1
    assert_same_state(replayed, launched)


def test_each_step_has_its_own_losses(tiny_scene: nw.Scene) -> None:
    """They are read later, when the graph has long written others."""
    seen: dict[bool, list[dict[str, torch.Tensor]]] = {}
    for graphs in (False, True):
        trainer = nw.Trainer(tiny_scene, Config(**(SETTINGS | {"cuda_graphs": graphs})), "cuda")
        seen[graphs] = [trainer.step().losses for _ in range(40)]
    for launched, replayed in zip(seen[False], seen[True], strict=True):
        assert {k: v.item() for k, v in launched.items()} == {k: v.item() for k, v in replayed.items()}


@pytest.mark.parametrize("forgotten", [10**6, 0], ids=["launched", "make room"])
def test_sizes_beyond_the_first_few(tiny_scene: nw.Scene, monkeypatch: pytest.MonkeyPatch, forgotten: int) -> None:
    halves = [half(view) if index % 2 else view for index, view in enumerate(tiny_scene.train)]
    scene = dataclasses.replace(tiny_scene, train=halves)
    launched = trained(scene, cuda_graphs=False)
    monkeypatch.setattr(step_graphs, "MOST_KINDS", 1)
    monkeypatch.setattr(step_graphs, "FORGOTTEN", forgotten)
    replayed = trained(scene)
    assert replayed.graphs is not None and len(replayed.graphs.stages) == 1
    assert_same_state(replayed, launched)


def test_a_first_training_in_a_process(tiny_folder: Path) -> None:
    code = (
        "import nexwarp as nw; from nexwarp.train.recipe import Config; from nexwarp.train.trainer import Trainer\n"
        f"trainer = Trainer(nw.load_scene({str(tiny_folder)!r}), Config(max_surfels=100), 'cuda')\n"
        "captured = 0\n"
        "for _ in range(12):\n"
        "    trainer.step()\n"
        "    captured += sum(stage.captured is not None for stage in trainer.graphs.stages.values())\n"
        "assert captured\n"
    )
    done = run_python("-W", "error", "-c", code)
    assert done.returncode == 0, done.stderr


def test_photos_on_the_host_and_random_backgrounds(tiny_scene: nw.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training_views, "PHOTO_SHARE", 0.0)
    scene = dataclasses.replace(tiny_scene, random_background=True)
    launched = trained(scene, cuda_graphs=False)
    replayed = trained(scene)
    assert not replayed.views.photos[0].is_cuda and graphs_of(replayed) > 0
    assert_same_state(replayed, launched)


def test_going_back_changes_nothing(tiny_scene: nw.Scene) -> None:
    """The steps after it are those of a launched training that goes back, too."""
    runs = []
    for graphs in (False, True):
        trainer = nw.Trainer(tiny_scene, Config(**(SETTINGS | {"cuda_graphs": graphs})), "cuda")
        trainer.run(until=40)
        before = trainer.snapshot()
        trainer.run(until=53)
        trainer.load_snapshot(before)
        trainer.run()
        runs.append(trainer)
    assert_same_state(runs[1], runs[0])


def wait_in_vain() -> None:
    """What invalidates a capture."""
    torch.ones(1, device="cuda").item()


def fail() -> None:
    raise RuntimeError("no")


def lack_memory() -> None:
    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")


@pytest.mark.parametrize("fault", [wait_in_vain, fail, lack_memory])
def test_a_capture_that_fails_leaves_training_as_it_is(tiny_scene, monkeypatch, fault):
    """In the middle of a step, too: what it did to the gradients is gone."""
    launched = trained(tiny_scene, cuda_graphs=False)
    replayed: Any = nw.Trainer(tiny_scene, Config(**SETTINGS), "cuda")
    real = ops.captured

    calls = []

    @contextmanager
    def failing(*arguments: Any) -> Iterator[None]:
        calls.append(1)
        with real(*arguments):
            yield
            if len(calls) > 1:  # the first one is not of a step
                fault()

    monkeypatch.setattr(ops, "captured", failing)
    if fault is lack_memory:
        replayed.run()
    else:
        with pytest.warns(UserWarning, match="launched kernel by kernel, not as CUDA graphs: "):
            replayed.run()
    assert replayed.graphs.chances == 0 and not replayed.graphs.stages and replayed.graphs.keeper is None
    assert_same_state(replayed, launched)


def test_a_step_that_lacks_the_memory_of_graphs_is_done_without_them(tiny_scene: nw.Scene) -> None:
    launched = trained(tiny_scene, cuda_graphs=False)
    trainer = nw.Trainer(tiny_scene, Config(**SETTINGS), "cuda")
    optimize = trainer._optimize
    failed: list[int] = []

    def failing(target: nw.Target) -> step_graphs.StepResult:
        if trainer.iteration == 31 and not failed:  # the first step after a round
            assert trainer.graphs is not None and trainer.graphs.keeper is not None  # whose memory may be missing
            failed.append(1)
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return optimize(target)

    trainer._optimize = failing  # type: ignore[method-assign]
    trainer.run()
    assert failed and trainer.graphs is not None and trainer.graphs.chances == step_graphs.CHANCES - 1
    assert_same_state(trainer, launched)


def test_lists_that_outgrow_a_graph_are_recorded_anew(tiny_scene: nw.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too little room is slow but right; the next steps have more."""
    launched = trained(tiny_scene, cuda_graphs=False)
    trainer = nw.Trainer(tiny_scene, Config(**SETTINGS), "cuda")
    asked: list[ops.ListCapacity] = []

    def fits(room: ops.ListCapacity, **_: bool) -> bool:
        asked.append(room)
        return len(asked) % 7 > 0

    monkeypatch.setattr(ops, "fits", fits)
    trainer.run()
    assert len(asked) > 7
    assert_same_state(trainer, launched)


def test_rounds_at_the_budget_keep_the_graph(tiny_scene: nw.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Children take the rows of pruned surfels: tensors stay where they are, and graphs stay valid."""
    changes = {"max_surfels": 200, "densify": DensifyConfig(every=60, fraction=0.5, prune_opacity=0.09)}
    launched = trained(tiny_scene, cuda_graphs=False, **changes)
    trainer = nw.Trainer(tiny_scene, Config(**(SETTINGS | changes)), "cuda")
    captured: list[int] = []
    replaced: list[int] = []
    stacked, control = step_graphs._stacked, nw.DensityControl.step

    def noted(*given: Any) -> Any:
        captured.append(trainer.iteration)
        return stacked(*given)

    def counted(densifier: nw.DensityControl, *given: Any) -> torch.Tensor:
        before = len(densifier.surfels)
        rows = control(densifier, *given)
        if len(rows.unique()) < len(rows) == before:
            replaced.append(trainer.iteration)
        return rows

    monkeypatch.setattr(ops, "fits", lambda room, **_: True)  # short lists are slow but right, and no reason here
    monkeypatch.setattr(step_graphs, "_stacked", noted)
    monkeypatch.setattr(nw.DensityControl, "step", counted)
    trainer.run()
    assert len(replaced) > 3 and captured
    assert not [i for i in captured if replaced[0] < i <= trainer.densifier.config.stop]
    assert_same_state(trainer, launched)
