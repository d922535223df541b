from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.machine import deterministic
from nexwarp.model.render import jitter_factors, pinhole_of
from tests.render_support import MAX_HITS, assert_alike, assert_same, draw
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import assert_close


@pytest.mark.parametrize("max_hits", [0, 2, MAX_HITS])
def test_a_residual_texture_of_zeros_shows_the_plain_colours(max_hits: int, device: torch.device) -> None:
    """What no photo looked at: features that the regulariser has taken to 0."""
    scene = random_scene(device=device)
    texture = make_texture(device=device, residual=True)
    torch.nn.init.zeros_(texture.grid)
    assert_alike(draw(scene, texture, max_hits=max_hits), draw(scene, max_hits=max_hits))
    absent = draw(scene, make_texture(device=device), max_hits=0)
    assert_alike(draw(scene, texture, max_hits=max_hits), absent, ("image", "alpha"))


def test_a_residual_texture_is_what_it_adds(device: torch.device) -> None:
    scene = random_scene(device=device)
    with_it, without = (draw(scene, make_texture(device=device, residual=flag)) for flag in (True, False))
    shift = draw(scene).textured - 0.5 * without.weights.sum(-1, keepdim=True)
    assert_close(with_it.textured, without.textured + shift, kind="value", name="textured")
    with pytest.raises(ValueError, match=r"^clamp_texture: expected False with a residual texture, got True$"):
        draw(scene, make_texture(device=device, residual=True), clamp_texture=True)


@pytest.mark.parametrize("jitter", [0.5, 3.0])
def test_jitter_moves_lookups_along_their_rays(jitter, device, monkeypatch):
    """By a normal share of a pixel's size there, and nothing but what the texture says changes."""
    scene = random_scene(width=120, height=90, device=device)
    texture, colors = make_texture(device=device), nw.NeuralTexture.evaluate
    lookups: list[torch.Tensor] = []

    def spy(texture: nw.NeuralTexture, positions: torch.Tensor, *arguments: Any, **options: Any) -> torch.Tensor:
        lookups.append(positions.detach())
        return colors(texture, positions, *arguments, **options)

    monkeypatch.setattr(nw.NeuralTexture, "evaluate", spy)
    still, camera = draw(scene, texture), make_camera(scene)
    generator = torch.Generator(device).manual_seed(3)
    factors = jitter_factors(camera, 2, jitter, generator)
    moved = draw(scene, texture, jitter=factors)
    assert_same(moved, still, ("plain", "depths", "weights", "alpha"))
    assert torch.equal(moved.ids, still.ids)
    hit = still.ids >= 0
    before, after = (x[hit] - camera.position.detach() for x in lookups[:2])
    share = after.norm(dim=-1) / before.norm(dim=-1)
    assert_close(after, before * share[:, None], kind="value", name="along the ray")
    pixels = (share - 1) * camera.focal
    assert len(pixels) > 5000
    error = 5 / len(pixels) ** 0.5  # five standard deviations of what is estimated
    assert abs(pixels.mean().item()) < error * jitter and abs(pixels.std().item() - jitter) < error * jitter
    assert not torch.equal(moved.textured, still.textured)
    assert_same(draw(scene, texture, jitter=factors), moved)
    other = jitter_factors(camera, 2, jitter, generator)
    assert not torch.equal(draw(scene, texture, jitter=other).textured, moved.textured)
    with pytest.raises(ValueError, match=r"^jitter: expected shape"):
        draw(scene, texture, jitter=torch.ones(2, 3, dtype=factors.dtype, device=device))


def test_factors_on_depths_are_those_of_their_products(device: torch.device) -> None:
    """With the gradients, of which those of points may have rows that lie apart, as the texture's do."""
    camera = make_camera(random_scene(width=9, height=7, device=device))
    given = [2 + torch.rand(7, 9, 2, dtype=torch.float64, device=device), camera.viewmat.detach().double()]
    factors, signal = (torch.rand(7, 9, 2, *x, dtype=torch.float64, device=device) for x in ((), (4,)))
    found = []
    for inside in (False, True):
        depths, viewmat = (x.clone().requires_grad_() for x in given)
        arguments = (depths, factors) if inside else (depths * factors, None)
        points, _ = ops.unproject(arguments[0], viewmat, pinhole_of(camera, viewmat), arguments[1])
        rows = signal[..., :3] if inside else signal[..., :3].contiguous()
        found.append([points, *torch.autograd.grad(points, [depths, viewmat], rows)])
    for name, one, other in zip(("points", "depths", "viewmat"), *found, strict=True):
        assert_close(other, one, kind="gradient", name=name)


def test_pictures_without_textured_hits_have_gradients(device: torch.device) -> None:
    """K = 0: no point is looked up, and the grid's gradient is 0, also where sums are deterministic."""
    scene = random_scene(device=device)
    surfels, texture = make_surfels(scene), make_texture(device=device)
    with deterministic(device.type == "cuda"):
        out = nw.render(surfels, texture, make_camera(scene), max_hits=0)
        grid, sh = torch.autograd.grad(out.image.sum(), [texture.grid, surfels.sh0])
    assert (grid == 0).all() and sh.isfinite().all() and sh.abs().max() > 0
