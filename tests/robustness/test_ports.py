"""Which ports commands open: in a network namespace of their own, scanned inside and knocked at from another one."""

import ipaddress
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.subprocesses import python_path

ROOT = Path(__file__).parents[2]
ADDRESS = "10.77.91.1"  # of the namespace where commands run; the other one has .2
SMALL = ["texture.levels=2", "texture.table_size=256", "exposures=false", "smooth_sh=0", "footprints=false"]

Place = tuple[str, int]  # address and port


@pytest.fixture(scope="module")
def namespaces() -> Iterator[tuple[str, str]]:
    """Two network namespaces with a cable between them."""
    if not (sys.platform == "linux" and os.geteuid() == 0 and shutil.which("ss")):
        pytest.skip("network namespaces need Linux, root and iproute2")
    names = f"nxw{os.getpid()}a", f"nxw{os.getpid()}b"
    commands = [f"ip netns add {name}" for name in names]
    commands.append(f"ip -n {names[0]} link add cable type veth peer name cable netns {names[1]}")
    for number, name in enumerate(names, 1):
        commands.append(f"ip -n {name} address add 10.77.91.{number}/24 dev cable")
        commands += [f"ip -n {name} link set {device} up" for device in ("lo", "cable")]
    try:
        for command in commands:
            if subprocess.run(command.split(), capture_output=True, check=False).returncode:
                pytest.skip(f"this system refuses: {command}")
        yield names
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)


class Command:
    """A command in a namespace, and the places at which anything there has listened."""

    def __init__(self, namespaces: tuple[str, str], arguments: list[str], log: Path) -> None:
        self.inside, self.outside = namespaces
        command = ["ip", "netns", "exec", self.inside, sys.executable, "-m", "nexwarp", *arguments]
        environment = os.environ | python_path(ROOT) | {"OMP_NUM_THREADS": "1"}
        self.log, self.places = log, set[Place]()
        with log.open("w") as file:
            self.process = subprocess.Popen(command, env=environment, stdout=file, stderr=file, cwd=ROOT)

    def run_until(self, text: str) -> None:
        """Scan until the command has printed a text."""
        until = time.monotonic() + 90
        while text not in self.log.read_text():
            assert self.process.poll() is None and time.monotonic() < until, self.log.read_text()
            self.places |= self.scan()
            time.sleep(0.02)

    def scan(self) -> set[Place]:
        """Places at which something listens now in the namespace."""
        command = ["ip", "netns", "exec", self.inside, "ss", "-Hltn"]
        lines = subprocess.check_output(command, text=True).splitlines()
        places = [line.split()[3].rpartition(":") for line in lines]
        return {(address.strip("[]").replace("*", "::"), int(port)) for address, _, port in places}

    def admits(self, port: int) -> bool:
        """Whether a machine at the other end of the cable can connect to a port."""
        knock = ["ip", "netns", "exec", self.outside, "bash", "-c", f"exec 3<>/dev/tcp/{ADDRESS}/{port}"]
        return subprocess.run(knock, capture_output=True, timeout=5).returncode == 0

    def end(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.wait(60)


@pytest.mark.timeout(600)
def test_nothing_listens_beyond_loopback_but_what_was_asked(namespaces, tiny_folder, tmp_path):
    """Two ranks and the viewer of a training: refused from elsewhere; `view --host`: that port alone is open."""
    run = tmp_path / "run"
    settings = [word for setting in SMALL for word in ("--set", setting)]
    options = ["--gpus", "2", "--device", "cpu", "--iterations", "20", "--max-surfels", "50", "--view", "--port", "0"]
    command = Command(namespaces, ["train", str(tiny_folder), "--run", str(run), *settings, *options], tmp_path / "a")
    try:
        command.run_until("viewer: http")
        command.run_until("iteration 2/20")
        assert not any(command.admits(port) for _, port in command.scan())
        command.run_until("Ctrl-C ends it")
    finally:
        command.end()
    assert len(command.places) >= 3, "two ranks and the viewer"
    assert all(ipaddress.ip_address(address).is_loopback for address, _ in command.places), command.places

    view = Command(
        namespaces, ["view", str(run), "--host", "0.0.0.0", "--port", "8123", "--device", "cpu"], tmp_path / "b"
    )
    try:
        view.run_until("Ctrl-C ends it")
        assert view.admits(8123)
    finally:
        view.end()
    beyond = {place for place in view.places | {("0.0.0.0", 8123)} if not ipaddress.ip_address(place[0]).is_loopback}
    assert beyond == {("0.0.0.0", 8123)}
