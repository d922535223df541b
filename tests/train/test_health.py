"""Numbers that are not finite are found, named, gone back from once, then given up; memory that does not suffice."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.data import Scene
from nexwarp.errors import CheckpointError, DivergedError, NexwarpError, OutOfMemoryError
from nexwarp.machine import needed_memory
from nexwarp.train import state, trainer
from nexwarp.train.checkpoint import save_checkpoint
from nexwarp.train.losses import step_losses
from nexwarp.train.optimizer import make_optimizer
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from nexwarp.train.report import not_finite
from nexwarp.train.trainer import Trainer
from tests.scene_writers import write_demo

pytestmark = pytest.mark.usefixtures("small_preset")

NAN, INF = math.nan, math.inf
SMALL = Config(
    iterations=40,
    max_surfels=60,
    texture=TextureConfig(levels=2, table_size=2**6, width=8),
    densify=DensifyConfig(every=5),
)
FLAGS = ["--iterations", "40", "--max-surfels", "60", "--device", "cpu"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_demo(tmp_path_factory.mktemp("scenes") / "tiny", width=24, height=18, views=6, points=100)


@pytest.fixture(scope="module")
def scene(folder) -> Scene:
    return nw.load_scene(folder)


def poison(where: str, value: float = NAN) -> Callable[[Trainer], None]:
    """Something that spoils one value of a parameter, or of its gradient, before Adam's step."""

    def spoil(run: Trainer) -> None:
        kind, _, name = where.rpartition(" ")
        parameter = dict(run._named_parameters())[name]
        target = parameter.grad if kind == "gradient" else parameter.data
        assert target is not None
        target.view(-1)[3] = value

    return spoil


def inject(patch: pytest.MonkeyPatch, iterations: set[int], spoil: Callable[[Trainer], None]) -> list[int]:
    """Let a fault strike before Adam's step of some iterations, each time they come; returns those it struck."""
    struck: list[int] = []
    trainers: list[Trainer] = []
    init = Trainer.__init__

    def remember(self: Trainer, *args: Any, **options: Any) -> None:
        trainers.append(self)
        init(self, *args, **options)

    def strike(*_: Any) -> None:
        if trainers[-1].iteration in iterations:
            struck.append(trainers[-1].iteration)
            spoil(trainers[-1])

    def make(*args: Any) -> torch.optim.Optimizer:
        optimizer = make_optimizer(*args)
        optimizer.register_step_pre_hook(strike)
        return optimizer

    patch.setattr(Trainer, "__init__", remember)
    patch.setattr(state, "make_optimizer", make)
    return struck


class Once(set[int]):
    """Iterations that are met once each."""

    def __contains__(self, iteration: object) -> bool:
        there = super().__contains__(iteration)
        self.discard(iteration)
        return there


@pytest.mark.parametrize(("value", "place"), [(NAN, 0), (INF, 4999), (-INF, 9999)])
def test_any_value_that_is_not_finite_is_found(device, value, place):
    tensors = {name: torch.randn(10_000, device=device) for name in ("a", "b", "c")}
    tensors |= {"none": torch.empty(0, 3, device=device), "large": torch.full((9000,), 3e38, device=device)}
    assert not_finite(tensors) == []
    tensors["b"][place] = value
    assert not_finite(tensors) == ["b"]


@pytest.mark.parametrize(
    ("where", "value"),
    [("gradient surfels.means", NAN), ("gradient texture.grid", INF), ("parameter surfels.raw_quats", NAN)],
)
def test_a_fault_is_found_named_and_gone_back_from(scene, monkeypatch, where, value):
    """Struck once at iteration 13: told by 16, the next look; back at 12, the last good state, with half the rates."""
    struck = inject(monkeypatch, Once({13}), poison(where, value))
    told: list[str] = []
    run, seen = Trainer(scene, SMALL, "cpu"), []
    run.run(lambda step: seen.append((step.iteration, run.optimizer.param_groups[0]["lr"])), told.append)
    assert struck == [13] and len(told) == 1
    assert "iteration 1" in told[0] and "going back to iteration 12 with half the learning rates" in told[0]
    assert "\n" not in told[0]
    again = [i for i, (iteration, _) in enumerate(seen) if iteration == 13]
    assert len(again) == 2 and seen[again[1] - 1][0] <= 16
    assert seen[again[1]][1] == pytest.approx(seen[again[0]][1] / 2)
    assert run.iteration == 40 and run.rate_factor == 0.5
    assert not_finite(dict(run._named_parameters())) == []


def test_a_bad_loss_is_named_with_its_iteration(scene, monkeypatch):
    run = Trainer(scene, SMALL, "cpu")
    told: list[str] = []

    def spoilt(*args: Any, **options: Any) -> dict[str, torch.Tensor]:
        terms = step_losses(*args, **options)
        if run.iteration == 14 and run.rate_factor == 1.0:
            terms["dssim"] = terms["dssim"] * NAN
        return terms

    monkeypatch.setattr(trainer, "step_losses", spoilt)
    run.run(warn=told.append)
    assert len(told) == 1 and told[0].startswith("iteration 14: the loss 'dssim' is nan; "), told


def test_what_happens_again_is_given_up(scene, monkeypatch):
    struck = inject(monkeypatch, {22}, poison("gradient surfels.log_scales"))
    run = Trainer(scene, SMALL, "cpu")
    told: list[str] = []
    with pytest.raises(DivergedError, match="halved its learning rates before, so training gives up") as caught:
        run.run(warn=told.append)
    assert isinstance(caught.value, (NexwarpError, RuntimeError)) and "\n" not in str(caught.value)
    assert struck == [22, 22] and len(told) == 1
    assert run.iteration == 20 and run.rate_factor == 0.5
    assert not_finite(run._watched()) == []  # the trainer is in its last good state


def test_faults_are_looked_for_every_so_often(scene, monkeypatch):
    monkeypatch.setattr(trainer, "CHECK_EVERY", 7)
    monkeypatch.setattr(trainer, "SNAPSHOTS", 1)
    inject(monkeypatch, Once({15}), poison("gradient surfels.means"))
    run, seen = Trainer(scene, SMALL, "cpu"), []
    run.run(lambda step: seen.append(step.iteration))
    # The look at 21 finds it before anybody is told of 21; the only state to go back to is the first.
    assert seen == [*range(1, 21), *range(1, 41)]


def test_nothing_that_is_not_finite_is_ever_saved(scene, tmp_path, monkeypatch):
    run = Trainer(scene, SMALL, "cpu")
    run.step()
    run.save(tmp_path)
    run.step()
    run.densifier.errors[2] = NAN
    with pytest.raises(DivergedError, match=r"densify\.errors"):
        run.save(tmp_path)
    run.restore(tmp_path)
    assert run.iteration == 1 and not_finite(run._watched()) == []


def test_the_lowered_rate_is_kept_over_a_resume(scene, tmp_path):
    first, second = Trainer(scene, SMALL, "cpu"), Trainer(scene, SMALL, "cpu")
    first.rate_factor = 0.5
    first.step()
    first.save(tmp_path)
    second.restore(str(tmp_path))
    assert second.rate_factor == 0.5
    for one in (first, second):
        one.step()
    assert first.optimizer.param_groups[0]["lr"] == second.optimizer.param_groups[0]["lr"]
    assert torch.equal(first.surfels.means, second.surfels.means)


def test_the_command_line_gives_up_with_a_model(folder, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    inject(monkeypatch, {22}, poison("gradient surfels.means"))
    assert cli.main(["train", str(folder), "--run", str(run), *FLAGS]) == 2
    out, err = capsys.readouterr()
    assert "warning: " in out and "going back to iteration 20 with half the learning rates" in out
    assert err.startswith("nexwarp: error: ") and err.count("\n") == 1
    assert "gives up" in err and f"the model of iteration 20 is in {run}" in err
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in lines] == list(range(1, len(lines) + 1))  # none of the other future
    assert nw.load(run).meta["iteration"] == 20
    assert json.loads((run / "checkpoint" / "state.json").read_text())["iteration"] == 20


@pytest.mark.parametrize(
    ("error", "needed"),
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has ..."), "2.50 GiB"),
        (RuntimeError("Failed to allocate 3221225472 bytes on device 'cuda:0'"), "3.00 GiB"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 5242880 bytes."), "5.00 MiB"),
        (MemoryError(), "more than there is"),
        (RuntimeError("CUDA error: out of memory\nCUDA kernel errors might be reported later"), "more than there is"),
        (RuntimeError("Warp CUDA error 2: out of memory (in function wp_alloc_device)"), "more than there is"),
        (RuntimeError("std::bad_alloc"), "more than there is"),
        (RuntimeError("shape mismatch"), None),
        (ValueError("out of memory of the names"), None),
    ],
)
def test_errors_of_memory_are_known(error, needed):
    assert needed_memory(error) == needed


def test_too_little_memory_says_what_to_lower(scene, folder, tmp_path, monkeypatch, capsys):
    def fail(*_: Any, **__: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has 1 KiB free")

    monkeypatch.setattr(trainer, "draw", fail)
    run = Trainer(scene, dataclasses.replace(SMALL, max_surfels=48), "cpu")
    with pytest.raises(OutOfMemoryError) as caught:
        run.run()
    for word in ("iteration 1", "needed 2.50 GiB", "24x18", "--max-surfels (now 48)", "--max-hits", "--downscale"):
        assert word in str(caught.value), word
    assert cli.main(["train", str(folder), "--run", str(tmp_path / "run"), *FLAGS]) == 2
    err = capsys.readouterr().err
    assert err.startswith("nexwarp: error: out of memory at iteration 1: it needed 2.50 GiB") and err.count("\n") == 1


# Checkpoints that others made, whose checksums agree, or of other runs


def test_checkpoints_of_other_runs_are_refused(scene, tmp_path):
    run = Trainer(scene, SMALL, "cpu")
    run.step()
    run.save(tmp_path)
    fewer = dataclasses.replace(scene, train=scene.train[:-1])
    for other, settings, reason in (
        (scene, dataclasses.replace(SMALL, iterations=24), "settings"),
        (fewer, SMALL, "views"),
    ):
        with pytest.raises(CheckpointError, match=f"expected a checkpoint of this run, .*{reason}"):
            Trainer(other, settings, "cpu").restore(tmp_path)


@pytest.mark.parametrize(
    ("name", "change", "match"),
    [
        ("iteration", lambda _: -1, "iteration"),
        ("order", lambda _: [0, 77], "order"),
        ("surfels.means", lambda x: x.half(), "float32"),
        ("surfels.means", lambda x: x[:-1], ""),
        ("adam.surfels.means.exp_avg", lambda x: x.T.contiguous(), "shape of its parameter"),
        ("densify.errors", lambda x: x[:1], "one for each"),
        ("rng.torch", lambda x: x[:7], ""),
    ],
)
def test_checkpoints_that_cannot_be_are_refused(scene, tmp_path, name, change, match):
    run = Trainer(scene, SMALL, "cpu")
    run.step()
    tensors, state = run.snapshot()
    values: dict[str, Any] = tensors if name in tensors else state
    values[name] = change(values[name])
    save_checkpoint(tmp_path, tensors, state)
    with pytest.raises(CheckpointError, match=rf"does not fit \(.*{match}") as caught:
        Trainer(scene, SMALL, "cpu").restore(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path}: ") and str(caught.value).isprintable()


def test_a_step_that_was_told_of_keeps_no_graph(scene):
    """An observer that holds on to it would hold the buffers of the step, too."""
    step = Trainer(scene, SMALL, "cpu").step()
    assert not step.image.requires_grad and not any(loss.requires_grad for loss in step.losses.values())
    assert step.loss() > 0 and math.isfinite(step.psnr())
