"""`nexwarp warmup` leaves nothing to compile, and its rehearsal is like a run."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import warp as wp

from nexwarp.kernels import launch as launching
from nexwarp.run import warmup
from nexwarp.train.recipe import PRESETS, Config

CPU = torch.device("cpu")

# What a preset is compiled for stays; its tables shrink, to fit a CPU.
WARM = """
import sys
from nexwarp.cli import main as cli; from nexwarp.run import warmup
cli.main(["warmup", "--device", sys.argv[1]])
print(len(warmup.cached_binaries()))
"""
USE = """
import json, sys, torch
from dataclasses import replace
from nexwarp.cli import main as cli; from nexwarp.train import recipe; from nexwarp.run import warmup
from tests.scene_writers import write_demo
scene, run, device = sys.argv[1:]
write_demo(scene, width=48, height=36, views=10, points=200)
base = recipe.PRESETS["default"]
recipe.PRESETS["default"] = replace(base, texture=replace(base.texture, table_size=2**10))
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
    """After a warm-up no command compiles, not even a second warm-up; so keys of kernels are the same in all."""
    warm = fresh_process(WARM, device.type, cache=tmp_path)
    use = fresh_process(USE, str(tmp_path / "tiny"), str(tmp_path / "run"), device.type, cache=tmp_path)
    assert int(warm[-1]) > 20
    *output, last = use
    codes, compiled = json.loads(last)
    assert codes == [0] * 4
    assert not compiled, "compiled after the warm-up"
    assert any("kernels ready" in line and " 0 compiled" in line for line in output)


SETTINGS = {
    **PRESETS,
    "no texture": Config(max_hits=0),
    "poses": Config(refine_poses=True),
    "deterministic": Config(deterministic=True),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_keys_of_kernels_do_not_depend_on_what_was_compiled_before(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Constants in a loop are known once code is generated; Warp does that before the key if the kernel has some.

    If only a function has some, they are in the key where another kernel with it was compiled before, and not else.
    """
    kernels: dict[str, wp.Kernel] = {}
    launch = launching.launch

    def note(kernel: wp.Kernel, *args: Any, **kwargs: Any) -> None:
        kernels[kernel.key] = kernel
        launch(kernel, *args, **kwargs)

    def late(adjoint: Any) -> Iterator[str]:
        for function in adjoint.get_references()[2]:
            if not function.is_builtin():
                if function.adj.has_unresolved_static_expressions:
                    yield function.key
                yield from late(function.adj)

    monkeypatch.setattr(launching, "launch", note)
    warmup.rehearse(SETTINGS[name], CPU)
    assert len(kernels) > 20
    plain = [kernel for kernel in kernels.values() if not kernel.adj.has_unresolved_static_expressions]
    assert not {kernel.key: functions for kernel in plain if (functions := [*late(kernel.adj)])}
