import pytest
import torch

from nexwarp.ops import expose
from tests.tolerances import assert_close

SATURATION = 0.98


def reference(
    image: torch.Tensor, textured: torch.Tensor, exposure: torch.Tensor, photo: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    exposed = image * exposure
    return torch.where((photo >= SATURATION) & (exposed > photo), photo, exposed), textured * exposure


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("falloff", [False, True])
def test_exposed_images_and_gradients_are_torchs(device: torch.device, dtype: torch.dtype, falloff: bool) -> None:
    image, textured = (torch.rand(7, 9, 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    exposure = 1.0 + torch.rand((7, 9, 3) if falloff else (3,), dtype=torch.float64)
    photo = (1.5 * torch.rand(7, 9, 3, dtype=torch.float64)).clamp(max=1.0)
    assert ((photo >= SATURATION) & (image * exposure > photo)).any()
    signals = [torch.randn(7, 9, 3, dtype=torch.float64) for _ in range(2)]
    expected = reference(image, textured, exposure, photo)
    gradients = torch.autograd.grad(expected, (image, textured), signals)
    leaves = [x.detach().to(device, dtype).requires_grad_() for x in (image, textured)]
    given = [x.to(device, dtype) for x in (exposure, photo)]
    found = expose(leaves[0], leaves[1], given[0], given[1], SATURATION)
    for x, y in zip(found, expected, strict=True):
        assert x.dtype == dtype
        assert_close(x, y, kind="value", name="image")
    for x, y in zip(torch.autograd.grad(found, leaves, [x.to(leaves[0]) for x in signals]), gradients, strict=True):
        assert_close(x, y, kind="gradient", name="gradient")
    colors = expose(leaves[0], leaves[1], given[0], given[1], SATURATION)[1]
    (alone,) = torch.autograd.grad(colors, leaves[1], signals[1].to(leaves[1]))
    assert_close(alone, gradients[1], kind="gradient", name="gradient alone")
