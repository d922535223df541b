import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from nexwarp.io.json_files import parse_json
from nexwarp.run.folder import LOG_FILE, TENSORBOARD_FOLDER
from nexwarp.run.log import TrainingLog, keep_lines
from nexwarp.train.report import StepReport
from nexwarp.train.trainer import Trainer
from tests.trainer_support import small

CONFIG = small(max_surfels=60)
CLOCK = ("iterations_per_second", "seconds", "memory_bytes")


@pytest.fixture
def trainer(tiny_scene) -> Trainer:
    return Trainer(tiny_scene, CONFIG, "cpu")


def lines(run: Path) -> list[dict[str, Any]]:
    """The log, read by a strict reader: no NaN, no half line."""
    text = (run / LOG_FILE).read_text(encoding="utf-8")
    assert text.endswith("\n") or not text
    return [parse_json(LOG_FILE, line.encode(), finite=True) for line in text.splitlines()]


def without_clock(line: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in line.items() if name not in CLOCK}


def test_a_line_is_what_the_step_was(trainer, tmp_path):
    seen: list[dict[str, Any]] = []
    with TrainingLog(tmp_path, trainer) as log:

        def observe(step: StepReport) -> None:
            log(step)
            losses = {name: x.item() for name, x in step.losses.items()}
            seen.append({"iteration": step.iteration, "losses": losses, "psnr": step.psnr(), "surfels": step.surfels})
            assert len(lines(tmp_path)) == step.iteration  # flushed: it can be read at once

        trainer.run(observe)
    for line, step in zip(lines(tmp_path), seen, strict=True):
        assert {name: line[name] for name in step} == step
        assert line["loss"] == pytest.approx(sum(step["losses"].values()))
        assert line["iterations_per_second"] > 0 and line["memory_bytes"] > 2**20
    seconds = [line["seconds"] for line in lines(tmp_path)]
    assert seconds == sorted(seconds) and seconds[-1] == trainer.seconds


@pytest.mark.parametrize(
    ("total", "expected"),
    [(12, list(range(1, 13))), (250, [*range(1, 250, 2), 250]), (30_000, [*range(1, 30_000, 100), 30_000])],
)
def test_numbers_are_fetched_only_for_lines(trainer, tmp_path, total, expected):
    """Between lines the step's tensors are not touched: nothing waits for the device."""

    class Step:
        views = 1

        def __init__(self, iteration: int) -> None:
            self.iteration = iteration

        def __getattr__(self, name: str) -> Any:
            fetched.append(self.iteration)
            return {"losses": {"image": torch.tensor(0.5)}, "surfels": 3, "psnr": lambda: 20.0}[name]

    fetched: list[int] = []
    trainer.config = dataclasses.replace(CONFIG, iterations=total)
    with TrainingLog(tmp_path, trainer) as log:
        for iteration in range(1, total + 1):
            step: Any = Step(iteration)
            log(step)
    assert [line["iteration"] for line in lines(tmp_path)] == expected == sorted(set(fetched))


def test_resuming_goes_on_as_if_nothing_had_happened(trainer, tiny_scene, tmp_path):
    """Lines beyond the checkpoint, and one cut off, are dropped; the rest is that of an uninterrupted run."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    whole.mkdir(), broken.mkdir()
    with TrainingLog(whole, trainer) as log:
        trainer.run(log)
    first, second = (Trainer(tiny_scene, CONFIG, "cpu") for _ in range(2))
    with TrainingLog(broken, first) as log:
        first.run(log, until=5)
        first.save(broken)
        first.run(log, until=9)
    with (broken / LOG_FILE).open("a") as file:
        file.write('{"iteration": 4, "loss"')
    second.restore(broken)
    with TrainingLog(broken, second) as log:
        second.run(log)
    assert [without_clock(line) for line in lines(broken)] == [without_clock(line) for line in lines(whole)]
    assert [f.name for f in broken.iterdir() if "tmp" in f.name] == []


@pytest.mark.parametrize(
    "damage", [b"\xff\xfe\n", b"[]\n", b"null\n", b'{"iteration": "2"}\n', b"{}\n", b"\n", b"{" * 9]
)
def test_damaged_lines_are_dropped(tmp_path, damage):
    path = tmp_path / LOG_FILE
    end = b"" if damage.endswith(b"\n") else b"\n"
    path.write_bytes(b'{"iteration": 1}\n' + damage + end + b'{"iteration": 3}\n')
    keep_lines(path, 3)
    assert [line["iteration"] for line in lines(tmp_path)] == [1, 3]
    keep_lines(path, 2)
    assert [line["iteration"] for line in lines(tmp_path)] == [1]


def test_what_is_not_finite_is_null(trainer, tmp_path):
    nothing = torch.full((2, 2, 3), math.nan)
    losses = {"image": torch.tensor(math.nan), "grid": torch.tensor(math.inf), "alpha": torch.tensor(1.0)}
    with TrainingLog(tmp_path, trainer) as log:
        log(StepReport(1, 5, losses, nothing, nothing))
    (line,) = lines(tmp_path)
    assert line["losses"] == {"image": None, "grid": None, "alpha": 1.0}
    assert line["loss"] is None and line["psnr"] is None


def events(run: Path) -> dict[str, dict[int, float]]:
    """Scalars by tag and step, as TensorBoard shows them."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    reader = accumulator.EventAccumulator(str(run / TENSORBOARD_FOLDER))
    reader.Reload()
    return {tag: {e.step: e.value for e in reader.Scalars(tag)} for tag in reader.Tags()["scalars"]}


def test_tensorboard_shows_the_lines(tiny_scene, tmp_path):
    """The same values under the same steps, also after a run was resumed from an earlier iteration."""
    pytest.importorskip("tensorboard", reason="tensorboard is not installed (pip install 'nexwarp[tensorboard]')")
    trainer = Trainer(tiny_scene, CONFIG, "cpu")
    with TrainingLog(tmp_path, trainer, tensorboard=True) as log:
        for _ in range(8):
            log(trainer.step())
            if trainer.iteration == 5:
                trainer.save(tmp_path)
    assert max(events(tmp_path)["loss/total"]) == 8
    trainer = Trainer(tiny_scene, CONFIG, "cpu")
    trainer.restore(tmp_path)
    with TrainingLog(tmp_path, trainer, tensorboard=True) as log:
        trainer.run(log)
    shown, written = events(tmp_path), lines(tmp_path)
    steps = {line["iteration"]: line for line in written}
    assert set(steps) == set(range(1, 13)) == set(shown["loss/total"])
    for tag, value in (
        ("loss/total", lambda line: line["loss"]),
        ("train/psnr", lambda line: line["psnr"]),
        ("train/surfels", lambda line: line["surfels"]),
        ("rate/means", lambda line: line["rates"]["means"]),
        ("rate/mlp", lambda line: line["rates"]["mlp"]),
        ("memory/GiB", lambda line: line["memory_bytes"] / 2**30),
    ):
        assert shown[tag] == pytest.approx({step: value(line) for step, line in steps.items()}, rel=1e-6), tag
    terms = {name for line in written for name in line["losses"]}
    assert {f"loss/{name}" for name in terms | {"total"}} == {tag for tag in shown if tag.startswith("loss/")}
