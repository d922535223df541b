import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

import nexwarp
from nexwarp.cli import display
from nexwarp.cli import main as cli
from tests.model_file_support import make_model
from tests.subprocesses import ROOT, environment, run_python

CLOSED_PIPE = 141


@pytest.mark.parametrize("arguments", [["--version"], ["train", "--help"]])
def test_a_closed_pipe_ends_without_a_traceback(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert arguments != ["--version"] or cli.main(arguments) == 0
    assert capsys.readouterr().out in ("", f"nexwarp {nexwarp.__version__}\n")
    code = f"import sys; from nexwarp.cli.main import main; sys.exit(main({arguments!r}))"
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-c", code], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (CLOSED_PIPE, "")


def run_closing(streams: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command from a shell that closes or redirects some of its streams."""
    command = ["sh", "-c", f'exec "$@" {streams}', "sh", sys.executable, "-m", "nexwarp", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment(), cwd=ROOT)


def test_finished_work_ends_well_without_a_stdout(tmp_path: Path) -> None:
    """With neither stdout nor stderr, no file takes their numbers; on a full disk, one line says so."""
    make_model().save(tmp_path)
    done = run_closing(">&-", "info", str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")
    assert run_closing(">&- 2>&- <&-", "export", str(tmp_path)).returncode == 0
    assert (tmp_path / "export" / "surfels.ply").read_bytes().startswith(b"ply")
    done = run_closing(">/dev/full", "info", str(tmp_path))
    assert (done.returncode, done.stderr) == (2, "nexwarp: error: [Errno 28] No space left on device\n")


def test_ctrl_c_while_libraries_load_prints_one_line() -> None:
    command = [sys.executable, "-m", "nexwarp", "info", "nowhere"]
    started = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment(), cwd=ROOT)
    caught = 0
    while not caught & 1 << signal.SIGINT - 1:  # Python has begun
        caught = int(re.findall(r"SigCgt:\s*(\w+)", Path(f"/proc/{started.pid}/status").read_text())[0], 16)
        time.sleep(0.001)
    time.sleep(0.3)
    started.send_signal(signal.SIGINT)
    assert started.communicate()[1] == "nexwarp: interrupted\n" and started.returncode == 130


HOSTILE = "\x1b[2J\x1b]0;owned\x07\x9b1m\r\n\u202egnp.exe\u2066[b]"
ESCAPED = r"\x1b[2J\x1b]0;owned\x07\x9b1m\r\n\u202egnp.exe\u2066[b]"


def test_names_of_strangers_do_not_reach_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In tables, lines, warnings, errors and tracebacks."""
    run = tmp_path / HOSTILE
    make_model().save(run)
    assert cli.main(["info", str(run)]) == 0
    assert cli.main(["export", str(run)]) == 0
    (run / "model.safetensors").write_bytes(b"")
    assert cli.main(["info", str(run), "--debug"]) == 2
    console = cli.OutputConsole()
    display.warn(console, HOSTILE)
    console.print(display.results_table({HOSTILE: HOSTILE}, HOSTILE))
    out, err = capsys.readouterr()
    assert all(c.isprintable() for c in (out + err).replace("\n", ""))
    assert f"{ESCAPED}/export/surfels.ply\n" in out and f"warning: {ESCAPED}\n" in out
    assert ESCAPED.replace(r"\r\n", " ") in err.splitlines()[-1]


def test_warp_starts_without_a_word(tmp_path: Path) -> None:
    """Neither its banner and the lines of loaded modules, nor the warning of a missing driver."""
    code = """
        import torch, nexwarp as nw
        ones = torch.ones(4, 3)
        surfels = nw.Surfels.from_activated(ones, torch.eye(4), ones[:, :2], ones[:, 0] / 2, ones[:, :2], ones[:, None])
        K = torch.tensor([[9.0, 0, 4], [0, 9, 4], [0, 0, 1]])
        nw.render(surfels, None, nw.Camera(torch.eye(4), K, 8, 8))
    """
    done = run_python("-c", textwrap.dedent(code))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
