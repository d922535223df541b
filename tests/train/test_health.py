import dataclasses
import json
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from nexwarp.errors import CheckpointError, DivergedError, NexwarpError, OutOfMemoryError
from nexwarp.machine import needed_memory
from nexwarp.train import state, trainer
from nexwarp.train.checkpoint import save_checkpoint
from nexwarp.train.losses import step_losses
from nexwarp.train.optimizer import make_optimizer
from nexwarp.train.recipe import DensifyConfig
from nexwarp.train.report import not_finite
from nexwarp.train.trainer import Trainer
from tests.cli.support import refused
from tests.trainer_support import small

pytestmark = pytest.mark.usefixtures("small_preset")

NAN, INF = math.nan, math.inf
SMALL = small(iterations=40, max_surfels=60, densify=DensifyConfig(every=5))
FLAGS = ["--iterations", "40", "--max-surfels", "60", "--device", "cpu"]


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
    """Let a fault strike before Adam's step of some iterations; returns those it struck."""
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
def test_a_fault_ends_the_training_and_is_named(scene, monkeypatch, where, value):
    """Struck at iteration 13: told by 14, the next look, before anybody is told of 14."""
    monkeypatch.setattr(trainer, "CHECK_EVERY", 7)
    struck = inject(monkeypatch, {13}, poison(where, value))
    run, seen = Trainer(scene, SMALL, "cpu"), []
    with pytest.raises(DivergedError, match=r"iteration 1[34]: ") as caught:
        run.run(lambda step: seen.append(step.iteration))
    assert isinstance(caught.value, (NexwarpError, RuntimeError)) and "\n" not in str(caught.value)
    assert struck == [13] and seen == list(range(1, 14))


def test_a_bad_loss_is_named_with_its_iteration(scene, monkeypatch):
    run = Trainer(scene, SMALL, "cpu")

    def spoilt(*args: Any, **options: Any) -> dict[str, torch.Tensor]:
        terms = step_losses(*args, **options)
        if run.iteration == 14:
            terms["dssim"] = terms["dssim"] * NAN
        return terms

    monkeypatch.setattr(trainer, "step_losses", spoilt)
    with pytest.raises(DivergedError, match=r"^iteration 14: the loss 'dssim' is nan; "):
        run.run()


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
    fewer = Trainer(dataclasses.replace(scene, train=scene.train[:-1]), SMALL, "cpu")
    with pytest.raises(CheckpointError, match=r"expected a checkpoint of this run, .*other training views"):
        fewer.restore(tmp_path)


def test_the_command_line_names_the_fault_and_keeps_the_checkpoint(tiny_folder, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    inject(monkeypatch, {22}, poison("gradient surfels.means"))
    command = ["train", str(tiny_folder), "--run", str(run), *FLAGS, "--checkpoint-every", "4"]
    refused(capsys, command, "nexwarp: error: iteration 2", "; the last checkpoint stays\n")
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


def test_too_little_memory_says_what_to_lower(scene, tiny_folder, tmp_path, monkeypatch, capsys):
    def fail(*_: Any, **__: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has 1 KiB free")

    monkeypatch.setattr(trainer, "draw", fail)
    run = Trainer(scene, dataclasses.replace(SMALL, max_surfels=48), "cpu")
    with pytest.raises(OutOfMemoryError) as caught:
        run.run()
    for word in ("iteration 1", "needed 2.50 GiB", "48x36", "--max-surfels (now 48)", "--max-hits", "--downscale"):
        assert word in str(caught.value), word
    command = ["train", str(tiny_folder), "--run", str(tmp_path / "run"), *FLAGS]
    refused(capsys, command, "nexwarp: error: out of memory at iteration 1: it needed 2.50 GiB")


def beyond_the_last(state: torch.Tensor) -> torch.Tensor:
    """A generator's state whose next number lies behind its 624 numbers, which torch does not check."""
    state[8:12] = torch.tensor([112, 2, 0, 0])  # 624 numbers left
    state[16:24] = torch.tensor([112, 2, 0, 0, 0, 0, 0, 0])  # behind the 624th one
    return state


@pytest.mark.parametrize(
    ("name", "change", "match"),
    [
        ("iteration", lambda _: -1, "iteration"),
        ("surfels.", lambda x: x[:0], "at least one surfel"),
        *((f"rng.{x}", beyond_the_last, rf"rng\.{x}: .* 624 left") for x in ("views", "noise", "torch")),
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
    for values in (tensors, state):
        values.update({key: change(value) for key, value in values.items() if key.startswith(name)})
    save_checkpoint(tmp_path, tensors, state)
    with pytest.raises(CheckpointError, match=rf"does not fit \(.*{match}") as caught:
        Trainer(scene, SMALL, "cpu").restore(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path}: ") and str(caught.value).isprintable()


def test_a_step_that_was_told_of_keeps_no_graph(scene):
    """An observer that holds on to it would hold the buffers of the step, too."""
    step = Trainer(scene, SMALL, "cpu").step()
    assert not step.image.requires_grad and not any(loss.requires_grad for loss in step.losses.values())
    assert step.loss() > 0 and math.isfinite(step.psnr())
