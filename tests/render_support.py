"""Rendering of test scenes, also by the reference, and comparison of results."""

import copy
from typing import Any

import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.model.exposures import Exposures
from nexwarp.model.render import Frame
from nexwarp.model.render import draw as draw_frame
from tests.narrowing import present, total
from tests.reference import collect
from tests.reference import render as reference
from tests.reference.collect import Shape, View
from tests.scenes import Scene, make_camera, make_surfels, make_texture, random_scene
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
    whole = nw.RenderOptions(**options)
    return draw_frame(Frame(surfels, texture, camera, whole, whole.background, jitter=jitter))


def assert_same(actual: Any, expected: Any, buffers: tuple[str, ...] = BUFFERS) -> None:
    """Fail unless the buffers are the same to the last bit."""
    for name in buffers:
        assert torch.equal(getattr(actual, name), getattr(expected, name)), name


def assert_alike(actual: Any, expected: Any, buffers: tuple[str, ...] = BUFFERS) -> None:
    """Fail unless the buffers agree to the tolerance of their dtype."""
    for name in buffers:
        assert_close(getattr(actual, name), getattr(expected, name), kind="value", name=name)


def loss(out: Any, buffers: tuple[str, ...] = BUFFERS) -> torch.Tensor:
    """Sum of differentiable buffers with fixed random factors."""
    generator = torch.Generator().manual_seed(7)
    total = getattr(out, buffers[0]).new_zeros(())
    for name in buffers:
        buffer = getattr(out, name)
        total = total + (buffer * torch.randn(buffer.shape, generator=generator, dtype=torch.float64).to(buffer)).sum()
    return total


def leaf(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.detach().clone().requires_grad_()


class Passes:
    """The passes of one rendering, their inputs being leaves: project -> tiles -> collect and surface, then a loss.

    `room` is that of the tile lists.
    """

    def __init__(self, scene: Scene, *, max_hits: int = 2, room: int | None = None) -> None:
        surfels, camera = make_surfels(scene), make_camera(scene)
        viewmat = leaf(camera.viewmat)
        means, quats, scales = leaf(surfels.means), leaf(surfels.quats), leaf(surfels.scales)
        shape = (means, quats, scales, leaf(surfels.opacities), leaf(surfels.gammas))
        self.pinhole = ops.Pinhole(camera.K, camera.width, camera.height, camera.near)
        sh = leaf(surfels.sh)
        self.colors = ops.plain_colors(sh, shape[0], -viewmat[:3, :3].T @ viewmat[:3, 3], 3)
        self.projection = ops.project(*shape, self.colors, viewmat)
        self.tiles = ops.intersect_tiles(shape, self.projection, viewmat, self.pinhole, room=room)
        self.hits = ops.collect(self.projection, self.tiles, self.pinhole, max_hits=max_hits)
        names = ("means", "quats", "scales", "opacities", "gammas", "sh", "viewmat")
        self.leaves = dict(zip(names, (*shape, sh, viewmat), strict=True))

    def buffers(self) -> dict[str, torch.Tensor]:
        names = ("plain", "base", "ids", "depths", "weights", "alpha")
        return {name: getattr(self.hits, name).detach() for name in names}

    def gradients(self) -> dict[str, torch.Tensor]:
        """Of the sum of all differentiable buffers with fixed random factors."""
        generator, hits = torch.Generator().manual_seed(2), self.hits
        surface = ops.surface(self.projection, hits, self.leaves["viewmat"])
        depths = surface.expected_depth, surface.median_depth, surface.top_depth
        buffers = (hits.plain, hits.base, hits.depths, hits.weights, hits.alpha, *depths, surface.blended_normals)
        factors = (torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x) for x in buffers)
        total((x * factor).sum() for x, factor in zip(buffers, factors, strict=True)).backward()
        return {name: present(leaf.grad) for name, leaf in self.leaves.items()}

    def blended(self, errors: torch.Tensor) -> torch.Tensor:
        return ops.splat_error(self.hits, errors).detach()


def cameras(device: torch.device | str, count: int = 4, width: int = 61, height: int = 45) -> list[nw.Camera]:
    """Cameras that move back and turn, each with a focal length and a principal point of its own."""
    found = []
    for i in range(count):
        viewmat = torch.eye(4)
        viewmat[2, 3], viewmat[0, 3] = 0.3 * i, 0.1 * i
        K = torch.tensor([[50.0 + 3 * i, 0.0, 30.0 - i], [0.0, 52.0 + i, 22.0 + i], [0.0, 0.0, 1.0]])
        found.append(nw.Camera(viewmat, K, width, height).to(device))
    return found


def finished(device: torch.device | str, seed: int = 0) -> nw.Model:
    """A model with texture, exposures of a lens with vignetting, and detail limits."""
    scene = random_scene(80, device=device, seed=seed)
    gains = 0.2 * torch.randn(4, 3, generator=torch.Generator().manual_seed(seed))
    exposures = Exposures.of(gains, cameras("cpu"), (-0.2, -0.1, 0.5)).to(device)
    limits = nw.DetailLimits(torch.full((80,), 0.01), torch.full((80,), 0.05)).to(device)
    return nw.Model(make_surfels(scene), make_texture(device=device), exposures, limits)


def view_of(camera: nw.Camera, order: str = "depth") -> View:
    return View(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, camera.near, order)


def reference_render(
    surfels: nw.Surfels, texture, camera: nw.Camera, *, order="depth", clamp_texture=False, shares=None, **options: Any
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
    return (generators @ viewmat.detach().double().cpu() * present(viewmat.grad).double().cpu()).sum(dim=(1, 2))


def twin(module: torch.nn.Module | None) -> Any:
    """Copy a module to float64 on the CPU."""
    return None if module is None else copy.deepcopy(module).double().cpu()


def assert_gradients(actual: torch.nn.Module, expected: torch.nn.Module, row: torch.dtype) -> None:
    """Fail unless all parameters have the same gradients; one that is missing counts as zero."""
    parameters = dict(actual.named_parameters())
    for name, parameter in expected.named_parameters():
        pair = parameters[name], parameter
        gradients = [torch.zeros_like(value) if value.grad is None else value.grad for value in pair]
        assert_close(*gradients, kind="gradient", name=name, precision=row)


def rays_of(camera: nw.Camera) -> torch.Tensor:
    """(H, W, 3) rays of a pinhole camera, of z-depth 1."""
    return collect.rays_of(view_of(camera), camera.viewmat).reshape(camera.height, camera.width, 3)
