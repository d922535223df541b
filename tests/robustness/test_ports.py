"""Which ports commands open: nothing listens beyond loopback but what was asked for."""

import ipaddress
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from tests.subprocesses import ROOT, environment

SMALL = ["texture.levels=2", "texture.table_size=256", "exposures=false", "smooth_sh=0", "footprints=false"]

Place = tuple[str, int]  # address and port


def listening(command: psutil.Process) -> set[Place]:
    places = set[Place]()
    for process in (command, *command.children(recursive=True)):
        with suppress(psutil.NoSuchProcess, psutil.AccessDenied):  # it has ended
            opened = process.net_connections("inet")
            places |= {(x.laddr.ip, x.laddr.port) for x in opened if x.status == psutil.CONN_LISTEN}
    return places


def places_until(text: str, arguments: list[str], log: Path) -> set[Place]:
    """Run a command until it has printed a text, then end it; return all places at which it has listened."""
    command = [sys.executable, "-m", "nexwarp", *arguments]
    with log.open("w") as file:
        started = subprocess.Popen(command, env=environment(OMP_NUM_THREADS="1"), stdout=file, stderr=file, cwd=ROOT)
    places, until = set[Place](), time.monotonic() + 180
    try:
        while text not in log.read_text():
            assert started.poll() is None and time.monotonic() < until, log.read_text()
            places |= listening(psutil.Process(started.pid))
            time.sleep(0.02)
        return places | listening(psutil.Process(started.pid))
    finally:
        started.send_signal(signal.SIGINT)
        started.wait(60)


@pytest.mark.timeout(600)
def test_nothing_listens_beyond_loopback_but_what_was_asked(tiny_folder, tmp_path):
    """Two ranks and the viewer of a training; then `view --host`, of which that port alone is open."""
    run = tmp_path / "run"
    settings = [word for setting in SMALL for word in ("--set", setting)]
    options = ["--gpus", "2", "--device", "cpu", "--iterations", "20", "--max-surfels", "50", "--view", "--port", "0"]
    train = ["train", str(tiny_folder), "--run", str(run), *settings, *options]
    places = places_until("Ctrl-C ends it", train, tmp_path / "train.log")
    assert len(places) >= 3, "two ranks and the viewer"
    assert all(ipaddress.ip_address(address).is_loopback for address, _ in places), places
    view = ["view", str(run), "--host", "0.0.0.0", "--port", "0", "--device", "cpu"]
    places = places_until("Ctrl-C ends it", view, tmp_path / "view.log")
    assert [address for address, _ in places if not ipaddress.ip_address(address).is_loopback] == ["0.0.0.0"]
