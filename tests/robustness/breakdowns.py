"""Random breakdowns of whole commands: a disk that is full at a random point, a kill at a random moment.

    python -m tests.robustness.breakdowns N [--command process|train|render|export] [--seed S]

The disk is a tmpfs of a random size, which root can mount on Linux: C libraries, too, meet its end. After each
breakdown, foreign files are as before, no file is half-written, one line at most was printed on stderr, and the command
works once more.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from PIL import Image

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.io.files import is_temporary
from nexwarp.io.pictures import load_exr
from nexwarp.run.folder import is_run
from nexwarp.train import recipe
from nexwarp.train.checkpoint import _read_checkpoint
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from tests.cli.support import snapshot
from tests.scene_writers import write_demo

# Nothing is written while exposures are estimated, SH smoothed and detail limits found, which would take most of such a
# short command.
SMALL = Config(
    exposures=False,
    smooth_sh=0.0,
    footprints=False,
    texture=TextureConfig(levels=2, table_size=2**6, width=8),
    densify=DensifyConfig(every=2),
    sh_degree=1,
)
PHOTOS = Path(__file__).parents[1] / "data" / "photos"
FLAGS = "--iterations 6 --max-surfels 60 --device cpu --checkpoint-every 2".split()
ROOMY = 256 * 2**20  # bytes of a disk that is large enough
BLOCK = 4096
FORMATS = ("ply", "compact", "cameras", "web", "mesh")
FOREIGN = ("notes.txt", "run/notes.txt", "run/renders/mine.png", "run/export/mine.ply", "other/images/a.png")


@dataclass(frozen=True)
class Base:
    """What all breakdowns share: a folder, the disk that is mounted in it, a scene and a finished run."""

    folder: Path
    disk: Path

    def words(self, command: str, chance: random.Random) -> list[str]:
        """Return a command line."""
        run = str(self.disk / "run")
        if command == "process":
            return ["process", str(PHOTOS), str(self.disk / "scene"), "--camera-model", "simple_pinhole"]
        if command == "train":
            return ["train", str(self.folder / "scene"), "--run", f"{run}2", *FLAGS]
        if command == "render":
            which = chance.choice([["--set", "test", "--buffers"], ["--frames", "4"]])
            return ["render", run, *which, "--device", "cpu"]
        return ["export", run, "--format", chance.choice(FORMATS), "--device", "cpu"]

    @contextmanager
    def mounted(self) -> Iterator[None]:
        """Mount a large disk that holds the finished run and foreign files; take it away with all that is on it."""
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={ROOMY}", "tmpfs", self.disk], check=True)
        try:
            shutil.copytree(self.folder / "run", self.disk / "run")
            for name in FOREIGN:
                (self.disk / name).parent.mkdir(parents=True, exist_ok=True)
                (self.disk / name).write_text(f"not of nexwarp: {name}")
            yield
        finally:
            subprocess.run(["umount", "-l", self.disk], check=True)

    def resize(self, size: int) -> None:
        """Change the size of the disk."""
        subprocess.run(["mount", "-o", f"remount,size={size}", self.disk], check=True)

    def used(self) -> int:
        """Return how many bytes of the disk are in use."""
        status = os.statvfs(self.disk)
        return (status.f_blocks - status.f_bfree) * status.f_frsize


def run(base: Base, words: list[str], kill_after: float | None = None) -> tuple[int, str]:
    """Run a command in a fork of this process, which has loaded all libraries; return its exit code and its stderr.

    It is killed after some seconds, on request; what it has left running ends with it.
    """
    child = os.fork()
    if not child:
        code = 99
        try:
            os.setsid()
            for number, name in ((1, "out"), (2, "err")):
                os.dup2(os.open(base.folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
            sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
            torch.set_num_threads(1)
            code = cli.main(words)
        except SystemExit as stop:
            code = int(stop.code or 0)
        finally:
            sys.stderr.flush()
            os._exit(code)
    if kill_after is not None:
        time.sleep(kill_after)
        os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    return code, (base.folder / "err").read_text()


def whole(file: Path) -> bool:
    """Whether a file can be read; True for one of a kind that nexwarp does not read."""
    readers: dict[str, Callable[[Path], object]] = {
        ".json": lambda path: json.loads(path.read_bytes()),
        ".png": lambda path: Image.open(path).load(),
        ".jpg": lambda path: Image.open(path).load(),
        ".exr": load_exr,
        ".safetensors": lambda path: nw.load(path) if path.stem != "tensors" else _read_checkpoint(path.parent),
    }
    try:
        readers.get(file.suffix, str)(file)
    except (OSError, ValueError, RuntimeError, SyntaxError):
        return False
    return True


class Measured(NamedTuple):
    """What a command does when nothing breaks."""

    seconds: float
    space: int  # bytes that it leaves on the disk
    files: dict[str, bytes]


def measured(base: Base, words: list[str]) -> Measured:
    """Run a command on a disk that is large enough."""
    with base.mounted():
        before, begun = base.used(), time.perf_counter()
        code, error = run(base, words)
        assert code == 0, (words, error)
        return Measured(time.perf_counter() - begun, max(base.used() - before, BLOCK), snapshot(base.disk))


def faults(base: Base, words: list[str], normal: Measured, kind: str, share: float) -> Iterator[str]:
    """Break a command down; yield what is wrong then."""
    with base.mounted():
        before = snapshot(base.disk)
        if kind == "full":
            base.resize((base.used() + int(share * normal.space)) // BLOCK * BLOCK + BLOCK)
        code, error = run(base, words, share * normal.seconds if kind == "kill" else None)
        fits = code in (0, -signal.SIGKILL) and not error
        if not fits and (code != 2 or not error.startswith("nexwarp: error: ") or error.count("\n") != 1):
            yield f"exit code {code}, stderr {error!r}"
        yield from damage(base, before, normal, killed=code < 0)
        base.resize(ROOMY)
        again = [*words]
        if words[0] == "train" and is_run(base.disk / "run2"):
            again.append("--resume")
        if words[0] == "process" and (base.disk / "scene").exists():
            again.append("--overwrite")
        code, error = run(base, again)
        if code != 0:
            yield f"once more: exit code {code}, {error!r}"
        yield from damage(base, before, normal, killed=True)
        now = snapshot(base.disk)
        if missing := normal.files.keys() - now.keys() - {"run2/checkpoint.old"}:
            yield f"once more: {sorted(missing)[:3]} are missing"
        if now.get("run2/model.safetensors") != normal.files.get("run2/model.safetensors"):
            yield "once more: another model"


def damage(base: Base, before: dict[str, bytes], normal: Measured, *, killed: bool) -> Iterator[str]:
    """Yield what is wrong with the files on the disk."""
    now = snapshot(base.disk)
    for name, content in before.items():
        if name in FOREIGN and now.get(name) != content:
            yield f"{name}: a foreign file was touched"
    for name in now.keys() - before.keys():
        if is_temporary(Path(name).name) or any(part.startswith(".") for part in Path(name).parts):
            if not killed:
                yield f"{name}: left behind"
        elif name not in normal.files and "checkpoint" not in name and not (killed and name.endswith("run.lock")):
            yield f"{name}: not a file of a complete command"
        elif not whole(base.disk / name) or (name.startswith("run/export") and now[name] != normal.files[name]):
            yield f"{name}: half-written"


@contextmanager
def prepared() -> Iterator[Base]:
    """Make the scene and the finished run, with small settings."""
    preset = recipe.PRESETS["default"]
    recipe.PRESETS["default"] = SMALL
    folder = Path(tempfile.mkdtemp(prefix="nexwarp-breakdowns-"))
    base = Base(folder, folder / "disk")
    try:
        base.disk.mkdir()
        write_demo(base.folder / "scene", width=24, height=18, views=6, points=100)
        words = ["train", str(base.folder / "scene"), "--run", str(base.folder / "run"), *FLAGS]
        code, error = run(base, words)
        assert code == 0, error
        yield base
    finally:
        recipe.PRESETS["default"] = preset
        shutil.rmtree(base.folder)


def sweep(count: int, commands: list[str], seed: int, kinds: tuple[str, ...] = ("full", "kill")) -> list[str]:
    """Break commands down `count` times, in turns; return what was wrong."""
    chance = random.Random(seed)
    known: dict[str, Measured] = {}
    wrong: list[str] = []
    done: Counter[str] = Counter()
    with prepared() as base:
        for number in range(count):
            command, kind = commands[number % len(commands)], kinds[number // len(commands) % len(kinds)]
            words, share = base.words(command, chance), chance.random()
            key = " ".join(words)
            if key not in known:
                known[key] = measured(base, words)
            for fault in faults(base, words, known[key], kind, share):
                wrong.append(f"{number}: {kind} at {share:.3f} of {' '.join(words[:4])}: {fault}")
                print(wrong[-1], flush=True)
            done[f"{command} {kind}"] += 1
    print(f"{count} breakdowns, {len(wrong)} faults: {dict(done)}", flush=True)
    return wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("--command", choices=["process", "train", "render", "export"])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chosen = [options.command] if options.command else ["process", "train", "render", "export"]
    sys.exit(bool(sweep(options.count, chosen, options.seed)))
