import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from tests.narrowing import total
from tests.scenes import make_surfels, random_scene
from tests.tolerances import assert_close, assert_finite

RAW = ("raw_quats", "log_scales", "logit_opacities", "raw_gammas")
ACTIVATED = ("quats", "scales", "opacities", "gammas")
DTYPES = [torch.float64, torch.float32]


def make_raw(count: int, dtype: torch.dtype, device: torch.device) -> nw.Surfels:
    """Surfels with normal raw values, quaternions of all lengths."""
    surfels = make_surfels(random_scene(count, dtype=torch.float64))
    with torch.no_grad():
        for name in RAW:
            getattr(surfels, name).normal_()
        surfels.raw_quats.mul_(torch.exp(torch.randn(count, 1, dtype=torch.float64)))
    return surfels.to(device=device, dtype=dtype)


def extremes(dtype: torch.dtype, device: torch.device) -> nw.Surfels:
    """Surfels at and beyond the ends of the ranges."""
    logits = torch.tensor([100.0, -100.0, 1000.0, -1000.0, 0.0, -0.0, 30.0, -30.0, 88.0, -88.0])
    surfels = make_raw(len(logits), torch.float32, torch.device("cpu"))
    lengths = torch.tensor([1e-6, 1e4, 1e-13, 1e-20, 0.0, 1e-11, 1e-3, 1e8, 1.0, 1e12])
    ends = torch.tensor([-60.0, -100.0, 80.0, 0.0, -1000.0, 40.0, -20.0, 1.0, -1.0, 60.0])
    with torch.no_grad():
        surfels.logit_opacities.copy_(logits)
        surfels.raw_quats.copy_(surfels.quats * lengths[:, None])
        surfels.log_scales.copy_(torch.stack([ends, ends.flip(0)], dim=1))
        surfels.raw_gammas.copy_(torch.stack([ends.roll(3), ends], dim=1))
    return surfels.to(device=device, dtype=dtype)


def signals(surfels: nw.Surfels) -> list[torch.Tensor]:
    """Fixed random gradients of what is activated."""
    generator = torch.Generator().manual_seed(3)
    shapes = (getattr(surfels, name) for name in RAW)
    return [torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x) for x in shapes]


def gradients(surfels: nw.Surfels, outputs: tuple[torch.Tensor, ...]) -> list[torch.Tensor]:
    return list(torch.autograd.grad(outputs, [getattr(surfels, name) for name in RAW], signals(surfels)))


def assert_exact(actual: torch.Tensor, expected: torch.Tensor, kind: str, name: str) -> None:
    """Each element to 1e-12 of its own size in float64, all together to the table's tolerance in float32."""
    if actual.dtype == torch.float64:
        torch.testing.assert_close(actual, expected, rtol=1e-12, atol=0.0)
    else:
        assert_close(actual, expected, kind=kind, name=name)


@pytest.mark.parametrize("dtype", DTYPES)
def test_activated_is_what_the_properties_are(dtype: torch.dtype, device: torch.device) -> None:
    surfels = make_raw(1000, dtype, device)
    activated = surfels.activated()
    assert activated._fields == ("means", *ACTIVATED) and activated.means is surfels.means
    for name in ACTIVATED:
        assert_exact(getattr(activated, name), getattr(surfels, name), "value", name)
    expected = gradients(surfels, tuple(getattr(surfels, name) for name in ACTIVATED))
    for name, actual, wanted in zip(RAW, gradients(surfels, activated[1:]), expected, strict=True):
        # Where the gradient along a quaternion nearly vanishes, its components are differences of larger numbers.
        if name == "raw_quats":
            assert_close(actual, wanted, kind="gradient", name=name)
        else:
            assert_exact(actual, wanted, "gradient", name)


@pytest.mark.parametrize("dtype", DTYPES)
def test_extremes_are_finite_and_what_torch_gives(dtype: torch.dtype, device: torch.device) -> None:
    """Relative to each value's own size, as the largest would hide the others."""
    surfels = extremes(dtype, device)
    activated = surfels.activated()
    outputs = tuple(getattr(surfels, name) for name in ACTIVATED)
    values = list(zip(ACTIVATED, activated[1:], outputs, strict=True))
    grads = list(zip(RAW, gradients(surfels, activated[1:]), gradients(surfels, outputs), strict=True))
    for name, ours, torchs in (*values, *grads):
        assert_finite(ours, name)
        assert_finite(torchs, name)
    for name, ours, torchs in (*values, *grads[1:]):
        if name == "logit_opacities":
            # Torch's derivative o (1 - o) has lost its digits where o is nearly 1.
            logits = surfels.logit_opacities.detach()
            torchs = signals(surfels)[2] * logits.sigmoid() * (-logits).sigmoid()
        rtol = 1e-12 if dtype == torch.float64 else 2e-6
        torch.testing.assert_close(ours, torchs, rtol=rtol, atol=torch.finfo(dtype).tiny)
    name, ours, torchs = grads[0]
    lengths = surfels.raw_quats.detach().norm(dim=-1, keepdim=True).clamp_min(1e-12)
    for row in range(len(surfels)):
        assert_close((ours * lengths)[row], (torchs * lengths)[row], kind="gradient", name=f"quaternion {row}")


def test_projection_takes_quaternions_of_any_length(device: torch.device) -> None:
    """Records and gradients are those of quaternions that torch has normalised."""
    scene = random_scene(100, dtype=torch.float64, device=device)
    quats = (scene["quats"] * torch.linspace(0.01, 100, 100, device=device)[:, None]).requires_grad_()
    rest = [scene[name] for name in ("scales", "opacities", "gammas")] + [scene["means"]]
    actual, expected = (
        ops.project(*[scene["means"], x, *rest, scene["viewmat"]]).records
        for x in (quats, torch.nn.functional.normalize(quats, dim=-1))
    )
    assert_close(actual, expected, kind="value", name="records")
    signal = torch.randn_like(actual)
    grads = (torch.autograd.grad(x, quats, signal)[0] * quats.norm(dim=1, keepdim=True) for x in (actual, expected))
    assert_close(*grads, kind="gradient", name="quats")


@pytest.mark.parametrize("wanted", RAW)
def test_one_gradient_alone(wanted: str, device: torch.device) -> None:
    surfels = make_raw(50, torch.float64, device)
    expected = dict(zip(RAW, gradients(surfels, surfels.activated()[1:]), strict=True))
    for name in RAW:
        getattr(surfels, name).requires_grad_(name == wanted)
    loss = total((x * g).sum() for x, g in zip(surfels.activated()[1:], signals(surfels), strict=True))
    loss.backward()
    for name in RAW:
        grad = getattr(surfels, name).grad
        assert torch.equal(grad, expected[name]) if name == wanted else grad is None, name


def test_strided_input_and_unused_outputs(device: torch.device) -> None:
    surfels = make_raw(20, torch.float64, device)
    raw = [getattr(surfels, name).detach() for name in RAW]
    strided = [x.repeat_interleave(2, dim=0)[::2].requires_grad_() for x in raw]
    outputs = ops.activate(*strided)
    assert all(torch.equal(x, y) for x, y in zip(outputs, ops.activate(*raw), strict=True))
    outputs[2].sum().backward()
    assert strided[2].grad.all() and not any(strided[index].grad.any() for index in (0, 1, 3))
