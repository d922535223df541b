import functools
import math
from typing import Any

import pytest
import torch

import nexwarp as nw
from tests.reference.render import Texture
from tests.reference.render import field as reference_field
from tests.reference.sh import evaluate
from tests.tolerances import assert_close


@pytest.mark.parametrize(
    ("count", "hits", "degree", "width", "hidden_layers"),
    [(1, 1, 3, 16, 2), (7, 2, 0, 5, 1), (64, 2, 1, 16, 0), (1003, 3, 2, 31, 3), (2100, 2, 3, 200, 2)],
)
@pytest.mark.parametrize("clamp", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_textured_colors_agree_with_the_reference(count, hits, degree, width, hidden_layers, clamp, dtype):
    """Numbers of points that no padding or part divides, and more points than a part has."""
    shape: dict[str, Any] = {"width": width, "hidden_layers": hidden_layers, "sh_degree": degree, "residual": True}
    texture = nw.NeuralTexture(5, 2**8, 1, 1.0, 6.0, **shape).to(dtype)
    torch.nn.init.normal_(texture.grid)
    draw = functools.partial(torch.randn, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    positions, factors = draw(count, hits, 3).to(dtype), draw(count, hits, 3).to(dtype)
    directions = torch.nn.functional.normalize(draw(count, 3), dim=-1).to(dtype)
    depths = (1 + draw(count, hits).abs()).to(dtype)
    depths[3::7] = 0.0  # points to skip
    inputs = (positions, depths, texture.grid, *texture.mlp.parameters())
    leaves = [x.detach().double().requires_grad_() for x in inputs]
    there = depths > 0
    field = Texture(leaves[2], texture.resolutions.double(), leaves[3:])
    coefficients = reference_field(field, leaves[0][there], leaves[1][there], 24.0)
    toward = directions.double()[:, None].expand(count, hits, 3)[there]
    expected = torch.zeros(count, hits, 3, dtype=torch.float64)  # without features there is no colour
    expected[there] = evaluate(coefficients, toward, degree).clamp_min(0.0 if clamp else -math.inf)
    references = torch.autograd.grad((expected * factors.double()).sum(), leaves)

    at, far = positions.clone().requires_grad_(), depths.clone().requires_grad_()
    out = texture.evaluate(at, far, directions, 24.0, clamp=clamp)
    grads = torch.autograd.grad((out * factors).sum(), [at, far, *texture.parameters()])
    with torch.no_grad():
        assert torch.equal(texture.evaluate(positions, depths, directions, 24.0, clamp=clamp), out)
    assert_close(out, expected, kind="value", name="colors")
    for index, (gradient, reference) in enumerate(zip(grads, references, strict=True)):
        assert_close(gradient, reference, kind="gradient", name=f"gradient {index}")


@pytest.mark.parametrize("part", ["grid", "hidden", "last"])
def test_what_is_not_a_number_reaches_the_colors(part: str) -> None:
    """And its gradients: ReLU must not hide that a training has diverged."""
    texture = nw.NeuralTexture(2, 2**4, 1, 1.0, 2.0, width=8)
    *hidden, last = texture.mlp.parameters()
    with torch.no_grad():
        {"grid": texture.grid, "hidden": hidden[1], "last": last}[part].fill_(torch.nan)
    colors = texture.evaluate(torch.rand(5, 2, 3), torch.ones(5, 2), torch.tensor([[0.0, 0.0, 1.0]] * 5), 24.0)
    assert colors.isnan().all()
    grads = torch.autograd.grad(colors.sum(), [texture.grid, hidden[0]])
    assert any(grad.isnan().any() for grad in grads)
