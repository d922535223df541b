"""SIGKILL at random moments of a training; what is resumed ends as if nothing had happened.

`python -m benchmarks.kills` does the same to the demo, as often as one likes.
"""

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.kills import Kills, kill_and_resume
from nexwarp.cli import main as cli
from nexwarp.data import write_demo
from nexwarp.train import presets
from nexwarp.train.config import Config, TextureConfig
from nexwarp.train.densify import DensifyConfig

ROOT = Path(__file__).parents[1]
FLAGS = ["--iterations", "20", "--max-surfels", "100", "--device", "cpu", "--checkpoint-every", "1"]


SMALL = Config(texture=TextureConfig(levels=4, table_size=2**10, width=16), densify=DensifyConfig(every=3))


def main() -> None:
    """The command line, whose default preset is a small one."""
    presets.PRESETS["default"] = SMALL
    sys.exit(cli.main())


@pytest.fixture(autouse=True)
def small_preset(monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "default", SMALL)


@pytest.mark.parametrize("count", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_killed_runs_end_with_the_same_bytes(tmp_path, count):
    scene = write_demo(tmp_path / "scene", width=48, height=36, views=10, points=200)
    assert cli.main(["train", str(scene), "--run", str(tmp_path / "whole"), *FLAGS]) == 0
    expected = (tmp_path / "whole" / "model.safetensors").read_bytes()
    command = [sys.executable, "-c", "from tests.test_kills import main; main()", "train", str(scene), *FLAGS]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}

    def start(run: Path) -> subprocess.Popen[bytes]:
        silent = subprocess.DEVNULL
        return subprocess.Popen([*command, "--run", str(run)], env=environment, stdout=silent, stderr=silent)

    def resume(run: Path) -> int:
        return cli.main(["train", str(scene), "--run", str(run), "--device", "cpu", "--resume"])

    generator = random.Random(0)
    kills = []
    for number in range(count):
        kills.append(kill_and_resume(start, resume, tmp_path / f"run{number}", generator.uniform(0.0, 1.0), expected))
    assert all(kill.same for kill in kills), kills


def test_a_kill_is_waited_for(tmp_path):
    """A training that ends before its moment is an error only when it began nothing."""

    def start(run: Path) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", "raise SystemExit(7)"])

    begun = time.perf_counter()
    with pytest.raises(RuntimeError, match="ended by itself, with exit code 7"):
        kill_and_resume(start, lambda _: 0, tmp_path / "run", 60.0, b"")
    assert time.perf_counter() - begun < 30


def test_the_command_is_given_the_device_and_the_sums():
    alone, on_gpu = Kills().command(), Kills(device="cuda", deterministic=True, iterations=600).command()
    assert "--device=cpu" in alone and "--deterministic" not in alone
    assert "--device=cuda" in on_gpu and "--deterministic" in on_gpu and "--iterations=600" in on_gpu
