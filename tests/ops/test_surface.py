from typing import Any

import pytest
import torch

import nexwarp as nw
from tests.reference.collect import Shape
from tests.reference.surface import surface
from tests.render_support import view_of
from tests.scenes import Scene, detached_shape, facing_scene, layered_scene, make_camera, make_surfels, named_scene
from tests.tolerances import FLIPS, assert_close

DEPTHS = ("expected_depth", "median_depth", "top_depth")
BUFFERS = (*DEPTHS, "normals", "blended_normals")
MAX_HITS = 8


def draw(scene: Scene, **options: Any) -> nw.Rendering:
    return nw.render(make_surfels(scene), None, make_camera(scene), **options)


def facing_quads(*quads: tuple[float, float], device: torch.device, turned: bool = False) -> Scene:
    """Quads (depth, opacity) wider than the image that face the camera; turned ones show their back."""
    scene = facing_scene(*quads, gamma=50.0, size=(12, 9), dtype=torch.float64, device=device)
    return scene | {"quats": scene["quats"].roll(1, dims=1)} if turned else scene


def assert_everywhere(buffer: torch.Tensor, value: float | list[float], name: str) -> None:
    """Fail unless each pixel has the value."""
    expected = torch.tensor(value, dtype=torch.float64, device=buffer.device).expand_as(buffer)
    assert_close(buffer, expected, kind="value", name=name)


@pytest.mark.parametrize("name", ["random", "layered", "off_centre", "specks"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_surface_agrees_with_the_reference(dtype: torch.dtype, name: str, device: torch.device) -> None:
    scene = named_scene(name, dtype, device)
    surfels, camera = make_surfels(scene), make_camera(scene)
    out = nw.render(surfels, None, camera)
    shape = Shape(*(x.double().cpu() for x in detached_shape(surfels)))
    expected = surface(shape, camera.viewmat.detach().double().cpu(), view_of(camera))
    assert expected.expected_depth.any() and (name != "specks" or not expected.expected_depth.all())
    flips = 0.0 if dtype == torch.float64 else FLIPS
    for buffer in BUFFERS:
        assert_close(*(getattr(out, buffer), getattr(expected, buffer)), kind="value", name=buffer, allow_flips=flips)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("depth", [0.5, 7.0])
def test_an_opaque_quad_has_its_depth_and_its_normal(depth: float, turned: bool, device: torch.device) -> None:
    out = draw(facing_quads((depth, 0.99), device=device, turned=turned))
    for name in DEPTHS:
        assert_everywhere(getattr(out, name), depth, name)
    assert_everywhere(out.normals, [0.0, 0.0, -1.0], "normals")


def test_depths_of_layers_by_hand(device: torch.device) -> None:
    """Weights 0.3, 0.7 * 0.6 = 0.42 and 0.28 * 0.5 = 0.14; transmittances 0.7, 0.28 and 0.14."""
    out = draw(facing_quads((4.0, 0.5), (2.0, 0.3), (3.0, 0.6), device=device))
    assert_everywhere(out.expected_depth, (0.3 * 2 + 0.42 * 3 + 0.14 * 4) / 0.86, "expected depth")
    assert_everywhere(out.median_depth, 3.0, "median depth")
    assert_everywhere(out.top_depth, 3.0, "top depth")
    # Where it is mostly transparent, the median is the last hit.
    out = draw(facing_quads((2.0, 0.3), (5.0, 0.2), device=device))
    assert_everywhere(out.median_depth, 5.0, "median depth")
    assert_everywhere(out.top_depth, 2.0, "top depth")


@pytest.mark.parametrize("max_hits", [0, 1, MAX_HITS])
def test_surface_does_not_depend_on_max_hits(max_hits: int, device: torch.device) -> None:
    scene = layered_scene(device=device)
    out, expected = draw(scene, max_hits=max_hits), draw(scene, max_hits=2)
    for name in BUFFERS:
        assert torch.equal(getattr(out, name), getattr(expected, name)), name
