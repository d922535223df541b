"""The fused texturing kernels, which are for CUDA alone, agree with the reference."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.machine import deterministic
from nexwarp.native.fused_texture import FEATURES
from nexwarp.ops import fused_texture
from tests.reference import hashgrid, sh
from tests.tolerances import assert_close

NAMES = ("positions", "depths", "grid", "first matrix", "second matrix", "third matrix")


def rounded(x: torch.Tensor) -> torch.Tensor:
    """Round to half precision, and differentiate as if not."""
    return x + (x.half().double() - x).detach()


class Case(NamedTuple):
    """Points of an image, and a texture whose table is exact in half precision."""

    hits: int
    leaves: list[torch.Tensor]  # positions, depths, grid, matrices
    rays: ops.Rays
    resolutions: torch.Tensor
    focal: torch.Tensor
    signal: torch.Tensor

    def reference(self) -> torch.Tensor:
        """Return the colours (n, 3) in float64, with the roundings to half precision that both computations do.

        A hidden value near 0 would otherwise pass its ReLU in one and not in the other, which is no error of either.
        """
        positions, depths, grid, *weights = (x.double() for x in self.leaves)
        seen = depths > 0
        focal, resolutions = self.focal.item(), self.resolutions.double()
        layer = rounded(hashgrid.encode(positions[seen], depths[seen], grid, resolutions, focal))
        *hidden, last = map(rounded, weights)
        for matrix in hidden:
            layer = rounded(torch.relu(layer @ matrix.T))
        coefficients = (layer @ last.T).unflatten(1, (-1, 3))
        found = sh.evaluate(coefficients, self.rays.directions.double().repeat_interleave(self.hits, 0)[seen], 3)
        colors = 0.1 + torch.zeros_like(positions).index_put((seen.nonzero()[:, 0],), found)
        return colors.clamp_min(0.0) if self.rays.clamp else colors

    def inputs(self, half: bool) -> tuple[ops.Points, ops.Field, ops.Rays]:
        """Return the arguments of `ops.texture`."""
        positions, depths, grid, *weights = self.leaves
        return ops.Points(positions, depths, self.focal), ops.Field(grid, weights, self.resolutions, half), self.rays

    def texture(self, *, fused: bool) -> torch.Tensor:
        """Return the colours (n, 3) in half precision."""
        return ops.texture(*self.inputs(half=True), fused=fused)


def make_case(
    device: torch.device, features: int, degree: int, clamp: bool, size: tuple[int, int, int], table: int = 2**10
) -> Case:
    width, height, hits = size
    count = width * height * hits
    texture = nw.NeuralTexture(FEATURES // features, table, features, 4.0, 64.0, sh_degree=degree)
    # Neighbouring pixels see neighbouring points, as on a surface: warps whose lanes share cells, and others.
    x, y, k = torch.meshgrid(*(torch.arange(n) for n in (width, height, hits)), indexing="xy")
    positions = torch.stack([x / 40.0, y / 40.0, k + torch.rand(x.shape) / 50], dim=-1).reshape(-1, 3) - 0.3
    depths = 0.5 + 3 * torch.rand(count)
    depths[torch.rand(count) < 0.2] = 0.0
    directions = torch.nn.functional.normalize(torch.randn(width * height, 3), dim=1)
    # Hidden layers of random matrices shrink what they are given.
    weights = [1.5 * matrix.detach() for matrix in texture.mlp.parameters()]
    grid = torch.empty_like(texture.grid.detach()).uniform_(-1, 1).half().float()
    leaves = [x.to(device).requires_grad_() for x in (positions, depths, grid, *weights)]
    signal = 1e-4 * torch.randn(count, 3)
    rays = ops.Rays(directions.to(device), 0.1, clamp, (height, width))
    focal = torch.tensor([60.0], device=device)
    return Case(hits, leaves, rays, texture.resolutions.to(device), focal, signal.to(device))


def assert_agree(
    colors: torch.Tensor, gradients: list[torch.Tensor], expected: torch.Tensor, references: list[torch.Tensor]
) -> None:
    assert_close(colors, expected, kind="value", name="colours", precision=torch.float16)
    for name, gradient, reference in zip(NAMES, gradients, references, strict=True):
        assert_close(gradient, reference, kind="gradient", name=name, precision=torch.float16)


CUDA_SIZES = [(200, 130, 2), (37, 1, 3), (129, 66, 1), (40, 30, 8)]


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """How often the fused kernels were used: one number a call of the forward pass."""
    calls: list[int] = []
    forward = fused_texture.forward

    def spy(points: ops.Points, *rest: Any) -> tuple[torch.Tensor, ...]:
        calls.append(len(points))
        return forward(points, *rest)

    monkeypatch.setattr(fused_texture, "forward", spy)
    yield calls


@pytest.mark.cuda
@pytest.mark.parametrize("size", CUDA_SIZES, ids=str)
@pytest.mark.parametrize(("features", "degree", "clamp"), [(4, 3, False), (2, 2, True), (4, 1, True), (2, 0, False)])
def test_fused_and_layered_agree(features, degree, clamp, size, counted):
    case = make_case(torch.device("cuda"), features, degree, clamp, size, 2**16)
    exact = case.reference()
    references = list(torch.autograd.grad(exact, case.leaves, case.signal))
    for fused in (False, True):
        colors = case.texture(fused=fused)
        assert_agree(colors, list(torch.autograd.grad(colors, case.leaves, case.signal)), exact, references)
    assert len(counted) == 1
    with torch.no_grad():
        assert torch.equal(case.texture(fused=True), colors)
    colors = case.texture(fused=True)
    for keep in (True, False):
        again = torch.autograd.grad(colors, case.leaves, case.signal, retain_graph=keep)
        assert_agree(colors, list(again), exact, references)


@pytest.mark.cuda
def test_what_the_fused_kernels_do_not_take_is_computed_in_layers(counted: list[int]) -> None:
    case = make_case(torch.device("cuda"), 4, 3, False, (20, 10, 2))
    with deterministic(True):
        case.texture(fused=True)
    case.rays.directions.requires_grad_()
    assert torch.autograd.grad(case.texture(fused=True), case.rays.directions, case.signal)[0].abs().max() > 0
    assert not counted
    with torch.no_grad():
        case.texture(fused=True)
    assert counted == [400]


@pytest.mark.cuda
def test_levels_launched_apart_give_the_same_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    case = make_case(torch.device("cuda"), 4, 3, False, (19, 5, 2))
    together = torch.autograd.grad(case.texture(fused=True), case.leaves, case.signal)
    monkeypatch.setattr(fused_texture, "GROUP_BYTES", 2**14)
    assert len(fused_texture.level_groups(8, 2**14)) == 5
    apart = torch.autograd.grad(case.texture(fused=True), case.leaves, case.signal)
    for name, one, other in zip(NAMES, apart, together, strict=True):
        assert_close(one, other, kind="value", name=name)


@pytest.mark.cuda
def test_values_that_are_not_finite_are_passed_on() -> None:
    """Health checks find them only if no ReLU turns them into zeros."""
    case = make_case(torch.device("cuda"), 4, 3, False, (20, 10, 2))
    with torch.no_grad():
        case.leaves[2].fill_(float("nan"))
    colors = case.texture(fused=True)
    assert colors[case.leaves[1] > 0].isnan().all()
    gradients = torch.autograd.grad(colors, case.leaves[3:], case.signal)
    assert all(not gradient.isfinite().all() for gradient in gradients)


@pytest.mark.parametrize(
    ("shape", "usual"),
    [
        ({}, True),
        ({"levels": 16, "features": 2}, True),
        ({"levels": 32, "features": 1}, False),
        ({"levels": 4, "features": 8}, False),
        ({"levels": 16}, False),
        ({"width": 32}, False),
        ({"hidden_layers": 1}, False),
        ({"hidden_layers": 3}, False),
        *(({"sh_degree": degree}, True) for degree in range(3)),
    ],
    ids=str,
)
def test_shapes_that_the_kernels_take(shape: dict[str, int], usual: bool) -> None:
    sizes: dict[str, Any] = {"levels": 8, "features": 4, "width": 64, "hidden_layers": 2, "sh_degree": 3} | shape
    texture = nw.NeuralTexture(table_size=2**4, **sizes)
    assert fused_texture.fits(texture.grid, list(texture.mlp.parameters()), 1000) == usual
    assert not fused_texture.fits(texture.grid, list(texture.mlp.parameters()), 2**27)
