"""Cold start: a fresh process with empty kernel caches, as after an install."""

import json
import os
import subprocess
import sys
import tempfile

from benchmarks.suite import Options
from benchmarks.timing import ROOT, Measurement, figure

# Times each part; the frame is small, so that compiling and loading dominate.
PROGRAM = """
import json, sys, time
seconds = {}
def lap(name, since):
    if device == "cuda":
        torch.cuda.synchronize()
    seconds[name] = time.perf_counter() - since
    return time.perf_counter()
device = sys.argv[1]
start = time.perf_counter()
import torch
import nexwarp as nw
from benchmarks.scenes import cloud, texture
start = lap("imports", start)
scene = cloud(500, 64, 48).to(device)
field = texture(scene)
start = lap("scene and CUDA context", start)
with torch.no_grad():
    nw.render(scene.surfels, field, scene.camera)
start = lap("first frame", start)
with torch.no_grad():
    nw.render(scene.surfels, field, scene.camera)
start = lap("second frame", start)
nw.render(scene.surfels, field, scene.camera).image.sum().backward()
lap("first frame + backward", start)
print(json.dumps(seconds))
"""


def run(options: Options) -> list[Measurement]:
    """Time a process with empty and with filled caches."""
    with tempfile.TemporaryDirectory() as cache:
        return [m for state in ("empty", "filled") for m in parts(state, cache, options)]


def parts(state: str, cache: str, options: Options) -> list[Measurement]:
    """Return the seconds of each part of PROGRAM with kernel caches in a folder."""
    line = fresh_process([sys.executable, "-c", PROGRAM, options.device.type], cache)
    return [
        figure(f"{name}, {state} cache", value, options.device, unit="s", scene="fresh process")
        for name, value in json.loads(line).items()
    ]


def fresh_process(command: list[str], cache: str) -> str:
    """Run a command with kernel caches in a folder; return the last line that it prints."""
    environment = os.environ | {"WARP_CACHE_PATH": f"{cache}/warp", "CUDA_CACHE_PATH": f"{cache}/cuda"}
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the fresh process failed:\n{done.stderr}")
    return done.stdout.splitlines()[-1]
