"""A power cut at any moment: the last whole checkpoint is never lost, and nothing is read that was not written.

What a run folder's real writers do is recorded, cut at any point, and put on a disk as a power cut may leave it
(tests/power_cut.py). That is read, and a later life of the run goes on from it, until the next cut.
"""

import json
import os
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.cameras_file import CAMERAS_FILE, load_cameras, save_cameras
from nexwarp.data.scene import SceneSource
from nexwarp.errors import MissingError, NexwarpError
from nexwarp.io import files
from nexwarp.io.json_files import write_json
from nexwarp.model.model_file import save_model
from nexwarp.run import folder
from nexwarp.run.folder import (
    CONFIG_FILE,
    LOG_FILE,
    METRICS_FILE,
    RunRecord,
    claimed_run,
    create_run,
    read_metrics,
    read_run,
    remove_leftovers,
)
from nexwarp.run.log import _open_log, keep_lines
from nexwarp.train import checkpoint
from nexwarp.train.checkpoint import has_checkpoint, load_checkpoint, save_checkpoint
from nexwarp.train.recipe import Config
from tests.model_file_support import make_model
from tests.power_cut import Mark, Recorder, after_power_cut, recorded
from tests.scenes import make_camera, random_scene

DEMO = SceneSource("demo")
RUN = Path("runs") / "run"
REPLAYS = int(os.environ.get("NEXWARP_REPLAYS", "1000"))
CUTS_A_LIFE = 25


@dataclass
class Promise:
    """What a run folder must hold after a power cut; None among numbers is none."""

    runs: set[int | None] = field(default_factory=lambda: {None})  # numbers of the runs that it may be
    run: int | None = None  # the newest run whose config was written
    least: int | None = None  # iteration of the newest checkpoint of that run whose writing returned
    most: int | None = None  # iteration of the newest checkpoint that was begun
    models: set[int | None] = field(default_factory=lambda: {None})  # numbers of the runs whose model may be there
    torn: bool = False  # the run was being overwritten, and has lost files by that

    def after(self, recorder: Recorder, moment: int) -> "Promise":
        """Return the promise after so many operations."""
        now = replace(self, runs=set(self.runs), models=set(self.models))
        for operation in recorder.operations[:moment]:
            if isinstance(operation, Mark):
                now._note(*operation.label)
        return now

    def _note(self, what: str, number: int) -> None:
        if what == "create":
            self.runs.add(number)
        elif what == "created":
            vars(self).update(vars(Promise(runs={number}, run=number)))
        elif what == "save":
            self.most = number
        elif what == "saved":
            self.least = number
        elif what == "write model":
            self.models.add(number)
        else:
            self.models = {number}


def live(root: Path, number: int, mark: Callable[[str, int], None], chance: random.Random) -> None:
    """Go on with the run of a folder, or begin one with this number; the writers are those of a training."""
    run = root / RUN
    known = (run / CONFIG_FILE).is_file()
    overwrite = known and (chance.random() < 0.3 or found_in(root).torn)
    with claimed_run(run, DEMO, resume=known and not overwrite, overwrite=overwrite) as resumed:
        first = 0
        if resumed:
            number = read_run(run).config.seed
            remove_leftovers(run)
            first = load_checkpoint(run)[1]["iteration"] if has_checkpoint(run) else 0
        else:
            mark("create", number)
            create_run(run, RunRecord(DEMO, Config(seed=number)))
            mark("created", number)
        keep_lines(run / LOG_FILE, first)
        with _open_log(run / LOG_FILE) as log:
            for iteration in range(first + 1, first + chance.randint(2, 5)):
                log.write(json.dumps({"iteration": iteration}) + "\n")
                log.flush()
                mark("save", iteration)
                save_checkpoint(run, {"x": torch.full((9,), float(iteration))}, {"iteration": iteration, "run": number})
                mark("saved", iteration)
        model = make_model(4)
        model.meta["iteration"] = number
        mark("write model", number)
        save_model(run, model)
        mark("wrote model", number)
        save_cameras(run / CAMERAS_FILE, {"train": {"a": make_camera(random_scene(4))}, "test": {}})
        write_json(run / METRICS_FILE, {"psnr": 20.0})


def check(root: Path, promise: Promise) -> None:
    """Fail unless a folder keeps what was promised; reading it never fails otherwise than with an error of ours."""
    run = root / RUN
    try:
        number: int | None = read_run(run).config.seed
    except MissingError:
        number = None
    assert number in promise.runs
    # While a run is overwritten, its config is still there when its files are no longer.
    overwritten = promise.torn or len(promise.runs) > 1
    least, most = (None, None) if number != promise.run else (promise.least, promise.most)
    try:
        tensors, state = load_checkpoint(run)
        assert state["run"] == number and tensors["x"].tolist() == [state["iteration"]] * 9
        assert most is not None and (1 if overwritten else least or 1) <= state["iteration"] <= most
    except NexwarpError as error:
        assert overwritten or (least is None and isinstance(error, MissingError)), error
    try:
        assert number_of(run) in (promise.models if number == promise.run else {None})
    except MissingError:
        assert overwritten or None in promise.models
    read_metrics(run)
    if (run / CAMERAS_FILE).exists():
        load_cameras(run)
    keep_lines(run / LOG_FILE, 10**6)
    if (run / LOG_FILE).exists():
        assert all(json.loads(line)["iteration"] > 0 for line in (run / LOG_FILE).read_text().splitlines())


@pytest.fixture(autouse=True)
def no_wait(monkeypatch):
    """Nothing waits for the disk of this machine."""
    monkeypatch.setattr(os, "fsync", lambda _: None)


def replay(folder: Path, count: int, seed: int = 0) -> int:
    """Cut the power so many times, several times in each life of a run; return how often there was a checkpoint."""
    chance = random.Random(seed)
    root = folder / "0"
    root.mkdir()
    promise, done, met = Promise(), 0, 0
    while done < count:
        with recorded(root) as recorder:
            live(root, done + 1, recorder.mark, chance)
        shutil.rmtree(root)
        for number in range(done + 1, min(done + CUTS_A_LIFE, count) + 1):
            moment = chance.randint(0, len(recorder.operations))
            kept = promise.after(recorder, moment)
            met += kept.least is not None
            root = folder / str(number)
            after_power_cut(recorder, moment, chance).write(root)
            check(root, kept)
            if number % CUTS_A_LIFE and number < count:
                shutil.rmtree(root)
        done, promise = number, found_in(root)  # the next life goes on from the last cut
    return met


def found_in(root: Path) -> Promise:
    """Return what a folder promises that nothing is being written to."""
    run, found = root / RUN, Promise()
    if (run / CONFIG_FILE).exists():
        found.run = read_run(run).config.seed
        found.runs = {found.run}
    try:
        found.least = found.most = load_checkpoint(run)[1]["iteration"]
    except NexwarpError as error:
        found.torn = not isinstance(error, MissingError)
    if (run / "model.safetensors").exists():
        found.models = {number_of(run)}
    return found


def number_of(run: Path) -> int:
    """Return the number of the run that a model is of."""
    number = nw.load(run).meta["iteration"]
    assert isinstance(number, int)
    return number


@pytest.mark.parametrize("count", [50, pytest.param(REPLAYS, marks=pytest.mark.slow)])
def test_no_power_cut_loses_a_whole_checkpoint(tmp_path, count):
    """`NEXWARP_REPLAYS=5000 pytest -m slow tests/robustness/test_power_cut.py` cuts the power 5,000 times."""
    assert replay(tmp_path, count) > count // 4


@pytest.mark.parametrize(
    ("module", "synced"),
    [
        (files, "a file before its rename"),
        (files, "the folder after it"),
        (files, "the folder of a new folder"),
        (checkpoint, "the run folder after its checkpoints' renames"),
        # Shows only where the power goes between the new config's rename and the flush of its folder.
        pytest.param(folder, "the run folder before its new config", marks=pytest.mark.slow),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_the_replays_find_a_missing_sync(tmp_path, monkeypatch, module, synced):
    """Each flush is needed: without it, some power cut loses something, though 500 of them may not."""
    sync = files.sync

    def forgetful(path: Path) -> None:
        kept = {
            "a file before its rename": path.is_dir(),
            "the folder after it": not path.is_dir() or path.name == "runs",
            "the folder of a new folder": path.name not in ("runs", "0"),
        }
        if kept.get(synced, False):
            sync(path)

    monkeypatch.setattr(module, "sync", forgetful)
    with pytest.raises((AssertionError, NexwarpError)):
        for seed in range(100):
            (tmp_path / str(seed)).mkdir()
            replay(tmp_path / str(seed), 500, seed)
