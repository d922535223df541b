import pytest
import torch

import nexwarp as nw
from tests import scenes
from tests.render_support import BACKGROUND, BUFFERS, assert_alike, assert_same, draw, reference_render, twin
from tests.scenes import SURFEL_KEYS, Scene, make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import assert_close, assert_same_ids


def test_the_order_of_the_surfels_changes_nothing(device: torch.device) -> None:
    scene, texture = random_scene(device=device), make_texture(device=device)
    permutation = torch.randperm(len(scene["means"])).to(device)
    shuffled = scene | {key: scene[key][permutation] for key in SURFEL_KEYS}
    out, other = draw(scene, texture), draw(shuffled, texture)
    assert_same(other, out)
    mapped = torch.where(other.ids >= 0, permutation[other.ids.clamp_min(0).long()], -1)
    assert torch.equal(mapped, out.ids.long())


@pytest.mark.parametrize("textured", [False, True])
def test_a_crop_is_a_camera_with_another_centre(textured: bool, device: torch.device) -> None:
    """To the last bit: no result may depend on where a pixel lies in its tile or a tile in the image."""
    scene = random_scene(width=50, height=41, device=device)
    texture = make_texture(device=device) if textured else None
    left, top, width, height = 7, 5, 29, 19
    intrinsics = scene["K"].clone()
    intrinsics[:2, 2] -= torch.tensor([left, top], device=device)
    cropped = draw(scene | {"K": intrinsics, "width": width, "height": height}, texture, max_hits=3)
    full = draw(scene, texture, max_hits=3)
    for name in (*BUFFERS, "ids"):
        window = getattr(full, name)[top : top + height, left : left + width]
        assert torch.equal(getattr(cropped, name), window), name


@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("max_hits", [0, 2])
def test_no_surfels(max_hits: int, textured: bool, device: torch.device) -> None:
    scene = random_scene(0, device=device)
    texture = make_texture(device=device) if textured else None
    surfels, camera = make_surfels(scene), make_camera(scene)
    out = nw.render(surfels, texture, camera, max_hits=max_hits, background=BACKGROUND)
    assert torch.equal(out.image, torch.tensor(BACKGROUND, device=device).expand(18, 23, 3))
    assert (out.ids == -1).all() and not out.alpha.any() and not out.weights.any() and not out.depths.any()
    (out.image.sum() + out.alpha.sum() + out.weights.sum()).backward()
    assert surfels.means.grad is None or surfels.means.grad.shape == (0, 3)


def awkward_scene(device: torch.device, dtype: torch.dtype = torch.float32) -> Scene:
    """Make surfels behind, at, around and across the camera, edge-on, enormous and tiny, in many pairings."""
    scene = random_scene(24, seed=2, dtype=dtype)
    centers = scene["means"] @ scene["viewmat"][:3, :3].T + scene["viewmat"][:3, 3]
    centers[:4, 2] *= -1  # behind
    centers[4:8, 2] = torch.tensor([0.0, 0.01, 1e-6, -1e-6], dtype=dtype)  # at the camera plane
    centers[8] = 0  # at the camera
    scene |= {"means": centers, "viewmat": torch.eye(4, dtype=dtype)}
    scene["scales"][0] = 1e4  # centred behind, seen in front
    scene["scales"][9:13] = 1e4
    scene["scales"][13:17] = 1e-5
    scene["scales"][17] = torch.tensor([1e4, 1e-5], dtype=dtype)
    scene["quats"][18:20] = torch.tensor([0.5, 0.0, 0.5, 0.0], dtype=dtype)  # edge-on
    scene["means"][18] = torch.tensor([0.0, 0.0, 2.0], dtype=dtype)
    scene["means"][19] = torch.tensor([0.5, 0.1, 2.0], dtype=dtype)
    scene["gammas"][20:22] = 60.0
    scene["gammas"][22] = 1.0
    scene["opacities"][20:23] = torch.tensor([1.0, 0.0, 1.0], dtype=dtype)
    return {key: value.to(device) if isinstance(value, torch.Tensor) else value for key, value in scene.items()}


def test_awkward_surfels_agree_with_the_reference(device: torch.device) -> None:
    """Surfels that cross the near plane are clipped by it, never dropped.

    The principal point is moved so that no ray lies in the plane of a surfel, where no answer is right.
    """
    scene = awkward_scene(device, torch.float64)
    scene["K"][0, 2] += 0.1
    surfels, camera = make_surfels(scene), make_camera(scene)
    out = nw.render(surfels, None, camera, max_hits=4)
    expected = reference_render(twin(surfels), None, camera.to("cpu"), max_hits=4)
    assert_same_ids(out.ids, expected.ids, name="ids")
    assert_alike(out, expected)


def in_a_row(device: torch.device, opacities: list[float], scale: float = 100.0) -> Scene:
    """Surfels facing a camera of one pixel, one behind the other, one unit apart."""
    surfels = ((1.0 + index, opacity) for index, opacity in enumerate(opacities))
    return scenes.facing_scene(*surfels, scale=scale, size=(1, 1), focal=10.0, device=device)


def test_of_equal_weights_the_nearer_stays_when_a_heavier_one_comes(device: torch.device) -> None:
    """A hit that is displaced moves before its equals: it came first. Once the nearer one fell out instead."""
    found = 0
    for step in range(400):
        first = 0.05 + step * 1e-4
        scene = in_a_row(device, [first, first / (1 - first), 0.97], scale=1e6)
        out = draw(scene, max_hits=8)
        weight = dict(zip(out.ids[0, 0].tolist(), out.weights[0, 0].tolist(), strict=True))
        if weight[0] != weight[1]:
            continue
        found += 1
        assert out.ids[0, 0, :3].tolist() == [2, 0, 1] and draw(scene, max_hits=2).ids[0, 0].tolist() == [2, 0]
    assert found > 10


@pytest.mark.parametrize(
    ("scale", "mean"),
    [*((scale, (0.0, 0.0, 5.0)) for scale in (1e2, 1e5, 1e6, 1e8)), (1e10, (1e5, 0.0, 0.05)), (1e10, (0.0, 1e7, 0.02))],
)
def test_however_large_a_surfel_is_it_is_seen(scale: float, mean: tuple[float, ...], device: torch.device) -> None:
    """Once a support over a million times as wide as it is far away was clipped as if behind the camera."""
    out = draw(in_a_row(device, [0.9], scale=scale) | {"means": torch.tensor([mean], device=device)})
    assert_close(out.alpha, torch.full((1, 1), 0.9), kind="value", name="alpha")
    assert_close(out.depths[..., 0], torch.full((1, 1), mean[2]), kind="value", name="depth")
