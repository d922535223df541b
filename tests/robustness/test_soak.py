"""Memory, open files and threads stay as they are over steps and frames; NEXWARP_SOAK=40 makes 40 times as many."""

import os

import psutil
import pytest
import torch
import warp as wp

import nexwarp as nw
from nexwarp.model.buffers import render_buffers
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from nexwarp.train.trainer import Trainer
from tests.rehearsal import tiny_scene

TIMES = int(os.environ.get("NEXWARP_SOAK", "1"))
STEPS, FRAMES = 240 * TIMES, 240 * TIMES
TOLERANCE, SLACK = 0.01, 2**18  # a share, and bytes: memory grows by pages and segments
SIZES = ((1.0, 0.75), (0.67, 0.5), (0.34, 0.73), (0.84, 0.26), (0.5, 0.5), (1.0, 0.18), (0.17, 0.17))  # of the width
# Surfels are added in rounds until the end, within a budget that is reached soon.
DENSIFY = DensifyConfig(start=0, stop=60_000, every=30, fraction=1.0, prune_opacity=0.02)
TEXTURE = TextureConfig(levels=8, table_size=2**13, width=32)
CONFIG = Config(iterations=STEPS, max_surfels=400, sh_every=1, texture=TEXTURE, densify=DENSIFY)


def memory(device: torch.device) -> dict[str, float]:
    """Bytes of host and GPU memory, and numbers of open files and threads of this process."""
    process = psutil.Process()
    kinds = {"host": process.memory_info().rss, "files": process.num_fds(), "threads": process.num_threads()}
    if device.type == "cuda":
        kinds |= {"allocated": torch.cuda.memory_allocated(device), "reserved": torch.cuda.memory_reserved(device)}
        kinds["Warp's pool"] = wp.get_mempool_used_mem_current(f"cuda:{torch.cuda.current_device()}")
    return kinds


def grown(samples: list[dict[str, float]]) -> dict[str, tuple[float, float]]:
    """Kinds whose means in the second and in the last quarter differ, with these; the first quarter is a warm-up."""
    quarter = max(len(samples) // 4, 1)
    found = {}
    for name in samples[0]:
        parts = samples[quarter : 2 * quarter], samples[-quarter:]
        first, last = (sum(kinds[name] for kinds in part) / quarter for part in parts)
        slack = 0.5 if name in ("files", "threads") else max(TOLERANCE * first, SLACK)
        if abs(last - first) > slack:
            found[name] = first, last
    return found


@pytest.mark.timeout(0)
def test_steps_and_frames_leave_memory_as_it_is(device, tmp_path):
    """Frames with and without gradients, of a model loaded each time, from changing cameras and of changing sizes."""
    scene, samples = tiny_scene(), []
    trainer = Trainer(scene, CONFIG, device)
    trainer.run(lambda step: samples.append(memory(device)))
    assert not grown(samples)
    file = trainer.finish().save(tmp_path)
    generator, samples = torch.Generator().manual_seed(0), []
    for i in range(FRAMES):
        camera = scene.train[0].camera.to(device)
        width, height = (max(round(camera.width * share), 1) for share in SIZES[i % len(SIZES)])
        left, top = ((torch.rand(2, generator=generator) * 0.4 - 0.1) * camera.width).int().tolist()
        model, camera = nw.load(file).to(device), camera.crop(left, top, width, height)
        if i % 3 == 0:
            model.render(camera).image.square().sum().backward()
        elif i % 3 == 1:
            with torch.inference_mode():
                model.render(camera)
        else:
            render_buffers(model, camera)
        samples.append(memory(device))
    assert not grown(samples)
