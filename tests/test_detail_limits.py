"""Looks from closer and from farther than training had: the detail is training's, and surfels do not alias."""

import dataclasses

import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.finish.detail_limits import NEVER, seen_footprints
from nexwarp.render import seen_from
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.test_laws import BACKGROUND, MAX_HITS, assert_alike, assert_same, draw
from tests.tolerances import assert_close, assert_finite


def textured_at(texture: nw.NeuralTexture, camera: nw.Camera, out: nw.Rendering, depths: torch.Tensor) -> torch.Tensor:
    """What the textured hits of a rendering add up to with the detail of other depths (H, W, K)."""
    pinhole = ops.Pinhole(camera.K, camera.width, camera.height, camera.near)
    positions, directions = ops.unproject(out.depths, camera.viewmat, pinhole)
    filled = out.ids >= 0
    assert (out.depths[filled] < 3.4).any() and (out.depths[filled] > 3.6).any()
    colors = texture.colors(positions, torch.where(filled, depths, 0.0), directions, camera.focal)
    return (out.weights[..., None] * colors).sum(2)


def test_a_closer_look_finds_the_detail_of_training(device: torch.device) -> None:
    """A hit closer than the surfel's footprint is textured as from there; one further away as ever."""
    scene = random_scene(device=device)
    surfels, texture, camera = make_surfels(scene), make_texture(device=device), make_camera(scene)
    texture.half_precision = False
    plain = nw.render(surfels, texture, camera, max_hits=3)
    surfels.footprints = torch.full((len(surfels),), 3.5 / camera.focal, device=device)
    out = nw.render(surfels, texture, camera, max_hits=3)
    assert_same(out, plain, ("plain", "depths", "weights", "alpha"))
    expected = textured_at(texture, camera, out, out.depths.clamp_min(3.5))
    assert_close(out.textured, expected, kind="value", name="textured")
    far = (out.ids < 0) | (out.depths > 3.5)
    assert_close(out.textured[far.all(-1)], plain.textured[far.all(-1)], kind="value", name="far")


def test_what_training_never_textured_keeps_its_plain_colour(device: torch.device) -> None:
    scene = random_scene(device=device)
    surfels, texture, camera = make_surfels(scene), make_texture(device=device, residual=True), make_camera(scene)
    surfels.footprints = torch.full((len(surfels),), NEVER, device=device)
    out = nw.render(surfels, texture, camera, background=BACKGROUND)
    assert_alike(out, draw(scene))
    out.image.sum().backward()
    for name, parameter in surfels.named_parameters():
        assert_finite(parameter.grad, name)


def test_a_farther_look_keeps_the_detail_of_training(device: torch.device) -> None:
    """A hit farther than the surfel's footprint is textured as from there; one that training never had, not at all."""
    scene = random_scene(device=device)
    surfels, texture, camera = make_surfels(scene), make_texture(device=device), make_camera(scene)
    texture.half_precision = False
    surfels.far_footprints = torch.full((len(surfels),), 3.5 / camera.focal, device=device)
    out = nw.render(surfels, texture, camera, max_hits=3)
    expected = textured_at(texture, camera, out, out.depths.clamp_max(3.5))
    assert_close(out.textured, expected, kind="value", name="textured")
    surfels.footprints = torch.full((len(surfels),), NEVER, device=device)
    texture.residual = True
    never, plain = nw.render(surfels, texture, camera), nw.render(surfels, None, camera)
    assert_close(never.image, plain.image, kind="value", name="never textured")


def test_looks_as_far_as_training_had_are_its_own(device: torch.device) -> None:
    """To the bit, with footprints that hold all hits and centres; and with those that nothing was ever farther than."""
    scene = random_scene(device=device)
    surfels, texture, camera = make_surfels(scene), make_texture(device=device), make_camera(scene)
    before = nw.render(surfels, texture, camera)
    for farthest in (1.01 * before.depths.max().item() + 3.0, NEVER):
        surfels.footprints = torch.full((len(surfels),), 1e-6, device=device)
        surfels.far_footprints = torch.full((len(surfels),), farthest / camera.focal, device=device)
        after = nw.render(surfels, texture, camera)
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

    def sums() -> torch.Tensor:
        found = []
        for x, y in torch.rand(40, 2, generator=generator).tolist():
            K = torch.tensor([[focal, 0.0, 8 + x], [0.0, focal, 8 + y], [0.0, 0.0, 1.0]])
            out = nw.render(surfels, None, nw.Camera(torch.eye(4), K, 16, 16).to(device))
            found.append(out.alpha.detach().sum().item())
        return torch.tensor(found)

    area = opacity * 2 * torch.pi * scale * (2 * scale) * (focal / 2) ** 2
    aliased = sums()
    surfels.far_footprints = torch.full((1,), 0.1 / focal, device=device)  # training was 20 times as close
    filtered = sums()
    assert aliased.std() > area
    assert (filtered.mean() - area).abs() < 0.1 * area and filtered.std() < 0.2 * area


def test_far_looks_are_differentiable_in_the_camera(device: torch.device) -> None:
    scene = random_scene(12, dtype=torch.float64, device=device)
    surfels, camera = make_surfels(scene), make_camera(scene)
    surfels.far_footprints = torch.linspace(1.0, 6.0, len(surfels), dtype=torch.float64, device=device) / camera.focal

    def shape(viewmat: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return seen_from(surfels, dataclasses.replace(camera, viewmat=viewmat))[2:]

    viewmat = camera.viewmat.detach().clone().requires_grad_()
    (wide, *_), (narrow, *_) = shape(viewmat), surfels.activated()[2:]
    assert 0.3 < (wide > narrow).double().mean() < 1
    assert torch.autograd.gradcheck(shape, viewmat)


def test_footprints_are_those_of_the_closest_and_the_farthest_look(device: torch.device) -> None:
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
    found = seen_footprints(surfels, cameras, options={})  # K is 2, as `render` has it
    assert (closest < NEVER).any() and (closest == NEVER).any() and (farthest > 1.5 * closest).any()
    for mine, expected, name in zip(found, (closest, farthest), ("closest", "farthest"), strict=True):
        assert_close(mine.cpu(), expected, kind="value", name=name)
        assert ((mine.cpu() - expected).abs() <= 2e-5 * expected).all(), name


def test_training_views_are_as_training_made_them(device: torch.device) -> None:
    """In 8 bits: looks at hits of lower weights, or beyond the K heaviest of a pixel, do not count."""
    scene = random_scene(60, device=device)
    surfels, texture, camera = make_surfels(scene), make_texture(device=device, residual=True), make_camera(scene)
    texture.half_precision = False
    moved = camera.viewmat.detach() + torch.tensor([[0.0] * 4, [0.0] * 4, [0.0] * 3 + [1.5], [0.0] * 4], device=device)
    cameras = [camera, dataclasses.replace(camera, viewmat=moved)]
    options = {"max_hits": MAX_HITS, "background": BACKGROUND}
    before = [nw.render(surfels, texture, c, **options).image for c in cameras]
    surfels.footprints, surfels.far_footprints = seen_footprints(surfels, cameras, options=options)
    for c, image in zip(cameras, before, strict=True):
        after = nw.render(surfels, texture, c, **options).image
        assert (after - image).abs().max() < 1 / 255
    far = dataclasses.replace(camera, viewmat=2 * moved - camera.viewmat.detach())
    wide = seen_from(surfels, far).scales > 1.001 * surfels.scales
    assert wide.any()


def test_no_surfels_have_no_footprints(device: torch.device) -> None:
    empty = {name: x[:0] for name, x in make_surfels(random_scene(3)).state_dict().items()}
    surfels = nw.Surfels(empty).to(device)
    camera = make_camera(random_scene(3, device=device))
    surfels.footprints, surfels.far_footprints = seen_footprints(surfels, [camera], options={"max_hits": 0})
    assert surfels.footprints.shape == surfels.far_footprints.shape == (0,)
    out = nw.render(surfels, make_texture(device=device), camera, background=BACKGROUND)
    assert (out.image - torch.tensor(BACKGROUND, device=device)).abs().max() < 1e-6


@pytest.mark.parametrize("name", ["footprints", "far_footprints"])
def test_footprints_of_other_surfels_are_named(name: str) -> None:
    scene = random_scene(5)
    surfels = make_surfels(scene)
    setattr(surfels, name, torch.ones(4))
    with pytest.raises(ValueError, match=rf"^surfels\.{name}: expected shape \(5,?\), got \(4,\)$"):
        nw.render(surfels, None, make_camera(scene))
    setattr(surfels, name, torch.ones(5, dtype=torch.float64))
    with pytest.raises(TypeError, match=rf"^surfels\.{name}: expected dtype torch.float32, got torch.float64$"):
        nw.render(surfels, None, make_camera(scene))
