"""Random lives of run folders: trained, killed, resumed, overwritten, exported, copied, damaged, written to by others.

Whatever comes: a finished model stays readable, no foreign file is touched, one command gives the same bytes, and what
fails says so with an error of ours. Trainings are real ones, of few steps on a tiny scene; kills come at a random call
of the file system (test_kills.py has SIGKILL). `NEXWARP_RUNS=5000 pytest -m slow test_run_machine.py` has 5,000 lives.
"""

import dataclasses
import io
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)
from rich.console import Console

from nexwarp.cli.train import Train
from nexwarp.data.scene import SceneSource
from nexwarp.errors import NexwarpError, RunError
from nexwarp.io.files import is_temporary
from nexwarp.kernels import launch
from nexwarp.model.model_file import load
from nexwarp.run.export import ExportOrder, export_run
from nexwarp.run.folder import LOCK_FILE, read_run
from nexwarp.run.opened import open_model
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from nexwarp.train.trainer import Trainer
from tests.faults import Killed, kill_at
from tests.scene_writers import write_demo

SMALL = Config(
    texture=TextureConfig(levels=2, table_size=2**6, width=8),
    densify=DensifyConfig(every=2),
    sh_degree=1,
    exposures=False,
    smooth_sh=0.0,
    footprints=False,
)
RUNS = int(os.environ.get("NEXWARP_RUNS", "1000"))
ROOT = Path(__file__).parents[2]
CHECKPOINT_FILES = [f"checkpoint{age}/{file}" for age in ("", ".old") for file in ("state.json", "tensors.safetensors")]
DAMAGED = ["config.json", "model.safetensors", "metrics.jsonl", "cameras.json", *CHECKPOINT_FILES]
NOTES = ["checkpoint/notes.txt", "checkpoint.old/notes.txt"]
FOREIGN = ["notes.txt", "renders/mine.png", "export/a.obj", "mine/config.json", *NOTES]

names = st.sampled_from("aaab")
seeds = st.sampled_from([0, 1])
flags = st.sampled_from(["resume", "overwrite", ""])


def train(scene: Path, run: Path, seed: int | None, flag: str) -> None:
    """Train as the command line does; a resumed run has the seed of its own."""
    resume, overwrite = flag == "resume", flag == "overwrite"
    command = Train(
        SceneSource(str(scene)), run=run, device="cpu", checkpoint_every=1, resume=resume, overwrite=overwrite
    )
    if not resume:
        command = dataclasses.replace(command, iterations=4, max_surfels=24, seed=seed)
    command(Console(file=io.StringIO()))


@dataclass
class Slot:
    """What is known of a run folder."""

    finished: bool = False  # a training has come to its end, and nothing has begun to overwrite the run since
    torn: bool = False  # an overwriting was killed, which may have deleted parts of the run
    damaged: set[str] = field(default_factory=set)  # names of files damaged since the last complete training
    foreign: dict[str, bytes] = field(default_factory=dict)  # contents of the files that nexwarp did not write


class RunFolders(RuleBasedStateMachine):
    """Two run folders, and all that may happen to them."""

    base: ClassVar[Path]
    scene: ClassVar[Path]
    expected: ClassVar[dict[int, bytes]]

    def __init__(self) -> None:
        super().__init__()
        self.root = Path(tempfile.mkdtemp(dir=self.base))
        self.slots = {"a": Slot(), "b": Slot()}

    def teardown(self) -> None:
        shutil.rmtree(self.root)

    @initialize(seed=seeds)
    def begin_with_a_finished_run(self, seed: int) -> None:
        shutil.copytree(self.base / f"whole{seed}", self.root / "a")
        self.slots["a"].finished = True

    # Trainings

    @rule(name=names, seed=seeds, flag=flags)
    def train(self, name: str, seed: int, flag: str) -> None:
        self._train(name, seed, flag, lambda run: train(self.scene, run, seed, flag))

    @rule(name=names, seed=seeds, flag=flags, moment=st.integers(0, 120))
    def killed(self, name: str, seed: int, flag: str, moment: int) -> None:
        def work(run: Path) -> None:
            with pytest.MonkeyPatch.context() as patch:
                kill_at(patch, moment)
                train(self.scene, run, seed, flag)

        self._train(name, seed, flag, work)

    @rule(name=names, seed=seeds, flag=flags, second=flags)
    def two_at_once(self, name: str, seed: int, flag: str, second: str) -> None:
        """A second training of the folder is refused whatever its flags, and changes nothing of the first."""
        step = Trainer.step
        intruded: list[str] = []

        def work(run: Path) -> None:
            def intrude(trainer: Trainer) -> Any:
                if not intruded:
                    intruded.append(second)
                    before = snapshot(run)
                    with pytest.raises(RunError):
                        train(self.scene, run, seed, second)
                    assert snapshot(run) == before
                return step(trainer)

            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(Trainer, "step", intrude)
                train(self.scene, run, seed, flag)

        self._train(name, seed, flag, work)

    def _train(self, name: str, seed: int, flag: str, work: Callable[[Path], None]) -> None:
        run, slot = self.root / name, self.slots[name]
        before, refusal = snapshot(run), self._refusal(name, flag)
        try:
            work(run)
        except Killed:
            if refusal is True:
                assert without_aside(snapshot(run)) == without_aside(before)
            elif flag == "overwrite" and before:  # the kill may have left anything undeleted
                slot.torn, slot.finished = True, False
            assert self._seed(name) in ({seed, None} if not before else {seed, self._seed_in(before)})
            return
        except NexwarpError:
            assert refusal is not False
            assert without_aside(snapshot(run)) == without_aside(before)
            return
        assert refusal is not True
        slot.finished, slot.torn, slot.damaged = True, False, set()
        assert flag == "resume" or self._seed(name) == seed
        assert not [n for n in snapshot(run) if is_aside(n) and n.split("/")[0] not in ("renders", "export")]

    def _refusal(self, name: str, flag: str) -> bool | None:
        """Whether a training must be refused; None if it may be."""
        run, slot = self.root / name, self.slots[name]
        folders = any(f.is_dir() and not is_aside(f.name) for f in run.glob("*"))
        if not folders and all(is_aside(n) for n in snapshot(run)):
            return flag == "resume" and not run.exists()
        if flag == "":
            return True
        if self._seed(name) is None:
            return True
        if flag == "overwrite":
            return False
        return None if slot.torn or any(n.startswith("checkpoint") for n in slot.damaged) else False

    def _seed(self, name: str) -> int | None:
        """Return the seed that a folder's config has; None if it has none that can be read."""
        try:
            return read_run(self.root / name).config.seed
        except NexwarpError:
            return None

    def _seed_in(self, files: dict[str, bytes]) -> int | None:
        with tempfile.TemporaryDirectory(dir=self.root) as folder:
            (Path(folder) / "config.json").write_bytes(files.get("config.json", b""))
            return self._seed(Path(folder).name)

    # What else happens to folders

    @rule(name=names, kind=st.sampled_from(["ply", "cameras"]))
    def export(self, name: str, kind: str) -> None:
        slot = self.slots[name]
        try:
            for file in export_run(open_model(self.root / name), ExportOrder(kind)):
                assert file.stat().st_size > 0
        except NexwarpError:
            assert not slot.finished or slot.damaged

    @rule(name=names)
    def copy(self, name: str) -> None:
        other = "ab"[name == "a"]
        if (self.root / name).exists() and not (self.root / other).exists():
            shutil.copytree(self.root / name, self.root / other, symlinks=True)
            self.slots[other] = dataclasses.replace(
                self.slots[name], damaged=set(self.slots[name].damaged), foreign=dict(self.slots[name].foreign)
            )

    @rule(name=names)
    def remove(self, name: str) -> None:
        if (self.root / name).exists():
            shutil.rmtree(self.root / name)
        self.slots[name] = Slot()

    @rule(name=names, file=st.sampled_from(DAMAGED), how=st.sampled_from(["gone", "empty", "half", "zeros"]))
    def damage(self, name: str, file: str, how: str) -> None:
        path = self.root / name / file
        if not path.is_file():
            return
        content = path.read_bytes()
        if how == "gone":
            path.unlink()
        else:
            path.write_bytes({"empty": b"", "half": content[: len(content) // 2], "zeros": bytes(len(content))}[how])
        self.slots[name].damaged.add(file)

    @rule(name=names, files=st.lists(st.sampled_from(FOREIGN), min_size=2), number=st.integers(0, 9))
    def add_foreign(self, name: str, files: list[str], number: int) -> None:
        run = self.root / name
        for file in files:
            if run.is_dir() and not (run / file).exists():
                (run / file).parent.mkdir(parents=True, exist_ok=True)
                content = f"{file} {number}".encode()
                (run / file).write_bytes(content)
                self.slots[name].foreign[file] = content

    # What holds at all times

    @invariant()
    def models_are_those_of_undisturbed_runs(self) -> None:
        for name, slot in self.slots.items():
            run, seed = self.root / name, self._seed(name)
            model = run / "model.safetensors"
            if "model.safetensors" not in slot.damaged and seed is not None:
                assert not slot.finished or model.is_file()
                if model.is_file():
                    assert model.read_bytes() == self.expected[seed]
                    load(run)

    @invariant()
    def foreign_files_are_untouched(self) -> None:
        for name, slot in self.slots.items():
            files = snapshot(self.root / name)
            for file, content in slot.foreign.items():
                if file.startswith("checkpoint"):  # its folder is renamed from save to save
                    assert content in [c for n, c in files.items() if n.startswith("checkpoint")], file
                else:
                    assert files[file] == content


def snapshot(folder: Path) -> dict[str, bytes]:
    """Contents of all files; links are not followed."""
    files = [Path(top) / name for top, _, names in os.walk(folder) for name in names]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def without_aside(files: dict[str, bytes]) -> dict[str, bytes]:
    return {name: content for name, content in files.items() if not is_aside(name)}


def is_aside(name: str) -> bool:
    """Whether a file is a lock, or incomplete: what a killed process leaves."""
    return name == LOCK_FILE or any(is_temporary(part) for part in name.split("/"))


@pytest.mark.usefixtures("small_preset", "restore_launch_threads")
@pytest.mark.parametrize("count", [5, pytest.param(RUNS, marks=[pytest.mark.slow, pytest.mark.timeout(0)])])
def test_random_lives_of_run_folders(tmp_path, monkeypatch, count):
    monkeypatch.setattr(os, "fsync", lambda _: None)
    launch.set_num_threads(1)  # does not wait for others on a busy machine
    scene = write_demo(tmp_path / "scene", width=24, height=18, views=4, points=100)
    expected = {}
    for seed in (0, 1):
        train(scene, tmp_path / f"whole{seed}", seed, "")
        expected[seed] = (tmp_path / f"whole{seed}" / "model.safetensors").read_bytes()
    assert expected[0] != expected[1]

    class Machine(RunFolders):
        pass

    Machine.base, Machine.scene, Machine.expected = tmp_path, scene, expected
    run_state_machine_as_test(
        Machine,
        settings=settings(
            max_examples=count,
            stateful_step_count=10,
            deadline=None,
            database=None,
            derandomize=count != RUNS,
            phases=[Phase.generate],  # ten steps can be read; a shorter life takes minutes to find
            suppress_health_check=list(HealthCheck),
        ),
    )
