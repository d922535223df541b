import copy
from collections.abc import Callable

import pytest
import torch
import torch.utils.checkpoint

import nexwarp as nw
from nexwarp.kernels import launch
from nexwarp.model.buffers import PASSES, render_buffers
from nexwarp.train.trainer import Trainer
from tests.narrowing import neural, present
from tests.render_support import BACKGROUND, BUFFERS, assert_same, cameras, finished, loss
from tests.tolerances import assert_close, assert_equal
from tests.trainer_support import assert_same_state, small

pytestmark = pytest.mark.usefixtures("fixed_order")
SECOND = r"^second derivatives are not supported"
HALVES = [torch.bfloat16, torch.float16]


def model_of(device: torch.device, *, bare: bool = False) -> tuple[nw.Model, nw.Camera]:
    """A model with texture, exposures with vignetting and detail limits; and a camera that wants a gradient."""
    model, camera = finished(device), cameras(device, 1)[0]
    camera.viewmat.requires_grad_()
    return nw.Model(model.surfels, model.texture) if bare else model, camera


def gradients(model: nw.Model, camera: nw.Camera) -> dict[str, torch.Tensor]:
    """Render, differentiate and return the gradients of all parameters and of the camera."""
    model.zero_grad()
    camera.viewmat.grad = None
    loss(model.render(camera, background=BACKGROUND)).backward()
    found = {name: present(x.grad).clone() for name, x in model.named_parameters()}
    return found | {"viewmat": present(camera.viewmat.grad).clone()}


@pytest.mark.usefixtures("restore_threads")
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


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("bare", [False, True])
def test_autocast_changes_nothing(dtype, bare, device):
    """The backward pass inside of the region, too: on CUDA, torch differentiates the camera's matrix in half there."""
    model, camera = model_of(device, bare=bare)
    for half in (True, False):
        neural(model.texture).half_precision = half  # of the MLP on CUDA
        expected, wanted = model.render(camera, background=BACKGROUND), gradients(model, camera)
        with torch.autocast(device.type, dtype=dtype):
            out = model.render(camera, background=BACKGROUND)
            assert_same(out, expected, (*BUFFERS, "normals", "colors", "expected_depth"))
            assert all(getattr(out, name).dtype == torch.float32 for name in BUFFERS)
            found = gradients(model, camera)
        if device.type == "cuda":
            exact, rounded = wanted.pop("viewmat"), found.pop("viewmat")
            assert (rounded - exact).abs().max() < 0.02 * exact.abs().max()
        assert_equal(found, wanted)


def test_training_in_inference_mode_or_autocast_is_that_outside(tiny_scene, device):
    runs = [Trainer(tiny_scene, small(deterministic=True), device) for _ in range(2)]
    for i in range(4):
        runs[0].step()
        with torch.inference_mode():
            runs[1].model().render(runs[1].views.cameras[i % 2])
        with torch.autocast(device.type, dtype=HALVES[i % 2]):
            runs[1].step()
    assert_same_state(*runs)
    expected = runs[0].finish()
    with torch.autocast(device.type, dtype=torch.float16):
        finished = runs[1].finish()
    assert_equal(finished.state_dict(), expected.state_dict())


@pytest.mark.parametrize("dtype", HALVES)
def test_parameters_in_half_precision_are_refused(dtype, device):
    model, camera = model_of(device)
    with pytest.raises(TypeError, match=f"^surfels: expected float32 or float64 .*, got {dtype}"):
        copy.deepcopy(model).to(dtype).render(camera)
    with pytest.raises(TypeError, match=f"^texture.grid: expected dtype torch.float32, got {dtype}"):
        nw.render(model.surfels, copy.deepcopy(neural(model.texture)).to(dtype), camera)


# Transforms: the table of docs/python.md, row by row


def drawings(device: torch.device) -> tuple[dict[str, Callable[[torch.Tensor], torch.Tensor]], torch.Tensor]:
    """Sums of renderings in the three ways of asking for one, as functions of a plain tensor; and such a tensor."""
    model, camera = model_of(device)
    means, quats, scales, opacities, gammas = (x.detach() for x in model.surfels.activated())

    def rasterized(means: torch.Tensor) -> torch.Tensor:
        hits = nw.rasterize(means, quats, scales, opacities, gammas, means.cos(), camera)
        return nw.compose(hits, hits.points.sin(), 0.5).square().mean()

    return {
        "render": lambda x: (nw.render(model.surfels, model.texture, camera).image * x.cos().mean()).square().mean(),
        "model": lambda x: (model.render(camera).image * x.cos().mean()).square().mean(),
        "rasterize": rasterized,
    }, means.requires_grad_()


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")  # torch's own, of its guards
@pytest.mark.parametrize("name", ["render", "model", "rasterize"])
def test_compiled_code_calls_a_rendering_as_it_is(name, device):
    draws, means = drawings(device)
    expected = draws[name](means)
    value = torch.compile(draws[name], backend="aot_eager")(means)  # warnings are errors
    assert_close(value, expected, kind="value", name=name)
    assert_close(*[torch.autograd.grad(x, means)[0] for x in (value, expected)], kind="gradient", name=name)
    with pytest.raises(Exception, match=r"intentionally marked|torch\.compiler\.disable"):  # of torch 2.15
        torch.compile(draws[name], backend="eager", fullgraph=True)(means)


def test_second_derivatives_raise(device):
    """Of every parameter, whether all gradients or one alone are asked for; never a constant without a word."""
    model, camera = model_of(device, bare=True)
    for x in (*model.surfels.parameters(), neural(model.texture).grid, camera.viewmat):
        out = model.render(camera)
        total = out.image.sum() if x is neural(model.texture).grid else out.image.sum() + out.expected_depth.sum()
        (grad,) = torch.autograd.grad(total, x, create_graph=True)
        with pytest.raises(RuntimeError, match=SECOND):
            torch.autograd.grad(grad.sum(), x, retain_graph=True)
        with pytest.raises(RuntimeError, match=SECOND):
            (grad.sum() + x.sum()).backward()


def test_checkpoint_draws_again(device):
    draws, means = drawings(device)
    for draw in draws.values():
        again = torch.utils.checkpoint.checkpoint(draw, means, use_reentrant=False)
        assert torch.equal(*(torch.autograd.grad(x, means)[0] for x in (again, draw(means))))
