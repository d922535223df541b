from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.kernels.tiles import LARGEST_INT, MAX_ENTRIES
from nexwarp.native.warp import tile_size_on
from tests import scenes
from tests.narrowing import present
from tests.ops.test_laws import awkward_scene
from tests.render_support import BACKGROUND, BUFFERS
from tests.scenes import SURFEL_KEYS, Scene, make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import assert_close, assert_finite

SIDE = 8192
REFUSED = r"^surfels: expected at most 1,073,741,823 \(tile, surfel\) entries, got "


def scene_with(device: torch.device, count: int = 24, **values: Any) -> Scene:
    """A random scene of 16 x 16 pixels with some values the same for all surfels."""
    scene = random_scene(count, width=16, height=16, device=device)
    for name, value in values.items():
        if name in SURFEL_KEYS:
            value = torch.as_tensor(value, dtype=torch.float32, device=device).expand_as(scene[name]).clone()
        scene[name] = value
    return scene


def facing(device: torch.device, **values: Any) -> Scene:
    """One surfel four units before the camera, its axes along the image's; 16 x 16 pixels, a unit is 8 of them."""
    scene = scenes.facing_scene((4.0, 0.9), scale=0.5, size=(16, 16), focal=32.0, device=device)
    for name, value in values.items():
        scene[name] = torch.as_tensor(value, device=device).expand_as(scene[name]).clone()
    return scene


def large_scene(count: int, device: torch.device) -> Scene:
    """A random scene as a photo of 8192 x 8192 pixels shows it."""
    scene = random_scene(count, width=23, height=23, device=device)
    K = torch.tensor([[24.0, 0.0, 11.5], [0.0, 24.0, 11.5], [0.0, 0.0, 23 / SIDE]], device=device) * (SIDE / 23)
    return scene | {"K": K, "width": SIDE, "height": SIDE}


def check_finite(scene: Scene, raw: dict[str, float] | None = None, **options: Any) -> Any:
    """Render with a texture, differentiate every buffer by all that learns, fail unless all of it is finite."""
    surfels, camera = make_surfels(scene), make_camera(scene)
    texture = make_texture(device=surfels.device)
    with torch.no_grad():
        for name, value in (raw or {}).items():
            getattr(surfels, name).fill_(value)
    settings: dict[str, Any] = {"max_hits": 4, "background": BACKGROUND} | options
    out = nw.render(surfels, texture, camera, **settings)
    total = out.image.new_zeros(())
    for name in (*BUFFERS, "expected_depth", "median_depth", "top_depth", "normals"):
        assert_finite(getattr(out, name), name)
        total = total + (getattr(out, name) * torch.randn_like(getattr(out, name))).sum()
    total.backward()
    assert_finite(present(camera.viewmat.grad), "gradient of viewmat")
    for module in (surfels, texture):
        for name, parameter in module.named_parameters():
            assert_finite(present(parameter.grad), f"gradient of {name}")
    return out


CASES: dict[str, dict[str, Any]] = {
    **{f"scales {x:g}": {"scales": x} for x in (1e-38, 1e-25, 1e-8, 1e8, 1e20, 3e38)},
    "needles": {"scales": (1e8, 1e-8)},
    **{f"gammas {x:g}": {"gammas": x} for x in (1.0, 1e3, 1e20)},
    "gammas 1 and 1000": {"gammas": (1.0, 1e3)},
    **{f"opacities {x:g}": {"opacities": x} for x in (0.0, 1.0)},
    "specks with hard edges": {"scales": 1e-8, "gammas": 1e3},
    "endless with hard edges": {"scales": 1e8, "gammas": 1e3, "opacities": 1.0},
    **{f"{name} of {x:g}": {"raw": {name: x}} for name in ("logit_opacities",) for x in (-1e4, -100.0, 100.0, 1e4)},
    **{f"raw_gammas of {x:g}": {"raw": {"raw_gammas": x}} for x in (-1e4, -100.0, 80.0)},
    "log_scales of -200": {"raw": {"log_scales": -200.0}},
    "quaternions of 0": {"raw": {"raw_quats": 0.0}},
    "colours of 1e8": {"sh": 1e8},
}


@pytest.mark.parametrize("case", CASES)
def test_extreme_surfels_are_finite(case: str, device: torch.device) -> None:
    values = dict(CASES[case])
    raw = values.pop("raw", None)
    check_finite(scene_with(device, **values), raw)


@pytest.mark.parametrize("factor", [1e4, 1e8, 1e15])
def test_huge_worlds_are_finite(factor: float, device: torch.device) -> None:
    scene = scene_with(device)
    check_finite(scene | {"means": factor * scene["means"]})
    check_finite(scene | {"means": factor * scene["means"], "scales": factor * scene["scales"]})


@pytest.mark.parametrize("near", [0.0, 0.01])
def test_awkward_surfels_are_finite(near: float, device: torch.device) -> None:
    check_finite(awkward_scene(device) | {"near": near})


@pytest.mark.parametrize("near", [0.0, 0.01])
@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_a_camera_inside_surfels_is_finite(scale: float, near: float, device: torch.device) -> None:
    scene = scene_with(device, scales=scale, near=near)
    check_finite(scene | {"means": make_camera(scene).position.detach().expand(24, 3).clone()})


def test_a_surfel_around_the_camera_is_seen_only_beyond_near(device: torch.device) -> None:
    for depth, near, seen in ((0.0, 0.01, False), (0.005, 0.01, False), (0.005, 0.0, True), (0.02, 0.01, True)):
        out = check_finite(facing(device, means=(0.0, 0.0, depth), scales=1e3) | {"near": near})
        assert_close(out.alpha, torch.full((16, 16), 0.9 if seen else 0.0), kind="value", name=f"alpha at {depth}")


def test_gamma_1000_is_a_quad(device: torch.device) -> None:
    """Opacity inside, nothing outside: 0.5 is 4 pixels, whose edges run between pixel centres."""
    expected = torch.zeros(16, 16)
    expected[4:12, 4:12] = 0.9
    assert_close(check_finite(facing(device, gammas=1e3)).alpha, expected, kind="value", name="alpha")


@pytest.mark.parametrize(("scales", "opacity"), [(1e-8, 0.9), (1e8, 1.0)])
def test_extremes_among_others_leave_those_as_they_are(scales: float, opacity: float, device: torch.device) -> None:
    """Surfels that cannot be seen, specks or sheets behind the camera, change no bit of the picture."""
    scene = scene_with(device)
    viewmat, facing_quat = scene["viewmat"], torch.tensor([1.0, 0.0, 0.0, 0.0], device=device)
    scene |= {"means": scene["means"] @ viewmat[:3, :3].T + viewmat[:3, 3], "viewmat": torch.eye(4, device=device)}
    where = scene["means"][3] if scales < 1 else torch.tensor([0.0, 0.0, -5.0], device=device)
    extreme = scene_with(device, scales=scales, opacities=opacity, means=where, quats=facing_quat)
    both = scene | {key: torch.cat([scene[key], extreme[key]]) for key in SURFEL_KEYS}
    alone, together = check_finite(scene), check_finite(both)
    for name in (*BUFFERS, "ids"):
        assert torch.equal(getattr(alone, name), getattr(together, name)), name


@pytest.mark.parametrize(("width", "height"), [(16, 16), (1, 1), (SIDE, 1), (1, SIDE), (SIDE, 8)])
def test_images_of_any_size(width: int, height: int, device: torch.device) -> None:
    scene = large_scene(200, device)
    whole = make_camera(scene)
    left, top = (SIDE - width) // 2, (SIDE - height) // 2
    camera = whole.crop(left, top, width, height)
    surfels = make_surfels(scene)
    out = nw.render(surfels, None, camera, background=BACKGROUND)
    assert (out.alpha > 0).float().mean() > 0.5
    for name in BUFFERS:
        assert_finite(getattr(out, name), name)
        assert getattr(out, name).shape[:2] == (height, width)
    right, bottom = min(width, 16), min(height, 8)
    corner = nw.render(surfels, None, camera.crop(width - right, height - bottom, right, bottom), background=BACKGROUND)
    for name in (*BUFFERS, "ids"):
        assert torch.equal(getattr(out, name)[-bottom:, -right:], getattr(corner, name)), name


@pytest.mark.cuda
def test_a_large_image() -> None:
    """8192 x 8192 pixels, textured; its last rows are those of a strip."""
    device = torch.device("cuda")
    scene = large_scene(2000, device)
    surfels, texture, camera = make_surfels(scene), make_texture(device=device), make_camera(scene)
    with torch.no_grad():
        out = nw.render(surfels, texture, camera, background=BACKGROUND)
        strip = nw.render(surfels, texture, camera.crop(0, SIDE - 16, SIDE, 16), background=BACKGROUND)
    assert (out.alpha > 0).float().mean() > 0.5
    for name in BUFFERS:
        assert_finite(getattr(out, name), name)
    for name in ("plain", "ids", "depths", "weights", "alpha"):
        assert torch.equal(getattr(out, name)[-16:], getattr(strip, name)), name
    assert_close(out.image[-16:], strip.image, kind="value", name="image", precision=torch.float16)


@pytest.mark.cuda
def test_five_million_surfels() -> None:
    scene = random_scene(5_000_000, width=640, height=480, sh_degree=0, device=torch.device("cuda"))
    scene["scales"] *= 0.05
    assert (check_finite(scene, max_hits=2).alpha > 0).float().mean() > 0.5


# More entries than lists can have


def too_many(device: torch.device, count: int) -> tuple[nw.Surfels, nw.Camera]:
    """Surfels that cover all tiles of an image."""
    scene = large_scene(count, device)
    scene |= {"scales": torch.full_like(scene["scales"], 1e8), "opacities": torch.full_like(scene["opacities"], 0.9)}
    return make_surfels(scene), make_camera(scene)


@pytest.mark.parametrize("count", [6000, 9000, 17_000])
def test_more_entries_than_lists_can_have_are_refused(count: int, device: torch.device) -> None:
    """2^30 and more, 2^31 and more, which int32 takes for negative, 2^32 and more, for positive again."""
    surfels, camera = too_many(device, count)
    tiles = (SIDE // tile_size_on(device.type == "cuda")) ** 2
    assert count * tiles > MAX_ENTRIES
    with pytest.raises(ValueError, match=REFUSED) as caught:
        nw.render(surfels, None, camera, max_hits=0)
    for text in (f"of {count:,} surfels and {tiles:,} tiles", "render fewer"):
        assert text in str(caught.value)


@pytest.mark.parametrize("count", [9000, 17_000])
def test_more_entries_than_int32_counts_never_overrun(count: int, device: torch.device) -> None:
    """On CUDA a list is made before anybody knows how many there are."""
    surfels, camera = too_many(device, count)
    pinhole = ops.Pinhole(camera.K, camera.width, camera.height, camera.near)
    shape = scenes.detached_shape(surfels)
    projection = ops.project(*shape, torch.zeros_like(shape[0]), camera.viewmat)
    tiles = ops.intersect_tiles(shape, projection, camera.viewmat, pinhole, room=1000)
    assert int(tiles.ends[-1]) == LARGEST_INT > len(tiles.surfel_ids) == 1000  # so the walk goes over all surfels
    assert len(tiles.entries) == 0 and ((tiles.surfel_ids >= 0) & (tiles.surfel_ids < count)).all()
