"""Rendering of test scenes, also by the reference, and comparison of results."""

import copy
from typing import Any

import torch

import nexwarp as nw
from nexwarp.model.render import draw as draw_parts
from tests.narrowing import present
from tests.reference import render as reference
from tests.reference.collect import Shape, View
from tests.scenes import Scene, make_camera, make_surfels
from tests.tolerances import assert_close

BUFFERS = ("image", "plain", "textured", "depths", "weights", "alpha")
BACKGROUND = (0.1, 0.4, 0.7)
MAX_HITS = 8


def draw(
    scene: Scene, texture: nw.NeuralTexture | None = None, *, jitter: torch.Tensor | None = None, **options: Any
) -> Any:
    """Render `scene` over the test background."""
    surfels, camera, options = make_surfels(scene), make_camera(scene), {"background": BACKGROUND} | options
    if jitter is None:
        return nw.render(surfels, texture, camera, **options)
    return draw_parts(surfels, texture, camera, nw.RenderOptions(**options), jitter=jitter)


def assert_same(actual: Any, expected: Any, buffers: tuple[str, ...] = BUFFERS) -> None:
    """Fail unless the buffers are the same to the last bit."""
    for name in buffers:
        assert torch.equal(getattr(actual, name), getattr(expected, name)), name


def assert_alike(actual: Any, expected: Any, buffers: tuple[str, ...] = BUFFERS) -> None:
    """Fail unless the buffers agree to the tolerance of their dtype."""
    for name in buffers:
        assert_close(getattr(actual, name), getattr(expected, name), kind="value", name=name)


def loss(out: Any) -> torch.Tensor:
    """Sum of all differentiable buffers with fixed random factors."""
    generator = torch.Generator().manual_seed(7)
    total = out.image.new_zeros(())
    for name in BUFFERS:
        buffer = getattr(out, name)
        factors = torch.randn(buffer.shape, generator=generator, dtype=torch.float64)
        total = total + (buffer * factors.to(buffer)).sum()
    return total


def view_of(camera: nw.Camera, order: str = "depth") -> View:
    return View(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, camera.near, order)


def reference_render(
    surfels: nw.Surfels,
    texture: nw.NeuralTexture | None,
    camera: nw.Camera,
    *,
    order: str = "depth",
    clamp_texture: bool = False,
    shares: torch.Tensor | None = None,
    **options: Any,
) -> reference.Rendering:
    """Hand the public objects, in float64 on the CPU, to the reference."""
    field = None
    if texture is not None:
        mlp = list(texture.mlp.parameters())
        resolutions = texture.resolutions.double()
        field = reference.Texture(texture.grid, resolutions, mlp, texture.residual, clamp_texture, shares)
    shape = Shape(surfels.means, surfels.quats, surfels.scales, surfels.opacities, surfels.gammas)
    return reference.render(shape, surfels.sh, field, camera.viewmat, view_of(camera, order), **options)


def rigid_gradient(viewmat: torch.Tensor) -> torch.Tensor:
    """Derivative (6,) along the rigid motions applied behind `viewmat`: three turns, three shifts."""
    generators = torch.zeros(6, 4, 4, dtype=torch.float64)
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        generators[axis, b, a], generators[axis, a, b] = 1.0, -1.0
        generators[axis + 3, axis, 3] = 1.0
    moved = generators @ viewmat.detach().double().cpu()
    return (moved * present(viewmat.grad).double().cpu()).sum(dim=(1, 2))


def twin(module: torch.nn.Module | None) -> Any:
    """Copy a module to float64 on the CPU."""
    return None if module is None else copy.deepcopy(module).double().cpu()


def assert_gradients(actual: torch.nn.Module, expected: torch.nn.Module, row: torch.dtype) -> None:
    """Fail unless all parameters have the same gradients; one that is missing counts as zero."""
    parameters = dict(actual.named_parameters())
    for name, parameter in expected.named_parameters():
        gradients = [
            torch.zeros_like(value) if value.grad is None else value.grad for value in (parameters[name], parameter)
        ]
        assert_close(*gradients, kind="gradient", name=name, precision=row)


def rays_of(camera: nw.Camera) -> torch.Tensor:
    """(H, W, 3) rays of a pinhole camera, of z-depth 1."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    x, y = x.to(camera.viewmat), y.to(camera.viewmat)
    return torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)
