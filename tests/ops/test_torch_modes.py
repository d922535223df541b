"""Rendering inside of torch's modes: inference mode and autocast change neither a bit nor a later training."""

import copy
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.kernels import launch
from nexwarp.machine import deterministic
from nexwarp.model.buffers import PASSES, render_buffers
from nexwarp.model.exposures import Exposures
from nexwarp.train.trainer import Trainer
from tests.narrowing import present
from tests.render_support import BACKGROUND, BUFFERS, assert_same, loss
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.trainer_support import assert_same_state, small

HALVES = [torch.bfloat16, torch.float16]


@pytest.fixture(autouse=True)
def fixed_order(device: torch.device) -> Iterator[None]:
    """On CUDA without atomics, whose order differs from one launch to the next."""
    with deterministic(device.type == "cuda"):
        yield


def model_of(device: torch.device, *, finished: bool = True) -> tuple[nw.Model, nw.Camera]:
    """A model with texture, exposures with vignetting and detail limits; and a camera."""
    scene = random_scene(60, device=device, width=61, height=45)
    surfels, camera = make_surfels(scene), make_camera(scene)
    if not finished:
        return nw.Model(surfels, make_texture(device=device)), camera
    cameras = [camera.to("cpu"), nw.Camera(torch.eye(4), camera.K.cpu(), camera.width, camera.height)]
    exposures = Exposures.of(torch.tensor([[0.1, 0.0, -0.1], [0.0, 0.2, 0.1]]), cameras, (-0.2, -0.1, 0.5)).to(device)
    limits = nw.DetailLimits(torch.full((60,), 0.01, device=device), torch.full((60,), 0.05, device=device))
    return nw.Model(surfels, make_texture(device=device), exposures, limits), camera


def gradients(model: nw.Model, camera: nw.Camera) -> dict[str, torch.Tensor]:
    """Render, differentiate and return the gradients of all parameters and of the camera."""
    model.zero_grad()
    camera.viewmat.grad = None
    loss(model.render(camera, background=BACKGROUND)).backward()
    found = {name: present(x.grad).clone() for name, x in model.named_parameters()}
    return found | {"viewmat": present(camera.viewmat.grad).clone()}


def assert_equal(actual: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    assert actual.keys() == expected.keys()
    different = [name for name, x in expected.items() if not torch.equal(actual[name], x)]
    assert not different, different


# Inference mode


@pytest.mark.usefixtures("restore_launch_threads")
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_inference_mode_gives_the_bits_of_no_grad(threads, device):
    launch.set_num_threads(threads)
    model, camera = model_of(device)
    for max_hits in (0, 1, 2, 8):
        with torch.no_grad():
            bare = nw.render(model.surfels, model.texture, camera, max_hits, BACKGROUND)
            whole = model.render(camera, max_hits=max_hits)
            buffers = render_buffers(model, camera, max_hits=max_hits)
        with torch.inference_mode():
            assert_same(nw.render(model.surfels, model.texture, camera, max_hits, BACKGROUND), bare)
            assert_same(model.render(camera, max_hits=max_hits), whole)
            again = render_buffers(model, camera, max_hits=max_hits)
        assert_same(again, buffers, PASSES)
        assert again.image.is_inference() and not buffers.image.is_inference()


def test_inference_mode_leaves_nothing_to_a_later_training(device):
    """The first rendering of the model and of its size, which fills all caches, is one in inference mode."""
    model, camera = model_of(device)
    with torch.inference_mode():
        model.render(camera)
        render_buffers(model, camera)
    after = gradients(model, camera)
    fresh, camera = model_of(device)
    assert_equal(after, gradients(fresh, camera))
    with torch.inference_mode():
        fresh.render(camera)
    assert_equal(gradients(fresh, camera), after)


@pytest.mark.usefixtures("one_torch_thread")
def test_training_goes_on_after_a_rendering_in_inference_mode(tiny_scene, device):
    runs = [Trainer(tiny_scene, small(deterministic=True), device) for _ in range(2)]
    for _ in range(4):
        with torch.inference_mode():
            runs[1].model().render(runs[1].views.cameras[0])
            runs[1].model().render(runs[1].views.cameras[1].crop(3, 2, 17, 9))
        for run in runs:
            run.step()
    assert_same_state(*runs)


def test_a_rendering_of_inference_mode_can_be_read_outside(device):
    model, camera = model_of(device)
    with torch.inference_mode():
        out = model.render(camera)
    with torch.no_grad():
        expected = model.render(camera)
    assert_same(out, expected, ("expected_depth", "median_depth", "top_depth", "normals", "colors"))


# Autocast


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("finished", [False, True], ids=["bare", "finished"])
def test_autocast_changes_nothing(dtype, finished, device):
    """The backward pass is outside of the region, as torch advises; see below for one inside."""
    model, camera = model_of(device, finished=finished)
    for half in (True, False):
        present(model.texture).half_precision = half  # of the MLP on CUDA
        expected, wanted = model.render(camera, background=BACKGROUND), gradients(model, camera)
        with torch.autocast(device.type, dtype=dtype):
            out = model.render(camera, background=BACKGROUND)
            assert_same(out, expected, (*BUFFERS, "normals", "colors", "expected_depth"))
            assert all(getattr(out, name).dtype == torch.float32 for name in BUFFERS)
            total = loss(out)
        model.zero_grad()
        camera.viewmat.grad = None
        total.backward()
        found = {name: present(x.grad) for name, x in model.named_parameters()}
        assert_equal(found | {"viewmat": present(camera.viewmat.grad)}, wanted)


@pytest.mark.parametrize("dtype", HALVES)
def test_a_backward_pass_inside_of_autocast_gives_the_same_gradients(dtype, device):
    """On CUDA torch itself differentiates two products of the camera's matrix in half precision there."""
    model, camera = model_of(device, finished=False)
    wanted = gradients(model, camera)
    with torch.autocast(device.type, dtype=dtype):
        found = gradients(model, camera)
    if device.type == "cuda":
        exact, rounded = wanted.pop("viewmat"), found.pop("viewmat")
        assert (rounded - exact).abs().max() < 0.02 * exact.abs().max()
    assert_equal(found, wanted)


@pytest.mark.parametrize("dtype", HALVES)
def test_the_texture_alone_ignores_autocast(dtype, device):
    texture, generator = make_texture(device=device), torch.Generator().manual_seed(0)
    texture.half_precision = False
    positions = torch.randn(50, 2, 3, generator=generator).to(device).requires_grad_()
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator), dim=-1).to(device)
    depths = torch.ones(50, 2, device=device)

    def evaluate() -> list[torch.Tensor]:
        colors, coefficients = texture.colors(positions, depths, directions, 24.0), texture(positions, depths, 24.0)
        assert colors.dtype == coefficients.dtype == torch.float32
        total = colors.square().sum() + coefficients.square().sum()
        return [colors, coefficients, *torch.autograd.grad(total, list(texture.mlp.parameters()))]

    expected = evaluate()
    with torch.autocast(device.type, dtype=dtype):
        assert all(torch.equal(a, b) for a, b in zip(evaluate(), expected, strict=True))


@pytest.mark.usefixtures("one_torch_thread")
def test_training_steps_inside_of_autocast_are_those_outside(tiny_scene, device):
    runs = [Trainer(tiny_scene, small(deterministic=True), device) for _ in range(2)]
    for i in range(4):
        runs[0].step()
        with torch.autocast(device.type, dtype=HALVES[i % 2]):
            runs[1].step()
    assert_same_state(*runs)
    expected = runs[0].finish()
    with torch.autocast(device.type, dtype=torch.float16):
        finished = runs[1].finish()
    assert_equal(finished.state_dict(), expected.state_dict())


# Half precision


@pytest.mark.parametrize("dtype", HALVES)
def test_parameters_in_half_precision_are_refused(dtype, device):
    model, camera = model_of(device)
    part: Callable[[], Any]
    for part, line in (
        (
            lambda: copy.deepcopy(model).to(dtype).render(camera),
            f"surfels: expected float32 or float64 .*, got {dtype}",
        ),
        (
            lambda: nw.render(model.surfels, copy.deepcopy(present(model.texture)).to(dtype), camera),
            f"texture.grid: expected dtype torch.float32, got {dtype}",
        ),
        (
            lambda: nw.render(model.surfels, None, camera, background=torch.zeros(3, dtype=dtype, device=device)),
            f"background: expected dtype torch.float32, got {dtype}",
        ),
    ):
        with pytest.raises(TypeError, match=f"^{line}"):
            part()
