import os
import shutil
import threading

import pytest
import torch

from nexwarp.errors import StorageError
from nexwarp.io import files
from nexwarp.io.files import is_temporary, temporary_name, write_atomically, write_together
from nexwarp.run.folder import keep_camera_path
from nexwarp.run.log import _open_log
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from tests.faults import Disk, failing
from tests.scenes import make_camera, random_scene


def test_temporary_names_are_unpredictable_and_known_again(tmp_path):
    names = {temporary_name(tmp_path / "a.b.json").name for _ in range(100)}
    assert len(names) == 100 and all(is_temporary(name) and name.endswith(".tmp.json") for name in names)
    assert is_temporary(temporary_name(tmp_path / "checkpoint").name)
    others = (".a.12.tmp.json", ".notes.tmp", "a.12-0123456789abcdef.tmp", ".a.12-0123456789abcde.tmp", ".a.tmp.b.c")
    assert not any(is_temporary(name) for name in others)


def test_links_are_not_written_through(tmp_path, monkeypatch):
    """Neither one under an old predictable name, nor under a temporary one if it were known, nor at a log's place."""
    precious, run = tmp_path / "precious", tmp_path / "run"
    precious.write_text("years of work")
    run.mkdir()
    trap = run / ".file.1-0000000000000000.tmp"
    for link in (run / f".config.{os.getpid()}.tmp.json", run / "metrics.jsonl", trap):
        link.symlink_to(precious)
    (run / "checkpoint.tmp").symlink_to(tmp_path / "elsewhere")
    write_atomically(run / "config.json", b"{}")
    save_checkpoint(run, {"x": torch.ones(1)}, {"iteration": 1})
    assert (run / "config.json").read_bytes() == b"{}" and load_checkpoint(run)[1] == {"iteration": 1}
    with pytest.raises(OSError, match="symbolic links"):
        _open_log(run / "metrics.jsonl")
    monkeypatch.setattr(files, "temporary_name", lambda _: trap)
    with pytest.raises(StorageError, match="File exists"):
        write_atomically(run / "file", b"new")
    assert precious.read_text() == "years of work" and not (tmp_path / "elsewhere").exists()


def test_long_names_leave_room_for_what_a_temporary_name_adds(tmp_path):
    for stem in ("n" * 250, "é" * 125):
        write_atomically(tmp_path / f"{stem}.png", b"")
    assert len(os.listdir(tmp_path)) == 2


def test_camera_paths_of_viewers_at_the_same_time_all_stay(tmp_path):
    camera = make_camera(random_scene(1))
    threads = [threading.Thread(target=keep_camera_path, args=(tmp_path, [camera])) for _ in range(40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(list(tmp_path.iterdir())) == 40 and all(file.stat().st_size for file in tmp_path.iterdir())


def test_files_written_together_are_all_there_or_none(tmp_path):
    """A new folder is gone, and older files stay, as long as the disk has not stored all new ones."""
    folder = tmp_path / "page"
    contents = {folder / "index.html": b"page", folder / "shaders" / "a.wgsl": b"a", folder / "b.js": b"b"}
    for before in ({}, contents):
        write_together(before)
        with failing(Disk(folder)) as counted:
            write_together(contents)
        replaced = [i for i, request in enumerate(counted.requests) if request.startswith("replace")]
        assert counted.requests[replaced[-1]] == "replace index.html", "the page comes last"
        for fatal in range(replaced[0]):
            if not before:
                shutil.rmtree(folder, ignore_errors=True)
            with failing(Disk(folder, fatal)), pytest.raises(OSError):
                write_together({path: b"newer" for path in contents})
            left = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
            assert left == before and folder.exists() == bool(before), counted.requests[fatal]
