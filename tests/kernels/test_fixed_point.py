import importlib
from collections.abc import Callable

import numpy as np
import pytest
import torch
import warp as wp

import nexwarp as nw
from nexwarp.native.fixed_point import LARGEST
from nexwarp.ops._interop import from_fixed_point
from tests.ops.test_threads import errors_of
from tests.render_support import Passes
from tests.scenes import random_scene
from tests.tolerances import assert_close
from tests.warp_kernels import add_in_order


def summed(terms: torch.Tensor, order: torch.Tensor) -> torch.Tensor:
    sums, bad = torch.zeros(1, 2, dtype=torch.int64), torch.zeros(1, dtype=torch.int32)
    wp.init()
    arrays = [wp.from_torch(x) for x in (order.int(), terms, sums, bad)]
    wp.launch(add_in_order, len(terms), inputs=arrays, device="cpu")
    return from_fixed_point(sums, bad, torch.float64)


def test_order_does_not_matter() -> None:
    """Terms over 20 decades, with cancellation: float sums differ with the order, these do not."""
    terms = (10.0 ** torch.linspace(-14, 5, 4000, dtype=torch.float64) * torch.randn(4000, dtype=torch.float64)).float()
    orders = [torch.arange(4000), torch.arange(3999, -1, -1), torch.randperm(4000)]
    floats = {np.add.accumulate(terms[order].numpy(), dtype=np.float32)[-1].item() for order in orders}
    values = [summed(terms, order) for order in orders]
    assert len(floats) > 1 and all(torch.equal(value, values[0]) for value in values)
    exact = terms.double().sum()
    assert abs(values[0].item() - exact.item()) < 4000 * 1e-18 + 1e-15 * terms.double().abs().sum().item()


@pytest.mark.parametrize("term", [float("nan"), float("inf"), -LARGEST, 1e30])
def test_what_does_not_fit_is_not_a_number(term: float) -> None:
    assert summed(torch.tensor([1.0, term, 2.0]), torch.arange(3)).isnan().all()


@pytest.fixture
def switched(monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], None]:
    """Switch sums to fixed point and back."""

    def switch(fixed_point: bool) -> None:
        for name in ("collect", "texture"):
            # By its full name: the package's attribute is the function of the same name.
            module = importlib.import_module(f"nexwarp.ops.{name}")
            monkeypatch.setattr(module, "sums_in_fixed_point", lambda like: fixed_point)

    return switch


@pytest.mark.parametrize("max_hits", [0, 2])
def test_collection_in_fixed_point(max_hits: int, switched: Callable[[bool], None]) -> None:
    scene = random_scene(150, seed=3, width=61, height=45)
    results = []
    for fixed_point in (False, True):
        switched(fixed_point)
        passes = Passes(scene, max_hits=max_hits)
        request = passes.hits.error_request
        request.errors = errors_of(scene)
        gradients, alone = passes.gradients(), passes.blended(errors_of(scene))
        assert request.sums_after_backward is not None
        results.append(gradients | {"requested": request.sums_after_backward, "alone": alone})
    for name, plain in results[0].items():
        assert plain.abs().max() > 0, name
        assert_close(results[1][name], plain, kind="gradient", name=name)


@pytest.mark.parametrize("features", [1, 2, 4])
def test_lookup_in_fixed_point(features: int, switched: Callable[[bool], None]) -> None:
    torch.manual_seed(0)
    texture = nw.NeuralTexture(4, 2**8, features, 1.0, 6.0, width=16)
    torch.nn.init.normal_(texture.grid)
    positions = 3 * torch.randn(300, 3)
    depths = 1 + torch.rand(300)
    depths[::7] = 0.0
    results = []
    for fixed_point in (False, True):
        switched(fixed_point)
        leaf = positions.clone().requires_grad_()
        out = texture(leaf, depths, 24.0)
        factors = torch.randn(out.shape, generator=torch.Generator().manual_seed(1))
        results.append(torch.autograd.grad((out * factors).sum(), [leaf, *texture.parameters()]))
    for index, (plain, fixed_) in enumerate(zip(*results, strict=True)):
        assert_close(fixed_, plain, kind="gradient", name=f"gradient {index}")
