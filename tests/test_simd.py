"""The kernels for CPUs, which take rows of pixels or points in SIMD lanes, agree with those that take one a thread."""

import importlib

import pytest
import torch

import nexwarp as nw
from nexwarp.kernels import launch
from nexwarp.kernels.native.simd import lane_functions
from tests.scenes import layered_scene, random_scene
from tests.test_threads import Passes
from tests.tolerances import assert_close


@pytest.fixture
def one_at_a_time(monkeypatch: pytest.MonkeyPatch):
    """Switch to the kernels for one pixel or point; their atomics are none on a CPU, so one thread must do."""

    def switch() -> None:
        for module in ("collect", "texture"):
            # By its full name: the package's attribute is the function of the same name.
            monkeypatch.setattr(importlib.import_module(f"nexwarp.ops.{module}"), "_rows_a_thread", lambda like: False)
        launch.set_num_threads(1)

    threads = launch.get_num_threads()
    yield switch
    launch.set_num_threads(threads)


@pytest.mark.parametrize("layered", [False, True])
@pytest.mark.parametrize("low_pass", [False, True])
@pytest.mark.parametrize(("max_hits", "tile_size"), [(0, 16), (1, 8), (2, 16), (4, 16)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_collection_by_rows_is_that_by_pixels(layered, low_pass, max_hits, tile_size, dtype, one_at_a_time):
    """Sizes that no row or tile divides, so that some lanes lie outside the image."""
    size = {} if layered else {"width": 61, "height": 45}
    scene = (layered_scene if layered else random_scene)(150, seed=3, dtype=dtype, **size)
    options = {"low_pass": low_pass, "max_hits": max_hits, "tile_size": tile_size}
    rows = Passes(scene, **options)
    buffers, gradients = rows.buffers(), rows.gradients()
    one_at_a_time()
    pixels = Passes(scene, **options)
    for name, value in pixels.buffers().items():
        if name == "ids":
            assert torch.equal(buffers[name], value)
        elif value.numel():
            assert_close(buffers[name], value, kind="value", name=name)
    for name, gradient in pixels.gradients().items():
        assert gradient.abs().max() > 0, name
        assert_close(gradients[name], gradient, kind="gradient", name=name)


@pytest.mark.parametrize("count", [1, 7, 8, 1003])
@pytest.mark.parametrize("features", [1, 2, 4])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lookup_by_rows_is_that_by_points(count, features, dtype, one_at_a_time):
    torch.manual_seed(0)
    texture = nw.NeuralTexture(4, 2**8, features, 1.0, 6.0, width=16).to(dtype)
    torch.nn.init.normal_(texture.grid)
    generator = torch.Generator().manual_seed(4)
    positions = (3 * torch.randn(count, 3, generator=generator, dtype=torch.float64)).to(dtype)
    depths = (1 + torch.rand(count, generator=generator, dtype=torch.float64)).to(dtype)
    depths[3::7] = 0.0  # points to skip
    results = []
    for _row in (True, False):
        leaves = [positions.clone().requires_grad_(), depths.clone().requires_grad_()]
        out = texture(*leaves, 24.0)
        factors = torch.randn(out.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
        grads = torch.autograd.grad((out * factors).sum(), [*leaves, *texture.parameters()])
        results.append([out.detach(), *grads])
        one_at_a_time()
    assert_close(results[0][0], results[1][0], kind="value", name="coefficients")
    for index, (row, point) in enumerate(zip(results[0][1:], results[1][1:], strict=True)):
        assert_close(row, point, kind="gradient", name=f"gradient {index}")


def test_lanes_know_exp_and_log_of_whatever_comes():
    """To 2 units in the last place; what has no value must not come out as one."""
    import warp as wp

    from tests.simd_kernels import exp_and_log_kernel

    x = torch.cat([torch.linspace(-86, 86, 4001), torch.tensor([1e-20, 1e-8, 1e30, float("nan"), float("inf")])])
    x = torch.nn.functional.pad(x, (0, -len(x) % 8)).view(-1, 8).contiguous()
    exps, logs = torch.zeros_like(x), torch.zeros_like(x)
    lane = lane_functions(wp.float32, 8).lane
    arrays = [wp.from_torch(t, dtype=lane) for t in (x, exps, logs)]
    wp.launch(exp_and_log_kernel(8), len(x), inputs=arrays, device="cpu", record_tape=False)
    x, exps, logs = (t.flatten()[:4006].double() for t in (x, exps, logs))
    fine = torch.isfinite(x) & (x.abs() <= 86)
    assert ((exps / x.exp() - 1).abs()[fine] < 2.4e-7).all()
    positive = fine & (x > 0) | (x == 1e30)
    expected = x[positive].log()
    assert ((logs[positive] - expected).abs() <= 2.4e-7 * expected.abs().clamp_min(1)).all()
    assert exps[-2].isnan() and logs[-2].isnan() and logs[-1].isnan()
