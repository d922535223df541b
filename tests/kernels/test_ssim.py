"""D-SSIM against the dense reference: values, gradients, borders."""

import pytest
import torch

from nexwarp.ops.ssim import weighted_dssim
from tests.reference import losses as reference
from tests.tolerances import assert_close

DTYPES = [torch.float32, torch.float64]
# Smaller than the window and than a GPU's strip; not a whole number of strips.
SIZES = [(1, 1), (1, 40), (40, 1), (3, 5), (4, 6), (12, 16), (13, 17), (30, 71)]


def images(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    target = torch.rand(height, width, 3, dtype=torch.float64)
    return (target + 0.2 * torch.randn_like(target)).requires_grad_(), target


def with_gradient(image: torch.Tensor, target: torch.Tensor, factor: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    leaf = image.detach().clone().requires_grad_()
    loss = weighted_dssim(leaf, target, factor)
    return loss.detach(), torch.autograd.grad(loss, leaf)[0]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("size", SIZES)
def test_dssim_is_the_references(device: torch.device, size: tuple[int, int], dtype: torch.dtype) -> None:
    image, target = images(*size)
    expected = 0.3 * reference.dssim(image.clamp(0, 1), target)
    (expected_gradient,) = torch.autograd.grad(expected, image)
    loss, gradient = with_gradient(image.to(device, dtype), target.to(device, dtype), 0.3)
    assert loss.dtype == gradient.dtype == dtype
    assert_close(loss, expected, kind="value", name="dssim")
    assert_close(gradient, expected_gradient, kind="gradient", name="gradient")


def test_inputs_need_not_be_contiguous(device: torch.device) -> None:
    image, target = (x.to(device) for x in images(14, 9))
    loss, gradient = with_gradient(image, target)
    turned = image.detach().permute(2, 1, 0).contiguous().permute(2, 1, 0).requires_grad_()
    wide = torch.stack([target, target], dim=-1)[..., 0]
    assert not turned.is_contiguous() and not wide.is_contiguous()
    again = weighted_dssim(turned, wide)
    assert torch.equal(again, loss)
    assert torch.equal(torch.autograd.grad(again, turned)[0], gradient)


@pytest.mark.cuda
def test_result_repeats_on_cuda() -> None:
    image, target = (x.float().cuda() for x in images(190, 270))
    results = [with_gradient(image, target) for _ in range(3)]
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_what_is_not_a_number_shows_and_stays_near(device: torch.device) -> None:
    """A pixel is in the windows of its 11 x 11 neighbours, these in those of 21 x 21; clamped ones have no gradient."""
    image, target = (x.to(device) for x in images(50, 40))
    with torch.no_grad():
        image[22, 15, 1] = float("nan")
    loss, gradient = with_gradient(image, target)
    assert loss.isnan()
    expected = torch.zeros_like(gradient, dtype=torch.bool)
    expected[12:33, 5:26, 1] = ((image >= 0) & (image <= 1))[12:33, 5:26, 1]
    assert torch.equal(~gradient.isfinite(), expected)
