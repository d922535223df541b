import itertools
from collections.abc import Iterator

import pytest
import torch

from nexwarp import ops
from tests.reference import sh as reference
from tests.tolerances import assert_close

DEGREES = list(itertools.product(range(4), repeat=2))
NAMES = ("sh0", "shN", "means", "position")
Leaves = list[torch.Tensor]


def make(
    count: int, stored: int, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu", seed: int = 0
) -> Leaves:
    """Leaves sh0, shN, means and the camera's position; about every fifth channel is below 0, where it is clamped."""
    generator = torch.Generator().manual_seed(seed)
    shapes = [(count, 1, 3), (count, (stored + 1) ** 2 - 1, 3), (count, 3), (3,)]
    values = [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes]
    return [x.float().to(device=device, dtype=dtype).requires_grad_() for x in values]


@pytest.fixture
def poisoned_memory() -> Iterator[None]:
    """In this mode torch fills what `torch.empty` gives with NaN."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


def signal(colors: torch.Tensor) -> torch.Tensor:
    return torch.randn(colors.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64).to(colors)


def colors_of(leaves: Leaves, degree: int) -> torch.Tensor:
    sh0, shN, means, position = leaves
    return ops.plain_colors((sh0, shN), means, position, degree)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("stored", "degree"), DEGREES)
def test_plain_colors_agree_with_the_reference(stored, degree, dtype, device):
    leaves = make(300, stored, dtype, device)
    twins = [x.detach().double().cpu().requires_grad_() for x in leaves]
    colors = colors_of(leaves, degree)
    sh0, shN, means, position = twins
    expected = reference.plain_colors(torch.cat([sh0, shN], dim=1), means, position, degree)
    assert 0.02 < (expected == 0).double().mean() < 0.5
    assert_close(colors, expected, kind="value", name="colors")
    grads = torch.autograd.grad(colors, leaves, signal(colors))
    # At degree 0 nothing depends on the direction.
    wanted = torch.autograd.grad(expected, twins, signal(expected), allow_unused=True, materialize_grads=True)
    for name, actual, want in zip(NAMES, grads, wanted, strict=True):
        assert_close(actual, want, kind="gradient", name=name)


@pytest.mark.parametrize(("stored", "degree"), [(s, d) for s, d in DEGREES if d < s])
@pytest.mark.usefixtures("poisoned_memory")
def test_coefficients_above_the_degree_have_zero_gradients(stored: int, degree: int, device: torch.device) -> None:
    """All others have some. Memory that no kernel wrote would show as NaN."""
    leaves = make(300, stored, torch.float32, device)
    colors = colors_of(leaves, degree)
    grad_sh0, grad_shN, _, _ = torch.autograd.grad(colors, leaves, signal(colors))
    used = (degree + 1) ** 2 - 1
    assert grad_shN[:, used:].eq(0).all() and grad_shN[:, :used].ne(0).any(dim=2).any(dim=0).all() and grad_sh0.any()


def test_colours_of_exactly_0_have_no_gradient(device: torch.device) -> None:
    dark = torch.full((4, 1, 3), -0.5 / 0.28209479177387814, dtype=torch.float64, device=device, requires_grad=True)
    colors = ops.plain_colors((dark, dark.new_zeros(4, 0, 3)), dark.new_ones(4, 3), dark.new_zeros(3), 0)
    (gradient,) = torch.autograd.grad(colors.sum(), dark)
    assert not colors.any() and not gradient.any()
