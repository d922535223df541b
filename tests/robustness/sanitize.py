"""Small training steps, frames and renderings of odd sizes under compute-sanitizer, which checks every access.

    python -m tests.robustness.sanitize --tool memcheck,racecheck,initcheck,synccheck

runs itself under each tool, prints a line for each, and exits with 1 when a tool found an error, with 2 when there is
no compute-sanitizer (`pip install nvidia-cuda-sanitizer-api==13.5.25`; racecheck of CUDA 13.0, 2025.3, fails).

The allocators of torch and Warp reuse freed memory, which hides an access beyond the end of an array. So each array is
an allocation of its own here.
"""

import dataclasses
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from unittest.mock import patch

import torch
import tyro
import warp as wp

import nexwarp as nw
from nexwarp.run import warmup
from nexwarp.train.recipe import preset
from nexwarp.train.trainer import Trainer
from tests.render_support import loss
from tests.scenes import make_camera, make_surfels, make_texture, random_scene

TOOLS = ("memcheck", "racecheck", "initcheck", "synccheck")
# Iterations of a full run: all degrees of spherical harmonics, then a step with a density round.
ITERATIONS = (10_001, 10_100)
# One pixel, less than a tile, whole tiles, a row, and parts of tiles in both directions.
SIZES = ((1, 1), (17, 33), (31, 7), (16, 16), (50, 1), (5, 64), (33, 47))
HITS = range(9)
PLACES = ("nvidia/cu13/compute-sanitizer", "nvidia/cuda_sanitizer_api/bin")  # of the package, below site-packages
# Racecheck checks shared memory; restricted to our kernels, since others are slow to check and give false reports.
OURS = ("--kernel-name", "kernel_substring=_cuda_kernel_")
SUMMARIES = (
    re.compile(r"^=+ RACECHECK SUMMARY: \d+ hazards? displayed \((?P<errors>\d+) errors?, .*\)", re.M),
    re.compile(r"^=+ ERROR SUMMARY: (?P<errors>\d+) errors?", re.M),
)
SHOWN = 60  # lines of a report that found errors


@dataclass(frozen=True)
class Report:
    """The result of a tool.

    Attributes:
        errors: how many; None when the tool printed no summary.
        summary: its last line, or what it said in its place.
        code: exit code of the command.
    """

    errors: int | None
    summary: str
    code: int = 0

    @property
    def clean(self) -> bool:
        """Whether the tool ran to its end and found no error."""
        return self.errors == 0 and self.code == 0


def parse(output: str) -> Report:
    """Read the output of compute-sanitizer."""
    for pattern in SUMMARIES:
        if summaries := list(pattern.finditer(output)):
            # One summary per process: Python may start several.
            return Report(sum(int(match["errors"]) for match in summaries), summaries[-1][0].strip("= "))
    lines = [line.strip("= ") for line in output.splitlines() if line.startswith("=") and line.strip("= ")]
    return Report(None, lines[-1] if lines else "no output of compute-sanitizer")


def find_tool() -> str | None:
    """Return the path of compute-sanitizer, installed by pip or on the PATH; None without one."""
    folders = [str(Path(folder) / place) for folder in sys.path for place in PLACES]
    return shutil.which("compute-sanitizer", path=os.pathsep.join([*folders, os.environ.get("PATH", "")]))


def train_and_render(device: torch.device) -> dict[str, int]:
    """Train, as by default and with fixed-order sums, and render; return how many steps and frames there were."""
    scene = warmup.tiny_scene()
    base = preset("default")
    config = dataclasses.replace(
        base,
        max_surfels=200,
        texture=dataclasses.replace(base.texture, levels=8, table_size=2**10),
        densify=dataclasses.replace(base.densify, fraction=1.0, prune_opacity=0.02),
    )
    done = {"steps": 0, "frames": 0}
    for deterministic in (False, True):
        trainer = Trainer(scene, dataclasses.replace(config, deterministic=deterministic), device)
        for iteration in ITERATIONS:
            trainer.iteration = iteration - 1
            trainer.step()
            done["steps"] += 1
        trainer.check()
    model = trainer.model()
    camera = scene.test[0].camera.to(device)
    with torch.no_grad():
        for view in (camera, camera.crop(-5, 7, 33, 50)):
            out = model.render(view)
            out.splat_error(out.alpha)
            assert bool(torch.isfinite(out.image).all())
            done["frames"] += 1
    return done


def render_odd_sizes(device: torch.device, hits: Sequence[int] = HITS) -> int:
    """Render each K and size with all its buffers and gradients; return how many renderings there were."""
    texture = make_texture(device=device)
    count = 0
    for max_hits in hits:
        for width, height in SIZES:
            scene = random_scene(60, seed=max_hits, device=device)
            surfels, camera = make_surfels(scene), make_camera(scene, width=width, height=height)
            out = nw.render(surfels, texture, camera, max_hits=max_hits)
            (loss(out) + out.expected_depth.sum() + out.median_depth.sum() + out.normals.sum()).backward()
            assert all(x.grad is None or bool(torch.isfinite(x.grad).all()) for x in surfels.parameters())
            count += 1
    return count


@contextmanager
def plain_products() -> Iterator[None]:
    """Multiply matrices by torch's own kernels: initcheck does not see what cuBLAS writes on a Hopper GPU."""
    original = torch.Tensor.__matmul__

    def matmul(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        if min(a.dim(), b.dim()) < 2:
            return original(a, b)
        wide = torch.promote_types(a.dtype, torch.float32)
        return (a.to(wide)[..., None] * b.to(wide)[..., None, :, :]).sum(-2).to(a.dtype)

    def mm(
        a: torch.Tensor, b: torch.Tensor, *, out_dtype: torch.dtype | None = None, out: torch.Tensor | None = None
    ) -> torch.Tensor:
        product = matmul(a.to(out_dtype or a.dtype), b.to(out_dtype or b.dtype))
        return product if out is None else out.copy_(product)

    def activated(bias: torch.Tensor, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (bias + matmul(a, b)).relu()

    with (
        patch.object(torch.Tensor, "__matmul__", matmul),
        patch.object(torch, "mm", mm),
        patch.object(torch, "_addmm_activation", activated),
    ):
        yield


def check(tool: str, sanitizer: str, command: Sequence[str]) -> Report:
    """Run a command under a tool, print its result, and return it."""
    run = subprocess.run(
        [sanitizer, "--tool", tool, *(OURS if tool == "racecheck" else ()), *command],
        env=os.environ | {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )
    report = dataclasses.replace(parse(run.stdout), code=run.returncode)
    code = f", exit code {run.returncode}" if run.returncode else ""
    print(f"{tool}: {report.summary}{code}: {'clean' if report.clean else 'NOT CLEAN'}")
    if not report.clean:
        print("\n".join(run.stdout.splitlines()[:SHOWN]), flush=True)
    return report


@dataclass
class Sanitize:
    """Train and render a little; under compute-sanitizer with --tool."""

    tool: Annotated[str | None, tyro.conf.arg(metavar="TOOL,...")] = None
    """Tools of compute-sanitizer to run this under: memcheck, racecheck, initcheck, synccheck. Default: none."""
    device: Annotated[str, tyro.conf.arg(metavar="{cuda,cpu}")] = "cuda"
    """Where; compute-sanitizer sees CUDA alone."""
    plain_products: bool = False
    """Multiply matrices without cuBLAS, as --tool initcheck does."""

    def __call__(self) -> int:
        """Run, print, and return the exit code."""
        if self.tool is not None:
            return self._under(self.tool.split(","))
        wp.config.log_level = wp.LOG_ERROR
        if self.device == "cuda" and not torch.cuda.is_available():
            print("device: expected a CUDA device, found none", file=sys.stderr)
            return 2
        device = torch.device("cuda", torch.cuda.current_device()) if self.device == "cuda" else torch.device("cpu")
        if device.type == "cuda":  # each array is an allocation of its own
            os.environ["PYTORCH_NO_CUDA_MEMORY_CACHING"] = "1"
            wp.init()
            wp.set_mempool_enabled(f"cuda:{device.index}", False)
        with plain_products() if self.plain_products else nullcontext():
            done = train_and_render(device)
            count = render_odd_sizes(device)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        print(f"{done['steps']} training steps, {done['frames']} frames, {count} renderings on {self.device}")
        return 0

    def _under(self, tools: Sequence[str]) -> int:
        """Run this under tools of compute-sanitizer."""
        if unknown := [tool for tool in tools if tool not in TOOLS]:
            print(f"--tool: expected some of {', '.join(TOOLS)}, got {unknown[0]!r}", file=sys.stderr)
            return 2
        sanitizer = find_tool()
        if sanitizer is None:
            print("compute-sanitizer: expected it on the PATH or installed by pip, found none", file=sys.stderr)
            return 2
        command = [sys.executable, "-m", "tests.robustness.sanitize", "--device", self.device]
        # Once without a tool, to compile all kernels and to see that the work runs at all.
        if (code := subprocess.run(command).returncode) != 0:
            print(f"without a tool it ended with exit code {code}", file=sys.stderr)
            return 1
        plain = ["--plain-products"]
        reports = [check(tool, sanitizer, command + plain * (tool == "initcheck")) for tool in tools]
        return 0 if all(report.clean for report in reports) else 1


if __name__ == "__main__":
    sys.exit(tyro.cli(Sanitize)())
