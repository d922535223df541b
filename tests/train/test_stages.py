import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.cli.display import time_left
from nexwarp.cli.session import Session
from nexwarp.data.scene import SceneSource
from nexwarp.errors import SettingError
from nexwarp.run.folder import RunRecord, create_run, list_files, read_run
from nexwarp.train import stages
from nexwarp.train import trainer as trainer_module
from nexwarp.train.checkpoint import CHECKPOINTS, has_checkpoint
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.recipe import TextureConfig
from nexwarp.train.stages import VIEW_COST, OwnTeachers, StageRunner, divide, plan_teachers, shortened
from tests.cli.support import refused, snapshot

CPU = torch.device("cpu")
CONFIG = nw.Config(
    iterations=20, max_surfels=60, teachers=2, exposures=False, texture=TextureConfig(levels=4, table_size=1024)
)
OWN = {"count": 2, "iterations": 4, "max_surfels": 240}
SETTINGS = ("texture.table_size=1024", "texture.levels=4", "exposures=false")
SMALL = ["--max-surfels", "60", "--device", "cpu", *(text for each in SETTINGS for text in ("--set", each))]


def same(one: nw.Model, other: nw.Model) -> bool:
    theirs = other.state_dict()
    return all(torch.equal(x, theirs[name]) for name, x in one.state_dict().items())


def settings_of(config: nw.Config, own: OwnTeachers) -> list[nw.Config]:
    """The settings of a run's stages, the student's last."""
    return [stage.config for stage in divide(config, own)]


@pytest.mark.parametrize(
    ("preset", "changes", "photos", "iterations"),
    [
        ("default", {}, 43, 30_000),
        ("fast", {}, 43, 9890),
        ("fast", {}, 21, 7000),  # the shortest
        ("fast", {}, 263, 30_000),  # never longer
        ("fast", {"iterations": 700}, 43, 700),
        ("fast", {"steps_a_photo": 300}, 43, 12_900),
    ],
)
def test_a_fast_run_has_the_iterations_that_its_photos_need(preset, changes, photos, iterations):
    config = dataclasses.replace(nw.preset(preset), **changes)
    assert shortened(config, photos) == dataclasses.replace(config, iterations=iterations)


@pytest.mark.parametrize(
    ("changes", "photos", "count"),
    [
        ({}, 21, 2),
        ({}, 44, 2),
        ({}, 45, 0),  # photos are many
        ({"max_surfels": 12_600}, 42, 2),
        ({"max_surfels": 12_600}, 43, 0),  # surfels are few for them
        ({"iterations": 60_000}, 21, 2),
        ({"iterations": 29_999}, 21, 0),  # the run is short
        ({"refine_poses": True}, 21, 0),
        ({"teachers": 0}, 21, 0),
        ({"teachers": 1}, 500, 1),  # what is asked for
        ({"teachers": 3, "iterations": 100, "max_surfels": 100}, 21, 3),
    ],
)
def test_a_run_has_teachers_where_photos_are_few(changes: dict[str, Any], photos: int, count: int) -> None:
    assert plan_teachers(dataclasses.replace(nw.Config(), **changes), photos).count == count


@pytest.mark.parametrize("iterations", [7, 30, 12_345, 30_000])
@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_teachers_have_two_fifths_of_the_iterations(iterations: int, count: int) -> None:
    config = nw.Config(iterations=iterations, teachers=count, seed=5)
    if iterations <= count:
        with pytest.raises(SettingError, match="iterations: expected more than the teachers' 8, got 7"):
            divide(config, plan_teachers(config, 20))
        return
    *before, student = settings_of(config, plan_teachers(config, 20))
    lengths = [each.iterations for each in before]
    assert len(set(lengths)) == 1 and min(lengths) >= 1 and sum(lengths) + student.iterations == iterations
    assert abs(sum(lengths) - 0.4 * iterations) < count or lengths[0] == 1
    assert len({each.seed for each in (*before, student)}) == count + 1 and student.seed == 5
    for each in (*before, student):
        assert each == dataclasses.replace(config, teachers=0, iterations=each.iterations, seed=each.seed)


@pytest.mark.parametrize(
    ("budget", "teachers"), [(60, 240), (9_999, 39_996), (10_000, 40_000), (39_999, 40_000), (40_001, 40_001)]
)
def test_teachers_of_a_small_student_are_larger(budget: int, teachers: int) -> None:
    config = nw.Config(max_surfels=budget, teachers=2)
    *before, student = settings_of(config, plan_teachers(config, 20))
    assert {each.max_surfels for each in before} == {teachers} and student.max_surfels == budget
    # As in a run from before.
    assert {each.max_surfels for each in settings_of(config, OwnTeachers(2, 10))[:-1]} == {budget}


def test_train_is_a_training_for_each_stage(tiny_scene: nw.Scene, tmp_path: Path) -> None:
    """Teachers, then the student with them; its callbacks count the steps of all."""
    seen: list[int] = []

    def note(step: nw.StepReport) -> None:
        seen.append(step.iteration)

    found = nw.train(tiny_scene, CONFIG, device=CPU, callbacks=[note])
    assert seen == [*range(1, 21)]
    *before, student = settings_of(CONFIG, OwnTeachers(2, 4, 240))
    files = [nw.train(tiny_scene, each, device=CPU).save(tmp_path / str(each.seed)) for each in before]
    teachers = [nw.load(file) for file in files]
    assert same(found, nw.train(tiny_scene, student, device=CPU, teachers=teachers))
    assert not same(found, nw.train(tiny_scene, student, device=CPU))
    # Models that are given take the place of its own teachers.
    alone = dataclasses.replace(CONFIG, teachers=0)
    given = nw.train(tiny_scene, CONFIG, device=CPU, teachers=teachers)
    assert same(given, nw.train(tiny_scene, alone, device=CPU, teachers=teachers))


@pytest.fixture(scope="module")
def command(tiny_folder: Path) -> Callable[..., list[str]]:
    """What makes the command of a training with two teachers."""

    def train(run: Path, *options: str, iterations: int = 20) -> list[str]:
        asked = ["--iterations", str(iterations), "--set", "teachers=2", *SMALL, *options]
        return ["train", str(tiny_folder), "--run", str(run), *asked]

    return train


@pytest.fixture(scope="module")
def finished(command: Callable[..., list[str]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with two teachers of 4 iterations and a student of 12; not to be changed."""
    run = tmp_path_factory.mktemp("runs") / "whole"
    assert cli.main(command(run)) == 0
    return run


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return shutil.copytree(finished, tmp_path / "run")


def model_of(run: Path) -> bytes:
    return (run / "model.safetensors").read_bytes()


def test_the_command_does_what_train_does(finished: Path, tiny_scene: nw.Scene, tmp_path: Path) -> None:
    expected = nw.train(tiny_scene, CONFIG, device=CPU)
    assert same(nw.load(finished), nw.load(expected.save(tmp_path)))


def test_fast_runs_are_shortened_in_python_and_by_the_command(
    tiny_folder: Path, tiny_scene: nw.Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "SHORTEST", 1)
    photos = len(tiny_scene.train)
    assert photos < CONFIG.iterations
    steps: list[nw.StepReport] = []
    nw.train(tiny_scene, dataclasses.replace(CONFIG, steps_a_photo=1, teachers=0), device=CPU, callbacks=[steps.append])
    assert len(steps) == photos
    run = tmp_path / "run"
    command = ["train", str(tiny_folder), "--run", str(run), "--preset", "fast", *SMALL]
    for asked in (["--set", "steps_a_photo=1"], ["--set", "steps_a_photo=1", "--resume"]):
        assert cli.main([*command, *asked]) == 0
        assert read_run(run).config.iterations == photos
    # Iterations that were typed are those of the run.
    for asked in (["--overwrite"], ["--resume"]):
        assert cli.main([*command, "--iterations", "20", *asked]) == 0
        assert read_run(run).config.iterations == 20


def test_a_teacher_is_a_run(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["iterations"] == 20 and metrics["teachers"] == 2 and "psnr" in metrics
    assert read_run(run).config.iterations == 20 and dataclasses.asdict(read_run(run).own) == OWN
    seeds, spent = {0}, 0.0
    for folder in (run / "teachers" / "1", run / "teachers" / "2"):
        facts = json.loads((folder / "metrics.json").read_text())
        assert facts["iterations"] == 4 and "psnr" not in facts and not has_checkpoint(folder)
        config = read_run(folder).config
        assert (config.iterations, config.max_surfels, config.teachers) == (4, 240, 0)
        seeds, spent = seeds | {config.seed}, spent + facts["seconds"]
        assert cli.main(["eval", str(folder), "--device", "cpu"]) == 0
        assert "psnr" in json.loads((folder / "metrics.json").read_text())
    assert len(seeds) == 3 and metrics["seconds"] > spent and not list_files(run)[1]


@pytest.mark.parametrize("lost", ["student", "teacher 2", "all"])
def test_a_run_resumes_in_each_stage(run, finished, command, capsys, lost):
    """With the bits of an uninterrupted one, whatever it still has to train; complete teachers stay as they are."""
    for name in (*CHECKPOINTS, "renders"):
        shutil.rmtree(run / name, ignore_errors=True)
    for name in ("model.safetensors", "metrics.json", "metrics.jsonl", "cameras.json"):
        (run / name).unlink()
    first = {"student": 3, "teacher 2": 2, "all": 1}[lost]
    for number in range(first, 3):
        if lost == "all":
            shutil.rmtree(run / "teachers" / str(number))
        else:  # without the file that is written last
            (run / "teachers" / str(number) / "metrics.json").unlink()
    before = [(run / "teachers" / str(number) / "model.safetensors").stat().st_mtime_ns for number in range(1, first)]
    capsys.readouterr()
    assert cli.main(command(run, "--resume")) == 0
    assert model_of(run) == model_of(finished)
    told = capsys.readouterr().out
    for number in (1, 2):
        assert (f"teacher {number} of 2: 4 iterations, at most 240 surfels, seed" in told) == (number >= first)
        assert (run / "teachers" / str(number) / "metrics.json").is_file()
    after = [(run / "teachers" / str(number) / "model.safetensors").stat().st_mtime_ns for number in range(1, first)]
    assert after == before


@pytest.mark.parametrize("stop", [6, 15])
def test_a_stopped_run_goes_on_where_it_was(finished, command, tmp_path, monkeypatch, stop):
    """Interrupted after some of its 20 steps, it takes only the others."""
    step, run = nw.Trainer.step, tmp_path / "run"
    taken: list[None] = []
    stops = [stop]

    def counted(trainer: nw.Trainer) -> nw.StepReport:
        if len(taken) in stops:
            raise KeyboardInterrupt
        taken.append(None)
        return step(trainer)

    monkeypatch.setattr(nw.Trainer, "step", counted)
    assert cli.main(command(run, "--checkpoint-every", "1")) == 130
    assert len(taken) == stop and not (run / "model.safetensors").exists()
    stops.clear()
    assert cli.main(command(run, "--resume")) == 0
    assert len(taken) == 20 and model_of(run) == model_of(finished)


def test_a_longer_run_keeps_its_teachers(run: Path, command: Callable[..., list[str]]) -> None:
    teachers = [(run / "teachers" / name / "model.safetensors").read_bytes() for name in "12"]
    assert cli.main(command(run, "--resume", iterations=30)) == 0
    assert json.loads((run / "metrics.json").read_text())["iterations"] == 30
    assert [(run / "teachers" / name / "model.safetensors").read_bytes() for name in "12"] == teachers
    assert read_run(run).config.iterations == 30 and dataclasses.asdict(read_run(run).own) == OWN


def test_overwriting_deletes_teachers_and_keeps_what_is_not_ours(run, command, capsys):
    for name in ("teachers/1/notes.txt", "teachers/9/model.safetensors", "teachers/mine.txt"):
        (run / name).parent.mkdir(exist_ok=True)
        (run / name).write_text("mine")
    assert sorted(list_files(run)[1]) == ["teachers/1/notes.txt", "teachers/9/model.safetensors", "teachers/mine.txt"]
    refused(capsys, command(run, "--overwrite", "--set", "teachers=0"), "teachers: expected it once")
    asked = ["--run", str(run), "--iterations", "5", *SMALL, "--overwrite"]
    assert cli.main(["train", read_run(run).source.path, *asked]) == 0
    left = {file.relative_to(run).as_posix() for file in (run / "teachers").rglob("*") if file.is_file()}
    assert left == {"teachers/1/notes.txt", "teachers/9/model.safetensors", "teachers/mine.txt"}
    assert not read_run(run).own.count


@pytest.mark.parametrize("kind", ["link", "file"])
def test_what_is_not_the_runs_is_not_taken_for_a_teacher(run, command, tmp_path, capsys, kind):
    place = run / "teachers"
    place.rename(tmp_path / "elsewhere")
    place.symlink_to(tmp_path / "elsewhere") if kind == "link" else place.write_text("mine")
    before = snapshot(tmp_path)
    message = f"{place}: expected a teacher's folder or nothing, got what nexwarp did not write"
    refused(capsys, command(run, "--overwrite"), message)
    assert snapshot(tmp_path) == before


def test_a_run_that_lost_a_teacher_says_so_before_it_trains(run, finished, command, capsys):
    shutil.rmtree(run / "teachers" / "2")
    message = f"{run}/teachers/2: expected the complete teacher that the student in {run} has learned from"
    refused(capsys, command(run, "--resume", iterations=30), message)
    assert read_run(run).config.iterations == 20 and not (run / "teachers" / "2").exists()
    shutil.copytree(finished / "teachers" / "1", run / "teachers" / "2")
    message = f"{run}/teachers/2: expected a teacher with the settings of {run}, got others"
    refused(capsys, command(run, "--resume"), message)


def test_memory_that_a_teacher_lacks_is_told_as_its_own(command, tmp_path, monkeypatch, capsys):
    """Its budget is not that of the run, so that lowering this may not help."""

    def fail(*_: object, **__: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB. And more")

    monkeypatch.setattr(trainer_module, "draw", fail)
    begin = "nexwarp: error: teacher 1 of 2: out of memory at iteration 1: it needed 2.50 GiB"
    end = ", or do without teachers (--set teachers=0)\n"
    refused(capsys, command(tmp_path / "run"), begin, "--max-surfels (now 240)", end)


def test_a_record_with_invalid_teachers_is_refused(tmp_path: Path) -> None:
    run = tmp_path / "run"
    create_run(run, RunRecord(SceneSource("demo"), CONFIG))
    for wrong in (
        {"count": 2},
        {"count": 9, "iterations": 4},
        {"count": 2, "iterations": 4, "max_surfels": 15},
        {"count": 2, "iterations": 10},  # all that the run has
        [2, 4],
    ):
        data = json.loads((run / "config.json").read_text()) | {"own_teachers": wrong}
        (run / "config.json").write_text(json.dumps(data))
        with pytest.raises(ValueError, match="own_teachers: expected"):
            read_run(run)
    (run / "config.json").write_text(json.dumps(data | {"own_teachers": None, "teachers": "abc"}))
    with pytest.raises(ValueError, match=r"teachers: expected a list of paths, got 'abc'"):
        read_run(run)
    data["own_teachers"] = {"count": 2, "iterations": 4, "of a newer version": 1}
    (run / "config.json").write_text(json.dumps(data))
    assert read_run(run).own == OwnTeachers(2, 4)  # of a run from before, whose teachers have its budget


def test_a_viewer_sees_all_steps(tiny_scene: nw.Scene, tmp_path: Path) -> None:
    """The model that it draws is that of the stage that runs, and the steps count to the run's iterations."""
    steps: list[int] = []

    class Shown:
        def between_steps(self, step: int, describe: Callable[[], str], stop: Callable[[], bool]) -> None:
            steps.append(step)
            drawn.append(runner.trainer.model().meta["iteration"])

    drawn: list[object] = []
    source, run = SceneSource(str(tiny_scene.path)), tmp_path / "run"
    record = RunRecord(source, CONFIG, own=OwnTeachers(2, 4, 240))
    session = Session(run, record, Console(quiet=True), Ranks.alone(CPU))
    session.viewer = Shown()  # type: ignore[assignment]
    runner = StageRunner(tiny_scene, CONFIG, CPU, session, own=record.own)
    create_run(run, record)
    runner.train()
    assert steps == [*range(1, 21)] and drawn == [1, 2, 3, 4, 1, 2, 3, 4, *range(1, 13)]


def test_the_time_left_is_that_of_all_stages(tiny_scene: nw.Scene, tmp_path: Path) -> None:
    """Before the first step, all steps and renderings are left; after the last one, those that finish and evaluate."""
    photos, tests = len(tiny_scene.train), len(tiny_scene.test)
    record = RunRecord(SceneSource(str(tiny_scene.path)), CONFIG, own=OwnTeachers(2, 4, 240))
    session = Session(tmp_path, record, Console(quiet=True), Ranks.alone(CPU))
    passes = (CONFIG.smooth_sh > 0) + CONFIG.footprints
    first, *_, last = divide(CONFIG, record.own)
    evaluation = VIEW_COST * (photos + tests)
    assert session.work_after(last, tiny_scene) == VIEW_COST * passes * photos + evaluation
    whole = first.config.iterations + session.work_after(first, tiny_scene)
    assert whole == CONFIG.iterations + VIEW_COST * 3 * passes * photos + evaluation
    assert time_left(90.0) == "90 s left in all" and time_left(1800.0) == "30 min left in all"
    assert time_left(3 * 3600 + 300) == "3 h 5 min left in all"
