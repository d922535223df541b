"""Faults of a GPU: too little memory, or a fault that ends the context. On a CPU they are played."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.errors import OutOfMemoryError
from nexwarp.model.buffers import PASSES, render_buffers
from nexwarp.model.graphs import StepGraphs, UpdateError
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from nexwarp.train.trainer import Trainer
from tests.faults import failing_gpu
from tests.narrowing import present
from tests.render_support import BACKGROUND, assert_same, loss
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.trainer_support import assert_same_state, small

pytestmark = pytest.mark.usefixtures("small_preset", "fixed_order")

SMALL = Config(texture=TextureConfig(levels=2, table_size=2**6, width=8), densify=DensifyConfig(every=2), sh_degree=1)
FLAGS = "--iterations 3 --max-surfels 24 --checkpoint-every 1 --deterministic --set cuda_graphs=false".split()
STEPS = 4  # of a training that lacks memory: a round of density control is the third
FAULTS = [
    "CUDA error: device-side assert triggered\nCUDA kernel errors might be asynchronously reported",
    "CUDA error: an illegal memory access was encountered\nFor debugging consider passing CUDA_LAUNCH_BLOCKING=1",
    "Warp CUDA error 719: unspecified launch failure (in function wp_cuda_launch_kernel)",
]


def chosen(count: int, device: torch.device) -> list[int]:
    """Some of `count` requests, the first and the last among them: few on the CPU, where the default run has them."""
    most = 60 if device.type == "cuda" else 12
    return sorted({0, count - 1, *random.Random(0).sample(range(count), min(count, most))})


def test_a_rendering_or_gradient_that_lacks_memory_can_be_repeated(device):
    scene = random_scene(40, device=device)
    model, camera = nw.Model(make_surfels(scene), make_texture(device=device)), make_camera(scene)

    def results() -> list[torch.Tensor]:
        model.zero_grad()
        camera.viewmat.grad = None
        buffers = render_buffers(model, camera)
        loss(model.render(camera, background=BACKGROUND)).backward()
        grads = [present(x.grad).clone() for x in (*model.parameters(), camera.viewmat)]
        return [*(getattr(buffers, name) for name in PASSES), *grads]

    expected = results()  # compiles, and fills the caches
    with failing_gpu() as counted:
        results()
    assert len(counted.requests) > 20
    failed, all_fatal = 0, chosen(len(counted.requests), device)
    for fatal in all_fatal:
        found = None
        try:
            with failing_gpu(fatal):
                found = results()  # on a GPU it may succeed: frames are launched where a graph lacks memory
        except (OutOfMemoryError, torch.OutOfMemoryError) as error:
            assert "2.00 GiB" in str(error)
            failed += 1
        for again in (found or expected, results()):
            assert all(torch.equal(a, b) for a, b in zip(again, expected, strict=True)), fatal
    assert failed == len(all_fatal) if device.type == "cpu" else failed > 0.2 * len(all_fatal)


def test_a_training_that_lacks_memory_goes_on_from_a_snapshot(tiny_scene, device):
    """It ends with our error or, where CUDA graphs can be given up, goes on; the end has the bits of no fault."""
    config = small(deterministic=True)
    expected, run = Trainer(tiny_scene, config, device), Trainer(tiny_scene, config, device)
    start = run.snapshot()
    with failing_gpu() as counted:
        expected.run(until=STEPS)
    failed = 0
    for fatal in chosen(len(counted.requests), device):
        run.load_snapshot(start)
        try:
            with failing_gpu(fatal):
                run.run(until=STEPS)
        except OutOfMemoryError as error:
            assert f"at iteration {run.iteration}: it needed 2.00 GiB" in str(error) and "\n" not in str(error)
            failed += 1
            run.load_snapshot(start)
            run.run(until=STEPS)
        assert_same_state(run, expected)
    assert failed > 5


def test_an_update_that_lacks_memory_is_not_repeated(tiny_scene, device, monkeypatch):
    """It would move some of the parameters twice. Graphs that hold memory allow to repeat other work."""
    trainer, full = Trainer(tiny_scene, small(), device), torch.OutOfMemoryError("Tried to allocate 2.00 GiB.")
    monkeypatch.setattr(trainer.optimizer, "step", Mock(side_effect=[full, RuntimeError("no driver")]))
    with pytest.raises(UpdateError, match=r"while the parameters were updated: needed 2\.00 GiB") as caught:
        trainer._update(None)
    holding = Mock(keeper=1)
    assert StepGraphs.can_repeat(holding, full) and not StepGraphs.can_repeat(holding, caught.value)
    with pytest.raises(RuntimeError, match=r"^no driver$"):
        trainer._update(None)


@contextmanager
def little_memory(device: torch.device) -> Iterator[None]:
    """Leave nothing of the GPU's memory for the block: no new segment, and no place in those that there are."""
    torch.cuda.synchronize(device)
    torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(device).total_memory
    held: list[torch.Tensor] = []
    torch.cuda.set_per_process_memory_fraction((torch.cuda.memory_reserved(device) + 2**20) / total, device)
    try:
        for size in (2**24, 2**21, 2**20 + 2**9, 2**20, 2**12, 2**9):
            while True:
                try:
                    held.append(torch.empty(size, dtype=torch.uint8, device=device))
                except torch.OutOfMemoryError:
                    break
        yield
    finally:
        held.clear()
        torch.cuda.set_per_process_memory_fraction(1.0, device)
        torch.cuda.empty_cache()


@pytest.mark.cuda
def test_a_gpu_that_is_full_refuses_a_rendering_and_then_gives_the_same_bits():
    device = torch.device("cuda", torch.cuda.current_device())
    scene = random_scene(40, device=device)
    model = nw.Model(make_surfels(scene), make_texture(device=device))
    camera = make_camera(scene, width=1024, height=768)
    with torch.no_grad():
        expected = model.render(camera)
        with little_memory(device):
            for _ in range(3):
                with pytest.raises(OutOfMemoryError, match=r"^out of memory: an image of 1024x768 pixels with K = 2"):
                    model.render(camera)
        assert_same(model.render(camera), expected)


@pytest.mark.cuda
@pytest.mark.parametrize("cuda_graphs", [False, True])
def test_a_gpu_that_is_full_ends_a_training_that_then_goes_on(tiny_scene, cuda_graphs):
    device = torch.device("cuda", torch.cuda.current_device())
    config = small(deterministic=True, cuda_graphs=cuda_graphs)
    expected, run = Trainer(tiny_scene, config, device), Trainer(tiny_scene, config, device)
    expected.run(until=8)
    run.run(until=5)
    state = run.snapshot()
    with little_memory(device), pytest.raises(OutOfMemoryError, match=r"^out of GPU memory at iteration "):
        run.run(until=8)
    run.load_snapshot(state)
    run.run(until=8)
    assert_same_state(run, expected)


# A fault that ends the GPU's context


def train(scene: Path, run: Path, device: torch.device, *flags: str) -> int:
    return cli.main(["train", str(scene), "--run", str(run), "--device", device.type, *FLAGS, *flags])


def test_a_fault_of_the_gpu_stops_training_and_the_last_checkpoint_is_resumed(tiny_folder, tmp_path, capsys, device):
    whole = tmp_path / "whole"
    with failing_gpu(None, "") as counted:
        assert train(tiny_folder, whole, device) == 0
    expected = (whole / "model.safetensors").read_bytes()
    requests = range(len(counted.requests) // 10, len(counted.requests))
    places = random.Random(1).sample(requests, 12 if device.type == "cuda" else 3)
    for fatal, message in zip(sorted(places), FAULTS * 4, strict=False):
        run = tmp_path / f"run{fatal}"
        capsys.readouterr()
        with failing_gpu(fatal, message):
            assert train(tiny_folder, run, device) == 3
        first = message.splitlines()[0]
        line = f"nexwarp: error: the GPU failed ({first}); --resume continues from the last checkpoint\n"
        assert capsys.readouterr().err == line and not list(run.rglob("*.tmp*"))
        if (run / "model.safetensors").exists():  # a fault of the evaluation
            assert (run / "model.safetensors").read_bytes() == expected, fatal
        assert train(tiny_folder, run, device, "--resume") == 0
        assert (run / "model.safetensors").read_bytes() == expected, fatal
