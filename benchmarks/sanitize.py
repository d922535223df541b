"""Small training steps, frames and every kernel under compute-sanitizer, which checks every access.

    python -m benchmarks.sanitize --tool memcheck,racecheck,initcheck,synccheck --sweep

runs itself under each tool, prints a line for each and the number of errors, and exits with 1 when a tool found an
error, with 2 when there is no compute-sanitizer. --sweep adds the kernels of the catalogue, forward and
backward (`benchmarks.kernel_sweep`). `compute-sanitizer --tool memcheck python -m benchmarks.sanitize` is the same by
hand.

The allocators of torch and Warp reuse freed memory, which hides an access beyond the end of an array. This benchmark
makes each array an allocation of its own.
"""

import dataclasses
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from unittest.mock import patch

import torch
import tyro
import warp as wp

from benchmarks.kernel_sweep import compile_catalogue, sweep
from nexwarp.run import warmup
from nexwarp.train.presets import preset
from nexwarp.train.trainer import Trainer

TOOLS = ("memcheck", "racecheck", "initcheck", "synccheck")
# Iterations of a full run: all degrees of spherical harmonics, then a step with a density round.
ITERATIONS = (10_001, 10_100)
SURFELS = 200
PACKAGED = ("nvidia/cu13/compute-sanitizer", "nvidia/cuda_sanitizer_api/bin")  # nvidia-cuda-sanitizer-api, by version
PLACES = ("/usr/local/cuda/bin", "/usr/local/cuda/compute-sanitizer", "/opt/cuda/bin")
VERSION = re.compile(r"^Version (\d+(?:\.\d+)+)", re.M)
BROKEN_RACECHECK = "2025.3."  # CUDA 13.0's ends with an internal error, whichever kernels it checks
# Racecheck checks shared memory; restricted to our kernels, since others are slow to check and give false reports.
OURS = ("--kernel-name", "kernel_substring=_cuda_kernel_")
SUMMARIES = (
    re.compile(r"^=+ RACECHECK SUMMARY: (?P<hazards>\d+) hazards? displayed \((?P<errors>\d+) errors?, .*\)", re.M),
    re.compile(r"^=+ ERROR SUMMARY: (?P<errors>\d+) errors?", re.M),
)
SHOWN = 30  # lines of a report that found errors


@dataclass(frozen=True)
class Report:
    """The result of a tool.

    Attributes:
        errors: how many; None when the tool printed no summary.
        told: the summary, or the last line in its place.
        code: exit code of the command.
    """

    errors: int | None
    told: str
    code: int = 0

    @property
    def clean(self) -> bool:
        """Whether the tool ran to its end and found no error."""
        return self.errors == 0 and self.code == 0


def parse(output: str) -> Report:
    """Read the output of compute-sanitizer."""
    for summary in SUMMARIES:
        found = list(summary.finditer(output))
        if found:
            # One summary per process: Python may start several.
            return Report(sum(int(match["errors"]) for match in found), found[-1][0].strip("= "))
    said = [line.strip("= ") for line in output.splitlines() if line.startswith("=") and line.strip("= ")]
    return Report(None, said[-1] if said else "no output of compute-sanitizer")


def kernels_at_fault(output: str) -> list[str]:
    """Return a line for each kernel and place that printed errors name, most errors first."""
    found = Counter(re.findall(r"^=+\s+at (.+?\+0x[0-9a-f]+)", output, re.M))
    return [f"{count:>8} printed errors at {place}" for place, count in found.most_common()]


def find_tool() -> str | None:
    """Return the path of compute-sanitizer: installed by pip, on the PATH, or in a CUDA toolkit; None without one."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    packages = [str(Path(folder) / place) for folder in sys.path for place in PACKAGED]
    places = [os.environ.get("PATH", ""), *([f"{home}/bin", f"{home}/compute-sanitizer"] if home else [])]
    return shutil.which("compute-sanitizer", path=os.pathsep.join([*packages, *places, *PLACES]))


def version_of(sanitizer: str) -> str:
    """Return the version that a compute-sanitizer tells, such as "2026.4.0"."""
    told = subprocess.run([sanitizer, "--version"], capture_output=True, text=True, errors="replace").stdout
    found = VERSION.search(told)
    return found[1] if found else "of an unknown version"


def work(device: torch.device) -> dict[str, int]:
    """Train, as by default and with fixed-order sums, and render; returns how many of each there were."""
    scene = warmup.tiny_scene()
    base = preset("default")
    config = dataclasses.replace(
        base,
        max_surfels=SURFELS,
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
    with torch.no_grad():
        for camera in (scene.test[0].camera.to(device), scene.test[0].camera.to(device).crop(-5, 7, 33, 50)):
            out = model.render(camera)
            out.splat_error(out.alpha)
            if not bool(torch.isfinite(out.image).all()):
                raise RuntimeError("the frame is not finite")
            done["frames"] += 1
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return done


@contextmanager
def plain_products() -> Iterator[None]:
    """Multiply matrices by torch's own kernels: initcheck does not see what cuBLAS writes on a Hopper GPU."""
    whole = torch.Tensor.__matmul__

    def matmul(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        if min(a.dim(), b.dim()) < 2:
            return whole(a, b)
        wide = torch.promote_types(a.dtype, torch.float32)
        return (a.to(wide)[..., None] * b.to(wide)[..., None, :, :]).sum(-2).to(a.dtype)

    def mm(
        a: torch.Tensor, b: torch.Tensor, *, out_dtype: torch.dtype | None = None, out: torch.Tensor | None = None
    ) -> torch.Tensor:
        found = matmul(a.to(out_dtype or a.dtype), b.to(out_dtype or b.dtype))
        return found if out is None else out.copy_(found)

    def activated(bias: torch.Tensor, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (bias + matmul(a, b)).relu()

    with (
        patch.object(torch.Tensor, "__matmul__", matmul),
        patch.object(torch, "mm", mm),
        patch.object(torch, "_addmm_activation", activated),
    ):
        yield


def isolate_arrays(device: torch.device) -> None:
    """Make each array on a GPU an allocation of its own; must come before the first one."""
    os.environ["PYTORCH_NO_CUDA_MEMORY_CACHING"] = "1"
    if device.type == "cuda":
        wp.init()
        wp.set_mempool_enabled(f"cuda:{device.index}", False)


def check(tool: str, sanitizer: str, command: Sequence[str], extra: Sequence[str] = ()) -> Report:
    """Run a command under a tool, print its result in one piece, and return it."""
    options = [*(OURS if tool == "racecheck" else ()), *extra]
    environment = os.environ | {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
    run = subprocess.run(
        [sanitizer, "--tool", tool, *options, *command],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )
    report = dataclasses.replace(parse(run.stdout), code=run.returncode)
    code = "" if run.returncode == 0 else f", exit code {run.returncode}"
    told = [f"{tool}: {report.told}{code}: {'clean' if report.clean else 'NOT CLEAN'}"]
    if not report.clean:
        told += kernels_at_fault(run.stdout)
        lines = [line for line in run.stdout.splitlines() if line.strip()]
        first = next((i for i, line in enumerate(lines) if line.startswith("========= ") and i), 0)
        told += lines[first : first + SHOWN] if report.errors else lines[-SHOWN:]
    print("\n".join(told), flush=True)
    return report


@dataclass
class Sanitize:
    """Train and render a little; under compute-sanitizer with --tool."""

    tool: Annotated[str | None, tyro.conf.arg(metavar="TOOL,...")] = None
    """Tools of compute-sanitizer to run this under: memcheck, racecheck, initcheck, synccheck. Default: none."""
    device: Annotated[str, tyro.conf.arg(metavar="{cuda,cpu}")] = "cuda"
    """Where; compute-sanitizer sees CUDA alone."""
    sweep: bool = False
    """Also launch every kernel of the catalogue, with K of 0 to 8 and images of odd sizes."""
    parts: int = 1
    """With --tool: parts of the sweep, a process each, for each tool."""
    jobs: int = 4
    """With --tool: processes at a time; each keeps a CPU core busy."""
    part: int | None = None
    """Do this one of the parts alone, from 0 on."""
    extra: Annotated[str, tyro.conf.arg(metavar="OPTIONS")] = ""
    """More options for compute-sanitizer, such as "--report-api-errors no"."""
    plain_products: bool = False
    """Multiply matrices without cuBLAS, as --tool initcheck does."""
    compile_first: bool = False
    """Compile the kernels of the catalogue first, several at a time."""

    def __call__(self) -> int:
        """Run, print, and return the exit code."""
        if self.tool is not None:
            return self._under(self.tool.split(","))
        wp.config.log_level = wp.LOG_ERROR
        if self.device == "cuda" and not torch.cuda.is_available():
            print("device: expected a CUDA device, found none", file=sys.stderr)
            return 2
        if self.parts < 1 or not 0 <= (self.part or 0) < self.parts:
            print(f"--part: expected 0 to {self.parts - 1}, got {self.part}", file=sys.stderr)
            return 2
        device = torch.device("cuda", torch.cuda.current_device()) if self.device == "cuda" else torch.device("cpu")
        if self.compile_first:
            compile_catalogue(device)
        isolate_arrays(device)
        with plain_products() if self.plain_products else nullcontext():
            return self._work(device)

    def _work(self, device: torch.device) -> int:
        if not self.part:
            done = work(device)
            print(f"{done['steps']} training steps and {done['frames']} frames on {self.device}", flush=True)
        if not self.sweep:
            return 0
        swept = sweep(device, part=(0, 1) if self.part is None else (self.part, self.parts))
        print(f"{swept.kernels} kernels in {swept.renderings} renderings on {self.device}", flush=True)
        if self.part is not None:
            return 0
        if swept.missing:
            print(f"not launched: {', '.join(swept.missing)}", file=sys.stderr)
        return 1 if swept.missing else 0

    def _under(self, tools: list[str]) -> int:
        if others := [tool for tool in tools if tool not in TOOLS]:
            print(f"--tool: expected some of {', '.join(TOOLS)}, got {others[0]!r}", file=sys.stderr)
            return 2
        if self.jobs < 1:
            print(f"--jobs: expected at least 1, got {self.jobs}", file=sys.stderr)
            return 2
        sanitizer = find_tool()
        if sanitizer is None:
            print("compute-sanitizer: expected on the PATH or in a CUDA toolkit, found none", file=sys.stderr)
            return 2
        version = version_of(sanitizer)
        print(f"compute-sanitizer {version}: {sanitizer}", flush=True)
        if "racecheck" in tools and version.startswith(BROKEN_RACECHECK):
            told = "pip install nvidia-cuda-sanitizer-api==13.5.25"
            print(f"--tool racecheck: expected another version, such as 2026.4, got {version}: {told}", file=sys.stderr)
            return 2
        command = [sys.executable, "-m", "benchmarks.sanitize", "--device", self.device]
        command += ["--sweep"] * self.sweep
        # Once without a tool, to compile all kernels and to see that the work runs at all.
        alone = subprocess.run([*command, *["--compile-first"] * self.sweep])
        if alone.returncode != 0:
            print(f"without a tool it ended with exit code {alone.returncode}", file=sys.stderr)
            return 1
        shares = [["--parts", str(self.parts), "--part", str(i)] for i in range(self.parts)] if self.parts > 1 else [[]]
        jobs = [(t, [*share, *["--plain-products"] * (t == "initcheck")]) for t in tools for share in shares]
        with ThreadPoolExecutor(self.jobs) as pool:
            reports = list(pool.map(lambda job: check(job[0], sanitizer, command + job[1], self.extra.split()), jobs))
        unknown = sum(report.errors is None for report in reports)
        told = f"{sum(report.errors or 0 for report in reports)} errors found in {len(reports) - unknown} runs"
        print(told + (f"; {unknown} ended without a summary" if unknown else ""), flush=True)
        return 0 if all(report.clean for report in reports) else 1


if __name__ == "__main__":
    sys.exit(tyro.cli(Sanitize)())
