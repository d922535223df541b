import dataclasses
from typing import Any

import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.model.render import Frame, antialiased, draw
from nexwarp.model.texture import NEVER, DetailLimits
from nexwarp.train.finish import measure_detail_limits
from tests.render_support import BACKGROUND, assert_same
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import assert_close


def textured_at(texture: nw.NeuralTexture, camera: nw.Camera, out: nw.Rendering, depths: torch.Tensor) -> torch.Tensor:
    """What the textured hits of a rendering add up to with the detail of other depths (H, W, K)."""
    pinhole = ops.Pinhole(camera.K, camera.width, camera.height, camera.near)
    positions, directions = ops.unproject(out.depths, camera.viewmat, pinhole)
    filled = out.ids >= 0
    assert (out.depths[filled] < 3.4).any() and (out.depths[filled] > 3.6).any()
    colors = texture.evaluate(positions, torch.where(filled, depths, 0.0), directions, camera.focal)
    return (out.weights[..., None] * colors).sum(2)


def limits(surfels: nw.Surfels, nearest: float = 0.0, farthest: float = NEVER) -> DetailLimits:
    """The same limits for every surfel, depth / focal."""
    return DetailLimits(*(torch.full_like(surfels.logit_opacities.detach(), x) for x in (nearest, farthest)))


def limited(
    surfels: nw.Surfels, texture: nw.NeuralTexture | None, camera: nw.Camera, limits: Any, **changes: Any
) -> Any:
    options = nw.RenderOptions(**changes)
    return draw(Frame(surfels, texture, camera, options, options.background, limits=limits))


def test_looks_beyond_those_of_training_have_their_detail(device: torch.device) -> None:
    """A hit closer than the surfel's nearest limit, or beyond its farthest, is textured as from there.

    One further away than the nearest is textured as without; one that training never had, not at all.
    """
    scene = random_scene(device=device)
    surfels, texture, camera = make_surfels(scene), make_texture(device=device), make_camera(scene)
    texture.half_precision = False
    plain, limit = nw.render(surfels, texture, camera, max_hits=3), 3.5 / camera.focal
    close = limited(surfels, texture, camera, limits(surfels, nearest=limit), max_hits=3)
    away = limited(surfels, texture, camera, limits(surfels, farthest=limit), max_hits=3)
    for out, depths in ((close, close.depths.clamp_min(3.5)), (away, away.depths.clamp_max(3.5))):
        assert_close(out.textured, textured_at(texture, camera, out, depths), kind="value", name="textured")
    assert_same(close, plain, ("plain", "depths", "weights", "alpha"))
    far = ((close.ids < 0) | (close.depths > 3.5)).all(-1)
    assert_close(close.textured[far], plain.textured[far], kind="value", name="far")
    texture.residual = True
    none = limits(surfels, nearest=NEVER, farthest=limit)
    never, plain = (limited(surfels, each, camera, none) for each in (texture, None))
    assert_close(never.image, plain.image, kind="value", name="never textured")


def test_looks_as_far_as_training_had_are_its_own(device: torch.device) -> None:
    """To the bit, with limits that hold all hits and centres; and with those that nothing was ever farther than."""
    scene = random_scene(device=device)
    surfels, texture, camera = make_surfels(scene), make_texture(device=device), make_camera(scene)
    before = nw.render(surfels, texture, camera)
    for farthest in (1.01 * before.depths.max().item() + 3.0, NEVER):
        after = limited(surfels, texture, camera, limits(surfels, nearest=1e-6, farthest=farthest / camera.focal))
        for name in ("image", "textured", "weights", "depths", "ids", "alpha"):
            assert torch.equal(getattr(after, name), getattr(before, name)), name


def test_a_far_surfel_covers_what_it_covers_wherever_pixels_fall(device: torch.device) -> None:
    """The sum of a small Gaussian's alphas is its opacity times its area in pixels, wherever it lies among them."""
    scale, opacity = 0.004, 0.5
    shape = (torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.tensor([[scale, 2 * scale]]))
    surfels = nw.Surfels.from_activated(*shape, torch.tensor([opacity]), torch.ones(1, 2), torch.zeros(1, 1, 3))
    surfels = surfels.to(device)
    focal = 60.0  # so that a pixel is 0.033 wide there
    generator = torch.Generator().manual_seed(0)

    def sums(training: DetailLimits | None) -> torch.Tensor:
        found = []
        for x, y in torch.rand(40, 2, generator=generator).tolist():
            K = torch.tensor([[focal, 0.0, 8 + x], [0.0, focal, 8 + y], [0.0, 0.0, 1.0]])
            out = limited(surfels, None, nw.Camera(torch.eye(4), K, 16, 16).to(device), training)
            found.append(out.alpha.detach().sum().item())
        return torch.tensor(found)

    area = opacity * 2 * torch.pi * scale * (2 * scale) * (focal / 2) ** 2
    aliased = sums(None)
    filtered = sums(limits(surfels, farthest=0.1 / focal))  # training was 20 times as close
    assert aliased.std() > area and (filtered.mean() - area).abs() < 0.1 * area and filtered.std() < 0.2 * area


def test_far_looks_are_differentiable_in_the_camera(device: torch.device) -> None:
    scene = random_scene(12, dtype=torch.float64, device=device)
    surfels, camera = make_surfels(scene), make_camera(scene)
    farthest = torch.linspace(1.0, 6.0, len(surfels), dtype=torch.float64, device=device) / camera.focal
    training = DetailLimits(torch.zeros_like(farthest), farthest)

    def shape(viewmat: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return antialiased(surfels.activated(), dataclasses.replace(camera, viewmat=viewmat), training)[2:]

    viewmat = camera.viewmat.detach().clone().requires_grad_()
    (wide, *_), (narrow, *_) = shape(viewmat), surfels.activated()[2:]
    assert 0.3 < (wide > narrow).double().mean() < 1 and torch.autograd.gradcheck(shape, viewmat)


def test_limits_are_those_of_the_closest_and_the_farthest_look(device: torch.device) -> None:
    scene = random_scene(device=device)
    surfels, camera = make_surfels(scene), make_camera(scene)
    window = nw.Camera(camera.viewmat.detach(), 2 * camera.K - torch.diag(camera.K.new_tensor([0.0, 0.0, 1.0])), 23, 18)
    cameras = [camera, window]
    closest = torch.full((len(surfels),), NEVER)
    farthest, front = torch.zeros(len(surfels)), torch.zeros(len(surfels))
    for c in cameras:
        with torch.no_grad():
            out = nw.render(surfels, None, c, max_hits=2)
            centres = c.project(surfels.means)[1]
        front = torch.maximum(front, centres.cpu().where(centres.cpu() > c.near, 0) / c.focal)
        for i, depth, weight in zip(out.ids.flatten(), out.depths.flatten(), out.weights.flatten(), strict=True):
            if weight >= 1 / 255:
                closest[i] = min(closest[i].item(), depth.item() / c.focal)
                farthest[i] = max(farthest[i].item(), depth.item() / c.focal, centres[i].item() / c.focal)
    farthest = farthest.where(farthest > 0, front)
    farthest = farthest.where(farthest > 0, NEVER)
    found = measure_detail_limits(nw.Model(surfels, None), cameras)  # K is 2, as `render` has it
    assert (closest < NEVER).any() and (closest == NEVER).any() and (farthest > 1.5 * closest).any()
    for mine, expected, name in ((found.nearest, closest, "nearest"), (found.farthest, farthest, "farthest")):
        assert_close(mine.cpu(), expected, kind="value", name=name)
        assert ((mine.cpu() - expected).abs() <= 2e-5 * expected).all(), name


def test_no_surfels_have_no_limits(device: torch.device) -> None:
    empty = {name: x[:0] for name, x in make_surfels(random_scene(3)).state_dict().items()}
    surfels = nw.Surfels(empty).to(device)
    camera = make_camera(random_scene(3, device=device))
    found = measure_detail_limits(nw.Model(surfels, None, options=nw.RenderOptions(max_hits=0)), [camera])
    assert found.nearest.shape == found.farthest.shape == (0,)
    out = limited(surfels, make_texture(device=device), camera, found, background=BACKGROUND)
    assert (out.image - torch.tensor(BACKGROUND, device=device)).abs().max() < 1e-6
