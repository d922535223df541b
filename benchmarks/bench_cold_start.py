"""Cold start: a fresh process with empty kernel caches, as after an install. What a user waits for."""

import json
import os
import subprocess
import sys
import tempfile

from benchmarks import suite
from benchmarks.suite import Options
from benchmarks.timing import ROOT, Measurement, figure

# Times each part; the frame is small, so that they are all compiling and loading.
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
    """Twice: with empty caches, then with what the first process left in them."""
    with tempfile.TemporaryDirectory() as cache:
        return [
            figure(f"{name}, {state} cache", value, options.device, unit="s", scene="fresh process")
            for state in ("empty", "filled")
            for name, value in fresh_process(options.device.type, cache).items()
        ]


def fresh_process(device: str, cache: str) -> dict[str, float]:
    """Seconds of each part of PROGRAM with kernel caches in a folder."""
    environment = os.environ | {"WARP_CACHE_PATH": f"{cache}/warp", "CUDA_CACHE_PATH": f"{cache}/cuda"}
    command = [sys.executable, "-c", PROGRAM, device]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the fresh process failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    sys.exit(suite.main({"cold_start": run}))
