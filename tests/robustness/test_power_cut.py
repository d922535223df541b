"""A power cut at any moment: the last whole checkpoint is never lost, and nothing is read that was not written.

What a run folder's real writers do is recorded, cut at any point, and put on a disk as a power cut may leave it. That
is read, and a later life of the run goes on from it, until the next cut.

The disk promises what POSIX does, and no more. The content of a file is on the disk after `fsync` of the file, and a
folder's entries are after `fsync` of the folder. Until then, each change may be there or not: of a file's content, the
new or the old one, a part, or zeros; of a folder's entries, any, in any order, but that an entry's changes keep
theirs. A rename within a folder happens as a whole or not at all.
"""

from __future__ import annotations

import builtins
import io
import itertools
import json
import os
import random
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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
from nexwarp.run.folder import LOG_FILE, RunRecord, claimed_run, create_run, read_metrics, read_run, remove_leftovers
from nexwarp.run.log import keep_lines
from nexwarp.train import checkpoint
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from nexwarp.train.recipe import Config
from tests.model_file_support import make_model
from tests.scenes import make_camera, random_scene

Numbers = set[int | None] | None  # None allows any, and what is damaged
Allowed = tuple[set[int | None], Numbers, Numbers]  # the run, the iteration of its checkpoint, the run of its model
DEMO = SceneSource("demo")
RUN = Path("runs") / "run"
REPLAYS = int(os.environ.get("NEXWARP_REPLAYS", "1000"))
CUTS_A_LIFE = 25
ROOT = 0  # node of the folder that is recorded
CALLS = ("open", "mkdir", "rename", "replace", "unlink", "remove", "rmdir")


# What happened: "data", of a file, its content; "entries", of a folder, those that changed, in one step, None where one
# is gone; "synced", a file's content or a folder's entries; "allow", what may be found from here on.
Operation = tuple[str, int, Any]


@dataclass
class Tree:
    """Files and folders: contents and entries by node."""

    files: dict[int, bytes] = field(default_factory=dict)
    folders: dict[int, dict[str, int | None]] = field(default_factory=lambda: {ROOT: {}})

    def write(self, target: Path, node: int = ROOT) -> None:
        """Make a folder of what can be reached."""
        target.mkdir()
        for name, inner in self.folders[node].items():
            if inner in self.folders:
                self.write(target / name, inner)
            elif inner is not None:
                (target / name).write_bytes(self.files.get(inner, b""))


class Recorder:
    """Compares a folder with what it was before each call to the file system.

    `start` is what was there in the beginning, all of it on the disk; `operations` is what has happened since, in
    order; `folders` are the nodes that are folders.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.operations: list[Operation] = []
        self.folders: set[int] = set()
        self._numbers = itertools.count(ROOT + 1)
        self._nodes = {root.stat().st_ino: ROOT}  # by inode, which a later file may get anew
        self.start = self._last = self._scan()

    def allow(self, run: set[int | None], checkpoint: Numbers, model: Numbers) -> None:
        """Note what may be found from this point of the record on."""
        self.look()
        self.operations.append(("allow", ROOT, (run, checkpoint, model)))

    def look(self) -> None:
        """Record what has changed."""
        now, before = self._scan(), self._last
        for node, entries in now.folders.items():
            old = before.folders.get(node, {})
            changes = {name: entries.get(name) for name in old | entries if old.get(name) != entries.get(name)}
            if changes:
                self.operations.append(("entries", node, changes))
        for node, content in now.files.items():
            if content != before.files.get(node, b""):
                self.operations.append(("data", node, content))
        self._last = now

    def synced(self, number: int) -> None:
        """Record that a file or folder is synced."""
        self.look()
        node = self._nodes.get(os.fstat(number).st_ino)
        if node is not None:  # else it is not below the folder
            self.operations.append(("synced", node, None))

    def _scan(self) -> Tree:
        tree, seen = Tree(), {self.root.stat().st_ino: ROOT}

        def node(path: str) -> int:
            inode = os.stat(path).st_ino
            if inode not in seen:
                seen[inode] = self._nodes[inode] if inode in self._nodes else next(self._numbers)
            return seen[inode]

        for place, folders, names in os.walk(self.root):
            entries = {name: node(os.path.join(place, name)) for name in (*folders, *names)}
            tree.folders[node(place)] = {**entries}
            for name in names:
                with _open(os.path.join(place, name), "rb") as file:
                    tree.files[entries[name]] = file.read()
        self._nodes = seen
        self.folders |= tree.folders.keys()
        return tree

    def recorded(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that looks before each of its calls."""

        def call(*args: Any, **kwargs: Any) -> Any:
            self.look()
            return original(*args, **kwargs)

        return call


_open = io.open


@contextmanager
def recorded(root: Path) -> Iterator[Recorder]:
    """Record what the block asks of the file system below a folder; syncing takes no time."""
    recorder = Recorder(root)
    with pytest.MonkeyPatch.context() as patch:
        for name in CALLS:
            patch.setattr(os, name, recorder.recorded(getattr(os, name)))
        opening = recorder.recorded(_open)
        patch.setattr(builtins, "open", opening)
        patch.setattr(io, "open", opening)
        patch.setattr(os, "fsync", recorder.synced)
        yield recorder
    recorder.look()


def after_power_cut(recorder: Recorder, moment: int, chance: random.Random) -> Tree:
    """Return one of the trees that a power cut after so many operations may leave."""
    operations = recorder.operations[:moment]
    latest, loss = moment, 0.3
    if chance.random() < 0.5:  # a disk that writes in order: what is there is all that was done up to a point
        last_sync = max((i for i, operation in enumerate(operations) if operation[0] == "synced"), default=0)
        latest, loss = chance.randint(last_sync, moment), 0.0
    contents = defaultdict(lambda: [b""], {node: [content] for node, content in recorder.start.files.items()})
    folders = {node: dict(recorder.start.folders.get(node, {})) for node in recorder.folders}
    waiting: dict[int, list[tuple[int, dict[str, int | None]]]] = defaultdict(list)
    for index, (kind, node, value) in enumerate(operations):
        if kind == "data" and index < latest:
            contents[node].append(value)
        elif kind == "entries":
            waiting[node].append((index, value))
        elif kind == "synced":
            contents[node] = contents[node][-1:]
            for _, changes in waiting.pop(node, []):
                folders[node].update(changes)
    for node, all_changes in waiting.items():
        lost: set[str] = set()
        for index, changes in all_changes:
            if index >= latest or chance.random() < loss or lost & changes.keys():
                lost |= changes.keys()
            else:
                folders[node].update(changes)
    return Tree({node: _surviving(versions, chance) for node, versions in contents.items()}, folders)


def _surviving(versions: list[bytes], chance: random.Random) -> bytes:
    """Return a content that a file may have, of which the first version alone is on the disk for certain."""
    i = chance.randrange(len(versions))
    if i == len(versions) - 1 or chance.random() < 0.3:
        return versions[i]
    old, new = versions[i], versions[i + 1]
    place = chance.randint(0, len(new))
    return chance.choice((new[:place] + chance.choice((b"", bytes(len(new) - place), old[place:])), bytes(len(new))))


def found_in(root: Path) -> list[Any]:
    """Return what a reader finds: a run, the iteration of its checkpoint, the run of its model; None where none is."""
    run = root / RUN

    def of_checkpoint() -> int:
        tensors, state = load_checkpoint(run)
        assert state["run"] == read_run(run).config.seed and tensors["x"].tolist() == [state["iteration"]] * 9
        return state["iteration"]

    found: list[Any] = []
    for read in (lambda: read_run(run).config.seed, of_checkpoint, lambda: nw.load(run).meta["iteration"]):
        try:
            found.append(read())
        except MissingError:
            found.append(None)
        except NexwarpError:
            found.append("damaged")
    return found


def live(root: Path, number: int, allow: Callable[..., None], chance: random.Random) -> None:
    """Go on with the run of a folder, or begin one with this number; the writers are those of a training."""
    run, before = root / RUN, found_in(root)
    known, last, model_of = before
    torn = "damaged" in before  # the run was being overwritten
    allow({known}, None if torn else {last}, None if torn else {model_of})
    overwrite = known is not None and (torn or chance.random() < 0.3)
    with claimed_run(run, DEMO, resume=known is not None and not overwrite, overwrite=overwrite) as resumed:
        if resumed:
            number = read_run(run).config.seed
            remove_leftovers(run)
        else:
            # While a run is overwritten, its config is still there when its files are no longer.
            allow({known, number}, None, None)
            create_run(run, RunRecord(DEMO, Config(seed=number)))
            last = model_of = None
            allow({number}, {None}, {None})
        first = int(last or 0)
        keep_lines(run / LOG_FILE, first)
        with (run / LOG_FILE).open("a", encoding="utf-8") as log:
            for iteration in range(first + 1, first + chance.randint(2, 5)):
                log.write(json.dumps({"iteration": iteration}) + "\n")
                log.flush()
                allow({number}, {last, iteration}, {model_of})
                save_checkpoint(run, {"x": torch.full((9,), float(iteration))}, {"iteration": iteration, "run": number})
                last = iteration
                allow({number}, {last}, {model_of})
        model = make_model(4)
        model.meta["iteration"] = number
        allow({number}, {last}, {model_of, number})
        save_model(run, model)
        allow({number}, {last}, {number})
        save_cameras(run / CAMERAS_FILE, {"train": {"a": make_camera(random_scene(4))}, "test": {}})
        write_json(run / folder.METRICS_FILE, {"psnr": 20.0})


def check(root: Path, allowed: Allowed) -> None:
    """Fail unless a folder holds what is allowed; reading it never fails otherwise than with an error of ours."""
    run, found = root / RUN, found_in(root)
    assert all(numbers is None or value in numbers for value, numbers in zip(found, allowed, strict=True)), found
    assert found[2] in (None, found[0]), "the model is the run's"
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
    done = met = 0
    while done < count:
        with recorded(root) as recorder:
            live(root, done + 1, recorder.allow, chance)
        shutil.rmtree(root)
        for number in range(done + 1, min(done + CUTS_A_LIFE, count) + 1):
            moment = chance.randint(1, len(recorder.operations))
            allowed = [value for kind, _, value in recorder.operations[:moment] if kind == "allow"][-1]
            met += allowed[1] is not None and None not in allowed[1]
            root = folder / str(number)
            after_power_cut(recorder, moment, chance).write(root)
            check(root, allowed)
            if number % CUTS_A_LIFE and number < count:
                shutil.rmtree(root)
        done = number  # the next life goes on from the last cut
    return met


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
