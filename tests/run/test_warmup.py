"""`nexwarp warmup` leaves nothing to compile, its list is complete, and its rehearsal is like a run."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import warp as wp

from nexwarp.cli import main as cli
from nexwarp.kernels import launch as launching
from nexwarp.kernels.catalogue import all_kernels
from nexwarp.run import warmup
from nexwarp.train.config import Config, TextureConfig
from nexwarp.train.densify import Densifier
from nexwarp.train.presets import PRESETS
from nexwarp.train.trainer import Trainer

CPU = torch.device("cpu")

# Two processes with one cache. What a preset is compiled for stays; its tables shrink, to fit a CPU.
WARM = """
import json, sys, torch
from nexwarp.run import warmup
from nexwarp.train.presets import preset
from nexwarp.cli.device import pick_device
device = pick_device(sys.argv[1])
counts = [len(warmup.cached_binaries())]
warmup.compile_all(warmup.needed(preset("default"), device), device)
counts.append(len(warmup.cached_binaries()))
warmup.rehearse(preset("default"), device)
counts.append(len(warmup.cached_binaries()))
print(json.dumps(counts))
"""
USE = """
import json, sys, torch
from dataclasses import replace
from nexwarp.cli import main as cli; from nexwarp.train import presets; from nexwarp.run import warmup
from nexwarp.data import write_demo
scene, run, device = sys.argv[1:]
write_demo(scene, width=48, height=36, views=10, points=200)
base = presets.PRESETS["default"]
presets.PRESETS["default"] = replace(base, texture=replace(base.texture, table_size=2**10))
before = warmup.cached_binaries()
short = ["--iterations", "60", "--max-surfels", "100"]
commands = {
    "warmup": ["warmup"],
    "train": ["train", scene, "--run", run, *short],
    "eval": ["eval", run],
    "render": ["render", run, "--frames", "1"],
}
codes = [cli.main([*command, "--device", device]) for command in commands.values()]
print(json.dumps([codes, sorted(path.name for path in warmup.cached_binaries() - before)]))
"""


def fresh_process(program: str, *arguments: str, cache: Path) -> list[str]:
    """Lines that a program prints in a process of its own, with a kernel cache of its own."""
    environment = os.environ | {"WARP_CACHE_PATH": str(cache / "warp"), "COLUMNS": "200"}
    command = [sys.executable, "-c", program, *arguments]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.long
def test_nothing_is_left_to_compile(device: torch.device, tmp_path: Path) -> None:
    """The list alone is enough for the rehearsal; and after both, no command compiles, not even a second warm-up."""
    warm = fresh_process(WARM, device.type, cache=tmp_path)
    use = fresh_process(USE, str(tmp_path / "tiny"), str(tmp_path / "run"), device.type, cache=tmp_path)
    at_first, listed, rehearsed = json.loads(warm[-1])
    assert at_first == 0 and listed > 20
    assert rehearsed == listed, "the rehearsal compiled kernels that the catalogue does not list"
    *output, last = use
    codes, compiled = json.loads(last)
    assert codes == [0] * 4
    assert not compiled, "compiled after the warm-up"
    line = next(line for line in output if "kernels ready" in line)
    assert f"{listed} kernels ready" in line and f"0 compiled, {listed} found in the cache" in line


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> Iterator[set[tuple[str, int]]]:
    """Module and block size of every kernel that is launched."""
    seen: set[tuple[str, int]] = set()
    launch = launching.launch

    def note(kernel: wp.Kernel, dim: int | tuple[int, int], *args: Any, **kwargs: Any) -> None:
        if torch.Size([dim] if isinstance(dim, int) else dim).numel():  # nothing is compiled for no threads
            seen.add((kernel.module.name, kwargs.get("block_dim", 256)))
        launch(kernel, dim, *args, **kwargs)

    monkeypatch.setattr(launching, "launch", note)
    yield seen


SETTINGS = {
    **PRESETS,
    "no texture": Config(max_hits=0),
    "no texture, no detail limits": Config(max_hits=0, footprints=False),
    "K = 3": Config(max_hits=3),
    "poses": Config(refine_poses=True),
    "deterministic": Config(deterministic=True),
    "options": Config(sh_degree=1, texture=TextureConfig(residual=False)),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_what_runs_is_listed(name: str, launched: set[tuple[str, int]], device: torch.device) -> None:
    """Also with the block size that it is launched with, since a build is for one only."""
    config = SETTINGS[name]
    listed = {(kernel.module.name, block_dim) for kernel, block_dim in warmup.needed(config, device)}
    warmup.rehearse(config, device)
    assert launched, "no launch was seen"
    assert launched <= listed
    everything = {kernel.module.name for kernel in all_kernels(storage=wp.float32)}
    everything |= {kernel.module.name for kernel in all_kernels()}
    everything |= {kernel.module.name for kernel in all_kernels(storage=wp.float32, cpu=True)}
    assert {module for module, _ in listed} <= everything


def test_keys_of_kernels_do_not_depend_on_what_was_compiled_before() -> None:
    """Constants in a loop are known once code is generated; Warp does that before the key if the kernel has some.

    If only a function has some, they are in the key where another kernel with it was compiled before, and not else.
    """

    def late(adjoint: Any) -> Iterator[str]:
        for function in adjoint.get_references()[2]:
            if not function.is_builtin():
                if function.adj.has_unresolved_static_expressions:
                    yield function.key
                yield from late(function.adj)

    every = [*all_kernels(), *all_kernels(storage=wp.float32, cpu=True)]
    kernels = [kernel for kernel in every if not kernel.adj.has_unresolved_static_expressions]
    assert len(kernels) > 200
    assert not {kernel.key: found for kernel in kernels if (found := [*late(kernel.adj)])}


def test_few_kernels_are_listed_in_vain(launched: set[tuple[str, int]]) -> None:
    """On a CPU all but the row sum of the low-pass runs; a longer list only takes longer."""
    listed = {kernel.module.name: kernel.key for kernel, _ in warmup.needed(Config(), CPU)}
    warmup.rehearse(Config(), CPU)
    idle = [key for module, key in listed.items() if module not in dict(launched)]
    assert len(idle) <= 1, idle
    without = [kernel.key for kernel, _ in warmup.needed(Config(max_hits=0), CPU)]
    assert not any("mlp" in key or "textured" in key for key in without)


def test_the_rehearsal_is_a_short_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every degree, both photo sizes, rounds of density control, and steps after the last, as in a real run."""
    steps, rounds = [], []
    step, split = Trainer.step, Densifier.step

    def noted(self: Trainer) -> Any:
        progress = step(self)
        watching = self.densifier.active(self.iteration)
        steps.append((self.render_options().sh_degree, progress.image.shape[0], watching))
        return progress

    def counted(self: Densifier, *args: Any) -> Any:
        rounds.append(split(self, *args))
        return rounds[-1]

    monkeypatch.setattr(Trainer, "step", noted)
    monkeypatch.setattr(Densifier, "step", counted)
    warmup.rehearse(Config(), CPU)
    degrees, heights, watches = zip(*steps, strict=True)
    assert set(degrees) == {0, 1, 2, 3} and list(degrees) == sorted(degrees)
    assert set(heights) == {warmup.HEIGHT, warmup.HEIGHT // 2}
    assert set(watches) == {True, False} and list(watches) == sorted(watches, reverse=True)
    assert any(count for count, _ in rounds), "nothing was split"


def test_a_rehearsal_changes_only_what_is_not_compiled_in() -> None:
    for config in SETTINGS.values():
        tiny = warmup.tiny(config)
        kept = ("preset", "max_hits", "sh_degree", "losses", "background")
        assert all(getattr(tiny, name) == getattr(config, name) for name in kept)
        assert replace(tiny.texture, table_size=config.texture.table_size) == config.texture


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--preset", "papr"], ("preset", "default, paper", "'papr'")),
        (["--max-hits", "9"], ("--max-hits", "0 to 8", "got 9")),
        (["--device", "gpu"], ("--device", "cuda or cpu", "'gpu'")),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["warmup", *arguments]) == 2
    err = capsys.readouterr().err
    assert err.startswith("nexwarp: error: ") and err.count("\n") == 1
    assert all(word in err for word in words)
