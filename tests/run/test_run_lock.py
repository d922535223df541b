import errno
import fcntl
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from nexwarp.cli import main as cli
from nexwarp.errors import RunError, StorageError
from nexwarp.run.folder import locked_run
from tests.subprocesses import environment

HOLD = """
import os, sys, time
from pathlib import Path
from nexwarp.run.folder import locked_run
with locked_run(Path(sys.argv[1])):
    child = os.fork()
    if child:
        print(child, flush=True)
    time.sleep(600)
"""


@pytest.fixture(scope="module")
def holder(tmp_path_factory) -> Iterator[tuple[Path, subprocess.Popen[str], int]]:
    """A run folder, the process that holds its lock, and a child that it has forked meanwhile."""
    run = tmp_path_factory.mktemp("held") / "run"
    command = [sys.executable, "-W", "ignore", "-c", HOLD, str(run)]
    with subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        try:
            yield run, process, child
        finally:
            process.kill()
            os.kill(child, signal.SIGKILL)


def refused_by(run: Path) -> str:
    with pytest.raises(RunError) as caught, locked_run(run):
        pytest.fail("two hold the lock")
    return str(caught.value)


def test_commands_name_the_process_that_is_at_work(holder, tmp_path, capsys):
    """Nothing is written, whatever the command; what only reads, or writes files of its own, needs no lock."""
    run, process, _ = holder
    scene = ["train", "demo", "--run", str(run), "--iterations", "2", "--device", "cpu"]
    assert [f.name for f in run.iterdir()] == ["run.lock"] and cli.main(scene) == 2
    line = capsys.readouterr().err
    expected = re.escape(f"nexwarp: error: {run}: expected a run folder that no other process writes to, but process ")
    since = r"since \d{4}-\d\d-\d\d \d\d:\d\d:\d\d[+-]\d\d:\d\d, does; wait until it ends, or give another run folder\n"
    assert re.fullmatch(rf"{expected}{process.pid} on \S+, {since}", line), line
    (run / "config.json").write_text('{"scene": {"path": "demo", "downscale": 1}, "config": {}}')
    for command in ([*scene, "--resume"], [*scene, "--overwrite"], ["eval", str(run), "--device", "cpu"]):
        assert cli.main(command) == 2
        assert f"process {process.pid} on " in capsys.readouterr().err
    assert cli.main(["info", str(run)]) == 0
    assert sorted(f.name for f in run.iterdir()) == ["config.json", "run.lock"]
    (run / "config.json").unlink()


def test_a_kill_releases_the_lock_although_a_forked_child_lives(holder):
    run, process, child = holder
    refused_by(run)
    process.kill()
    process.wait()
    os.kill(child, 0)  # it lives
    assert (run / "run.lock").exists()
    with locked_run(run):
        assert f"process {os.getpid()} on " in refused_by(run)
    assert list(run.iterdir()) == []


@pytest.fixture
def flock_fails(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Let the system refuse locks with an error."""

    def fail_with(number: int) -> None:
        def fail(*_: int) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(fcntl, "flock", fail)

    return fail_with


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS])
def test_a_file_system_without_locks_is_told_and_used(tmp_path, flock_fails, number):
    flock_fails(number)
    with (
        pytest.warns(UserWarning, match=f"its file system has no locks .{os.strerror(number)}.: "),
        locked_run(tmp_path),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_link_at_the_place_of_the_lock_is_not_followed(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("years of work")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.lock").symlink_to(precious)
    with pytest.raises(StorageError, match=r"run\.lock: cannot be written"), locked_run(tmp_path / "run"):
        pass
    assert precious.read_text() == "years of work"
