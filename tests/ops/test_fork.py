"""A process that was forked from one that has rendered and trained renders and differentiates as its parent does."""

import os
import signal

import pytest

from tests.subprocesses import run_python

SECONDS = 60  # after which a child hangs

PARENT = """
import multiprocessing, os, signal, sys, threading, warnings

warnings.simplefilter("ignore")  # Python 3.12 and later warn of a fork while there are threads
import torch

import nexwarp as nw
from nexwarp.kernels import launch
from tests.render_support import loss
from tests.scenes import make_camera, make_surfels, make_texture, random_scene

launch.set_num_threads(3)
torch.set_num_threads(3)  # so that OpenMP has threads, which do not survive a fork
scene = random_scene(200, width=160, height=120)
surfels, camera, texture = make_surfels(scene), make_camera(scene), make_texture()


def results():
    surfels.zero_grad()
    texture.zero_grad()
    out = nw.render(surfels, texture, camera, 2)
    loss(out).backward()
    total = torch.ones(2_000_000).exp().sum() + (torch.ones(400, 400) @ torch.ones(400, 400)).sum()  # torch's own loops
    return [out.image.detach(), surfels.means.grad.clone(), texture.grid.grad.clone(), total]


def child():
    signal.alarm(SECONDS)
    found = results()
    assert launch.get_num_threads() == 3
    assert all(torch.equal(a, b) for a, b in zip(found[:3], expected)), "other bits than in the parent"
    print("child", os.getpid() != parent, flush=True)


parent, expected = os.getpid(), results()
""".replace("SECONDS", str(SECONDS))

MULTIPROCESSING = """
process = multiprocessing.get_context("fork").Process(target=child)
process.start()
process.join()
assert process.exitcode == 0
"""

AFTER = """
assert torch.get_num_threads() == 3
assert all(torch.equal(a, b) for a, b in zip(results(), expected)), "the parent renders otherwise after the fork"
print("parent")
"""


pytestmark = pytest.mark.skipif(not hasattr(os, "fork") or not hasattr(signal, "alarm"), reason="no fork here")


def test_a_forked_process_renders_as_its_parent():
    done = run_python("-c", PARENT + MULTIPROCESSING + AFTER, timeout=3 * SECONDS)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.splitlines()[-2:] == ["child True", "parent"]
