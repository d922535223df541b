"""SIMD vectors calculate what torch does, each group of snippets by itself; SIMD forms agree with the others."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
import warp as wp

from nexwarp.kernels import launch
from nexwarp.native.simd import simd_functions
from tests.ops.test_threads import Passes, errors_of
from tests.scenes import Scene, layered_scene, random_scene
from tests.simd_kernels import ARITHMETIC, WIDTH, function_kernel, masks_kernel, slots_kernel
from tests.tolerances import assert_close

REALS = {torch.float32: wp.float32, torch.float64: wp.float64}
FORMS: tuple[launch.CpuForm, ...] = ("simd", "scalar")
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])

# What `simd_kernels._function` calculates, by name.
EXPECTED: dict[str, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
    "times": lambda a, b: a * b,
    "over": lambda a, b: a / b,
    "scaled": lambda a, b: b[:, :1] * a + b[:, 1:2],
    "exp": lambda a, b: a.exp(),
    "exp2": lambda a, b: a.exp2(),
    "log2": lambda a, b: a.log2(),
    "pick": lambda a, b: torch.where(a < b, a, b),
    "at_least": lambda a, b: a.clamp_min(1.0),
    "at_most": lambda a, b: a.clamp_max(1.0),
}


def positive(dtype: torch.dtype, count: int = 5) -> torch.Tensor:
    """Random vectors (count, WIDTH) from 0.1 to 10."""
    return (10.0 ** (2 * torch.rand(count, WIDTH, dtype=torch.float64) - 1)).to(dtype)


def as_vectors(tensor: torch.Tensor) -> "wp.array[Any]":
    """View (..., WIDTH) reals or integers as SIMD vectors."""
    wp.init()
    integral = not tensor.is_floating_point()
    wide = tensor.element_size() == 8
    f = simd_functions(wp.float64 if wide else wp.float32, WIDTH)
    array = wp.from_torch(tensor, dtype=f.integers if integral else f.reals)
    assert isinstance(array, wp.array)
    return array


def run(kernel: wp.Kernel, *tensors: torch.Tensor) -> None:
    """Launch over the vectors of the first tensor."""
    wp.launch(kernel, len(tensors[0]), inputs=[as_vectors(x) for x in tensors], device="cpu", record_tape=False)


# The snippets


@DTYPES
@pytest.mark.parametrize("name", ARITHMETIC)
def test_functions_and_their_adjoints(name: str, dtype: torch.dtype) -> None:
    a, b, g = positive(dtype), positive(dtype), positive(dtype)
    values, grad_a, grad_b = (torch.zeros_like(a) for _ in range(3))
    run(function_kernel(REALS[dtype], name), a, b, g, values, grad_a, grad_b)
    leaves = [x.double().requires_grad_() for x in (a, b)]
    expected = EXPECTED[name](*leaves)
    grads = torch.autograd.grad((expected * g).sum(), leaves, allow_unused=True)
    assert_close(values, expected.detach(), kind="value", name=name)
    for found, grad in zip((grad_a, grad_b), grads, strict=True):
        assert_close(found, torch.zeros_like(a) if grad is None else grad, kind="gradient", name=name)


@DTYPES
def test_masks(dtype: torch.dtype) -> None:
    a, b = positive(dtype), positive(dtype)
    a[:, 0] = b[:, 0]  # neither below nor above
    a[0] = b[0] + 1  # nothing below
    masks = torch.zeros(8, 5, WIDTH, dtype=torch.int64 if dtype == torch.float64 else torch.int32)
    some = torch.zeros(2, 5, dtype=torch.int32)
    arrays = [as_vectors(a), as_vectors(b), as_vectors(masks), wp.from_torch(some)]
    wp.launch(masks_kernel(REALS[dtype]), 5, inputs=arrays, device="cpu", record_tape=False)
    low, high, same = a < b, a > b, a >= b
    truths = [low, high, same, low & same, low | high, low == high, low]
    for mask, truth in zip(masks, truths, strict=False):
        assert torch.equal(mask, -truth.to(mask))
    assert torch.equal(masks[7], torch.where(low, 3, 5).to(masks))
    assert some[0].tolist() == [0, 1, 1, 1, 1] and not some[1].any()


@DTYPES
def test_slots(dtype: torch.dtype) -> None:
    a, b = positive(dtype), positive(dtype)
    swapped, grads = torch.zeros(2, 5, WIDTH, dtype=dtype), torch.ones(2, 5, WIDTH, dtype=dtype)
    whole = torch.zeros(5, WIDTH, dtype=torch.int64 if dtype == torch.float64 else torch.int32)
    run(slots_kernel(REALS[dtype]), a, b, swapped, whole, grads)
    assert torch.equal(swapped, torch.stack([b, a]))
    assert (whole == 7).all()
    assert torch.equal(grads, torch.stack([torch.zeros_like(a), a]))


def test_exp_and_log_of_whatever_comes() -> None:
    """To 2 units in the last place; what has no value must not come out as one."""
    x = torch.cat([torch.linspace(-86, 86, 4001), torch.tensor([1e-20, 1e-8, 1e30, float("nan"), float("inf")])])
    x = torch.nn.functional.pad(x, (0, -len(x) % WIDTH)).view(-1, WIDTH).contiguous()
    exps, exps2, logs = (torch.zeros_like(x) for _ in range(3))
    for name, values in (("exp", exps), ("exp2", exps2), ("log2", logs)):
        run(function_kernel(wp.float32, name), x, x, x, values, *(torch.zeros_like(x) for _ in range(2)))
    x, exps, exps2, logs = (t.flatten()[:4006].double() for t in (x, exps, exps2, logs))
    fine = torch.isfinite(x) & (x.abs() <= 86)
    assert ((exps / x.exp() - 1).abs()[fine] < 2.4e-7).all()
    assert ((exps2 / x.exp2() - 1).abs()[fine] < 2.4e-7).all()
    above_0 = fine & (x > 0) | (x == 1e30)
    expected = x[above_0].log2()
    assert ((logs[above_0] - expected).abs() <= 2.4e-7 * expected.abs().clamp_min(1)).all()
    assert exps[-2].isnan() and exps2[-2].isnan() and logs[-2].isnan() and logs[-1].isnan()


# The forms


@pytest.mark.parametrize("form", ["Simd", "cuda", ""])
def test_a_form_that_is_none_is_refused(form: Any) -> None:
    with pytest.raises(ValueError, match=r"^form: expected 'simd' or 'scalar', got "), launch.cpu_form(form):
        pass


@pytest.mark.parametrize("layered", [False, True])
@pytest.mark.parametrize("low_pass", [False, True])
@pytest.mark.parametrize(("max_hits", "tile_size"), [(0, 16), (1, 8), (2, 16), (4, 16)])
@DTYPES
def test_both_forms_of_collection_agree(
    layered: bool, low_pass: bool, max_hits: int, tile_size: int, dtype: torch.dtype
) -> None:
    """Sizes that no strip or tile divides, so that some of their pixels lie outside the image."""
    size: dict[str, Any] = {} if layered else {"width": 61, "height": 45}
    scene: Scene = (layered_scene if layered else random_scene)(150, seed=3, dtype=dtype, **size)
    buffers, gradients, blended = [], [], []
    for form in FORMS:
        with launch.cpu_form(form):
            passes = Passes(scene, low_pass=low_pass, max_hits=max_hits, tile_size=tile_size)
            buffers.append(passes.buffers())
            gradients.append(passes.gradients())
            blended.append(passes.blended(errors_of(scene, dtype)))
    for name, value in buffers[1].items():
        if name == "ids":
            assert torch.equal(buffers[0][name], value)
        elif value.numel():
            assert_close(buffers[0][name], value, kind="value", name=name)
    for name, gradient in gradients[1].items():
        assert gradient.abs().max() > 0, name
        assert_close(gradients[0][name], gradient, kind="gradient", name=name)
    assert blended[1].any()
    assert_close(blended[0], blended[1], kind="value", name="blended errors")
