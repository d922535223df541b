"""A disk that is full or fails, at every single write: one clear line, nothing lost that was saved, nothing half."""

import errno
import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.io.pictures import load_exr
from nexwarp.train.checkpoint import _read_checkpoint
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from tests.cli.support import refused, snapshot
from tests.faults import Disk, failing
from tests.scene_writers import write_demo
from tests.subprocesses import run_python

pytestmark = pytest.mark.usefixtures("small_preset")

# Nothing is written while exposures are estimated, SH smoothed and detail limits found, which would take most of such a
# short training.
TINY = {"texture": TextureConfig(levels=2, table_size=2**6, width=8), "densify": DensifyConfig(every=2)}
SMALL = Config(exposures=False, smooth_sh=0.0, footprints=False, sh_degree=1, **TINY)  # type: ignore[arg-type]
FLAGS = ["--iterations", "2", "--max-surfels", "24", "--device", "cpu", "--checkpoint-every", "1"]
FULL, BROKEN = errno.ENOSPC, errno.EIO


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return write_demo(tmp_path_factory.mktemp("scenes") / "tiny", width=24, height=18, views=4, points=100)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "tiny"
    assert cli.main(["train", str(scene), "--run", str(run), *FLAGS]) == 0
    return run


def whole_checkpoints(run: Path) -> list[int]:
    """Iterations of the checkpoints that are there; none may be damaged."""
    folders = [run / name for name in ("checkpoint", "checkpoint.old", "checkpoint.older")]
    return [_read_checkpoint(folder)[1]["iteration"] for folder in folders if folder.is_dir()]


def whole(file: Path) -> bool:
    """Whether a file can be read; True for one of a kind that nexwarp does not read."""
    readers: dict[str, Callable[[Path], object]] = {
        ".json": lambda path: json.loads(path.read_bytes()),
        ".png": lambda path: Image.open(path).load(),
        ".exr": load_exr,
        ".safetensors": lambda path: nw.load(path) if path.stem != "tensors" else _read_checkpoint(path.parent),
    }
    try:
        readers.get(file.suffix, str)(file)
    except (OSError, ValueError, RuntimeError, SyntaxError):
        return False
    return True


def check_whole(folder: Path) -> None:
    """Fail if any file below a folder is half-written, or a temporary one."""
    assert all(whole(folder / name) and ".tmp" not in name for name in snapshot(folder))
    whole_checkpoints(folder)


def every_fault(run: Path, command: list[str], both: bool = False) -> list[Disk]:
    """Disks that fail one request of a command after the other: a full one all that follow, too.

    Full and broken ones take turns; with `both` each request meets both.
    """
    with failing(Disk(run)) as counted:
        assert cli.main(command) == 0
    places = range(len(counted.requests))
    numbers = {place: (FULL, BROKEN) if both else ((FULL, BROKEN)[place % 2],) for place in places}
    return [Disk(run, place, number, number == FULL) for place in places for number in numbers[place]]


@pytest.mark.parametrize("both", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_training_survives_every_fault_of_its_disk(trained, scene, tmp_path, capsys, both):
    """What was saved stays, whatever fails; with --resume, on a disk that works again, the end is the same."""
    expected = (trained / "model.safetensors").read_bytes()
    run = tmp_path / "run"
    command = ["train", str(scene), "--run", str(run), *FLAGS]
    disks = every_fault(run, command, both)
    assert len(disks) > 50
    for disk in disks:
        shutil.rmtree(run, ignore_errors=True)
        with failing(disk):
            refused(capsys, command, os.strerror(disk.number))
        assert disk.fatal is not None
        where = disk.requests[disk.fatal]
        if not run.exists():
            assert disk.fatal < 8, where  # the config
            continue
        check_whole(run)
        kept = whole_checkpoints(run)
        saved = [r for r in disk.requests[: disk.fatal] if r == "rename checkpoint"]
        assert len(kept) >= min(len(saved), 2) and (not saved or kept[0] >= len(saved)), where
        if both or disk.fatal % 9 == 0:
            assert cli.main(["train", str(scene), "--run", str(run), *FLAGS, "--resume"]) == 0, where
            assert (run / "model.safetensors").read_bytes() == expected, where
            check_whole(run)


def test_a_full_disk_still_gets_the_model_when_it_has_room_for_that(scene, tmp_path, capsys):
    """A checkpoint is three times as large."""
    run = tmp_path / "run"
    command = ["train", str(scene), "--run", str(run), *FLAGS]
    with failing(Disk(run)) as counted:
        assert cli.main(command) == 0
    second = [i for i, r in enumerate(counted.requests) if r.startswith("write .tensors")][1]
    shutil.rmtree(run)
    words = ("No space left", "training stops at iteration 2", "the current model is saved", "--resume")
    with failing(Disk(run, second, FULL)):
        refused(capsys, command, *words)
    assert nw.load(run).meta["iteration"] == 2 and whole_checkpoints(run) == [1]


@pytest.mark.parametrize(
    "arguments",
    [
        ["eval", "{run}", "--device", "cpu"],
        ["export", "{run}", "--out", "{run}/out"],
        ["export", "{run}", "--format", "cameras", "--out", "{run}/out"],
        ["render", "{run}", "--set", "test", "--buffers", "--device", "cpu"],
    ],
    ids=["eval", "export", "cameras", "render"],
)
def test_other_commands_survive_every_fault(trained, tmp_path, capsys, arguments):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    command = [argument.format(run=run) for argument in arguments]
    before = snapshot(run)
    disks = every_fault(run, command)
    assert len(disks) >= 4
    after = snapshot(run)
    for disk in disks:
        shutil.rmtree(run)
        shutil.copytree(trained, run)
        with failing(disk):
            refused(capsys, command, os.strerror(disk.number))
        check_whole(run)
        now = snapshot(run)
        assert before.keys() <= now.keys() <= after.keys()
        assert all(now[name] in (before.get(name), after[name]) for name in now)


# Libraries in C, whose requests no test can count, meet a limit on the size of each file

LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
from nexwarp.cli.main import main
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there are no limits of resources")
@pytest.mark.parametrize(
    ("arguments", "size"),
    [
        (["render", "{run}", "--set", "test", "--buffers"], 6000),
        (["render", "{run}", "--video", "{run}/out.mp4", "--frames", "4", "--scale", "8"], 4000),
        (["export", "{run}", "--out", "{run}/out"], 100),
    ],
    ids=["OpenEXR", "FFmpeg", "PLY"],
)
def test_a_file_that_grows_too_large_is_one_line_and_leaves_nothing_half(trained, tmp_path, arguments, size):
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    done = run_python("-c", LIMITED, size, *[argument.format(run=run) for argument in arguments], "--device", "cpu")
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("nexwarp: error: ") and "cannot be written" in done.stderr
    check_whole(run)
