import os

import pytest
import torch

import nexwarp as nw
from nexwarp import errors
from nexwarp.cli import main as cli
from nexwarp.cli.commands import Info
from nexwarp.cli.options import pick_device
from nexwarp.data.scene import SceneSource
from nexwarp.errors import DivergedError, FormatError, MissingError, NexwarpError, RunError, SettingError
from nexwarp.run.folder import prepare_run, read_run
from nexwarp.run.render import RenderOrder
from nexwarp.train.checkpoint import load_checkpoint
from tests.subprocesses import run_python

KIN = {
    ValueError: ("SettingError", "SceneError", "FormatError", "CheckpointError", "RunError"),
    FileNotFoundError: ("MissingError",),
    OSError: ("StorageError",),
    RuntimeError: ("DivergedError", "RankError"),
    MemoryError: ("OutOfMemoryError",),
}


def test_the_family_is_whole():
    family = {x for x in vars(errors).values() if isinstance(x, type) and issubclass(x, NexwarpError)}
    kin = {getattr(errors, name): kind for kind, names in KIN.items() for name in names}
    assert family == {NexwarpError, *kin} and all(issubclass(x, kind) for x, kind in kin.items())


def test_boundaries_raise_the_family(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text("{")
    (tmp_path / "run" / "model.safetensors").write_bytes(b"no")
    source = SceneSource("demo")
    for kind, call in (
        (MissingError, lambda: nw.load(tmp_path / "no")),
        (FormatError, lambda: nw.load(tmp_path / "run")),
        (MissingError, lambda: read_run(tmp_path / "no")),
        (FormatError, lambda: read_run(tmp_path / "run")),
        (MissingError, lambda: load_checkpoint(tmp_path / "run")),
        (SettingError, lambda: pick_device("tpu")),
        (SettingError, lambda: RenderOrder(path="circle").check()),
        (RunError, lambda: prepare_run(tmp_path / "run", source, resume=False, overwrite=False)),
        (RunError, lambda: prepare_run(tmp_path / "run" / "teachers" / "1", source, resume=False, overwrite=False)),
        (SettingError, lambda: prepare_run(tmp_path / "run", source, resume=True, overwrite=True)),
    ):
        with pytest.raises(kind) as caught:
            call()
        assert "\n" not in str(caught.value)


LACKS_MEMORY = "error: out of memory: needed 2.00 GiB; try a smaller image size"


def run_info(monkeypatch: pytest.MonkeyPatch, error: BaseException, arguments: str = "info run") -> int:
    """The exit status of `nexwarp info`, which fails."""

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(Info, "__call__", fail)
    return cli.main(arguments.split())


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (RunError("x: expected a run"), 2, "error: x: expected a run"),
        (ValueError("two\n lines"), 2, "error: two lines"),
        (OSError(28, "No space left on device", "f"), 2, "error: [Errno 28] No space left on device: 'f'"),
        (DivergedError("iteration 3: not finite"), 2, "error: iteration 3: not finite"),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. And"), 2, LACKS_MEMORY),
        (RuntimeError("[b]x[/b]"), 3, "internal error: RuntimeError: [b]x[/b]; --debug shows the traceback"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_every_error_is_one_line(monkeypatch, capsys, error, code, line):
    assert run_info(monkeypatch, error) == code and capsys.readouterr() == ("", f"nexwarp: {line}\n")


@pytest.mark.parametrize("arguments", ["--debug info run", "info run --debug"])
def test_debug_shows_the_whole_trace(monkeypatch, capsys, arguments):
    assert run_info(monkeypatch, KeyError("means"), arguments) == 3
    err = capsys.readouterr().err
    assert err.startswith("Traceback (most recent call last):\n") and "in fail\n    raise error\n" in err
    assert err.splitlines()[-1].startswith("nexwarp: ") and "--debug" not in err.splitlines()[-1]


def test_terminated_commands_end_in_order(tmp_path):
    """SIGTERM unwinds: what is half-written goes, though the import of pycolmap takes the signal for itself."""
    program = f"""
import os, signal, sys
from pathlib import Path
from nexwarp.cli import main as cli
from nexwarp.data.lens import pycolmap_module
from nexwarp.io.files import written_aside

def wait(*_):
    pycolmap_module()
    with written_aside(Path({str(tmp_path)!r}) / "file") as temporary:
        temporary.write_text("half")
        os.kill(os.getpid(), signal.SIGTERM)

cli.Info.__call__ = wait
sys.exit(cli.main(["info", "run"]))
"""
    done = run_python("-c", program, timeout=120)
    assert done.returncode == 143 and done.stderr.splitlines()[-1] == "nexwarp: terminated"
    assert os.listdir(tmp_path) == []
