import pytest
import torch

from nexwarp import ops
from nexwarp.kernels.detail import FILTER
from nexwarp.model.texture import NEVER
from tests.tolerances import assert_close, assert_finite

# Depths, scales, opacities and gammas.
Shape = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def antialiased(depths, scales, opacities, gammas, farthest, focal):
    variance = FILTER * ((depths / focal).square() - farthest.square()).clamp_min(0)
    wide = (scales.square() + torch.where(depths > 0, variance, 0)[:, None]).sqrt()
    share = scales / wide
    return wide, opacities * share.prod(1), 1 + (gammas - 1) * share.square()


def arguments(count: int, dtype: torch.dtype, device: torch.device) -> tuple[Shape, torch.Tensor]:
    """Of `ops.antialias`; those of the shape want gradients."""
    generator = torch.Generator().manual_seed(5)
    shapes = ((count,), (count, 2), (count,), (count, 2), (count,))
    depths, scales, opacities, gammas, farthest = (
        torch.rand(shape, generator=generator, dtype=torch.float64) for shape in shapes
    )
    # Pixels of 0.006 to 0.05 units, a few behind the camera.
    values = [5 * depths - 0.4, 0.001 + 0.1 * scales, opacities, 1 + 9 * gammas, 0.002 + 0.03 * farthest]
    *shape, farthest = (x.to(dtype=dtype, device=device).requires_grad_() for x in values)
    depths, scales, opacities, gammas = shape
    return (depths, scales, opacities, gammas), farthest.detach()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_widening_is_what_torch_gives(dtype: torch.dtype, device: torch.device) -> None:
    shape, farthest = arguments(500, dtype, device)
    signals = [torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=dtype).to(x) for x in shape[1:]]
    found, expected = ops.antialias(*shape, farthest, 90.0), antialiased(*shape, farthest, 90.0)
    far = shape[0].detach() / 90.0 > farthest
    assert 0.3 < far.double().mean() < 0.9 and (shape[0] < 0).any()
    grads, wanted = (torch.autograd.grad(x, shape, signals, retain_graph=True) for x in (found, expected))
    for name, mine, torchs in zip(("scales", "opacities", "gammas"), found, expected, strict=True):
        assert_close(mine, torchs, kind="value", name=name)
    for name, mine, torchs in zip(("depths", "scales", "opacities", "gammas"), grads, wanted, strict=True):
        assert_close(mine, torchs, kind="gradient", name=name)
    for mine, given in zip(found, shape[1:], strict=True):
        assert torch.equal(mine[~far], given[~far])


def test_widening_of_extremes_is_finite(device: torch.device) -> None:
    shape, farthest = arguments(8, torch.float32, device)
    with torch.no_grad():
        shape[0].fill_(1e4)
        shape[1][:, 0] = torch.tensor([1e-38, 1e-30, 1e-20, 1e10, 1e18, 1e25, 1e38, 1.0])
        shape[1][:, 1] = shape[1][:, 0]
        shape[3][:, 1] = torch.tensor([1e30, 1e10, 1.0, 1.0, 1e3, 1.0, 1.0, 1.0])
        farthest.copy_(torch.tensor([0.0] * 7 + [NEVER]))
    found = ops.antialias(*shape, farthest, 1.0)
    for name, values, given in zip(("scales", "opacities", "gammas"), found, shape[1:], strict=True):
        assert_finite(values, name)
        assert torch.equal(values[3:], given[3:])
    assert found[0][0, 0].item() == pytest.approx(FILTER**0.5 * 1e4)
    grads = torch.autograd.grad([x.sum() for x in found], shape)
    for name, grad in zip(("depths", "scales", "opacities", "gammas"), grads, strict=True):
        assert_finite(grad, name)
