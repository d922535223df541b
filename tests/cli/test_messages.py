"""What people see on the command line beside results: versions, suggestions, closed pipes, durations, quiet Warp."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import nexwarp
from nexwarp.cli import main as cli

CLOSED_PIPE = 141


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"nexwarp {nexwarp.__version__}\n"


@pytest.mark.parametrize(("typed", "meant"), [("trian", "train"), ("rendr", "render"), ("evel", "eval"), ("xyz", None)])
def test_a_mistyped_command_is_one_line_with_a_suggestion(
    typed: str, meant: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([typed, "somewhere"])
    assert stop.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith(f"nexwarp: error: no command {typed!r}, expected one of train, eval") and err.count("\n") == 1
    assert ("; perhaps you meant nexwarp " in err) == (meant is not None)
    assert meant is None or err.endswith(f"; perhaps you meant nexwarp {meant}\n")


@pytest.mark.parametrize("arguments", [["--version"], ["train", "--help"]])
def test_a_closed_pipe_ends_without_a_traceback(arguments: list[str]) -> None:
    code = f"import sys; from nexwarp.cli.main import main; sys.exit(main({arguments!r}))"
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-c", code], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (CLOSED_PIPE, "")


def test_warp_starts_without_a_word(tmp_path: Path) -> None:
    """Neither its banner and the lines of loaded modules, nor the warning of a missing driver."""
    code = """
        import torch, nexwarp as nw
        ones = torch.ones(4, 3)
        surfels = nw.Surfels.from_activated(ones, torch.eye(4), ones[:, :2], ones[:, 0] / 2, ones[:, :2], ones[:, None])
        K = torch.tensor([[9.0, 0, 4], [0, 9, 4], [0, 0, 1]])
        nw.render(surfels, None, nw.Camera(torch.eye(4), K, 8, 8))
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
