"""Depth of field, motion blur and other projections of `nexwarp render`: laws of the averages, and what is refused."""

import pytest
import torch

import nexwarp as nw
from nexwarp.errors import SettingError
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.run.optics import Optics, lens_point, middle_depth, moved, seen_from
from tests import scenes
from tests.tolerances import assert_close

pytestmark = pytest.mark.usefixtures("one_torch_thread")


@pytest.fixture(scope="module")
def model() -> Model:
    surfels = scenes.make_surfels(scenes.random_scene(60, width=40, height=30))
    return Model(surfels, None, options=RenderOptions(max_hits=2))


@pytest.fixture
def camera() -> nw.Camera:
    camera = scenes.make_camera(scenes.random_scene(60, width=40, height=30))
    return nw.Camera(camera.viewmat.detach(), camera.K, camera.width, camera.height, camera.near)


def test_the_plane_in_focus_stays_and_others_move_with_their_defocus(camera):
    focus, place = 3.0, (0.2, -0.1)
    shifted = seen_from(camera, place, focus)
    local = torch.randn(20, 3)
    local[:, 2] = local[:, 2].abs() + 2
    local[:10, 2] = focus
    world = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    before, after = camera.project(world)[0], shifted.project(world)[0]
    defocus = (1 / focus - 1 / local[:, 2])[:, None] * torch.tensor([camera.fx * place[0], camera.fy * place[1]])
    assert_close(after, before + defocus, kind="value", name="pixels")


def test_points_of_a_lens_cover_it_evenly():
    points = 2 * torch.tensor([lens_point(i, 2000, 1.0) for i in range(2000)])
    radii = points.norm(dim=-1)
    assert radii.max() <= 1 and points.mean(0).norm() < 0.01
    assert abs((radii < 0.5**0.5).float().mean() - 0.5) < 0.01


def test_a_lens_is_the_mean_of_pinholes_and_a_tiny_one_is_a_pinhole(model, camera):
    optics = Optics(aperture=0.3, focus=3.0, samples=5)
    mean = sum(model.render(seen_from(camera, lens_point(i, 5, 0.3), 3.0)).image for i in range(5)) / 5
    assert_close(optics.image(model, camera), mean, kind="value", name="image")
    sharp = model.render(camera).image
    tiny = Optics(aperture=1e-7, samples=2).image(model, camera)
    assert_close(tiny, sharp, kind="value", name="image", allow_flips=0.01)
    assert (optics.image(model, camera) - sharp).abs().mean() > 1e-3


def test_a_shutter_is_the_mean_over_its_time(model, camera):
    viewmat = camera.viewmat.clone()
    viewmat[0, 3] += 0.4
    following = nw.Camera(viewmat, camera.K, camera.width, camera.height, camera.near)
    optics = Optics(shutter=0.5, samples=4)
    mean = sum(model.render(moved(camera, following, 0.5 * (i + 0.5) / 4)).image for i in range(4)) / 4
    assert_close(optics.image(model, camera, following), mean, kind="value", name="image")
    still = optics.image(model, camera, camera)
    assert_close(still, model.render(camera).image, kind="value", name="image", allow_flips=0.01)


def test_an_orthographic_picture_shows_the_middle_depth_as_a_pinhole_does(model, camera):
    optics = Optics(kind="orthographic")
    taken = optics._taken(model, camera)
    assert isinstance(taken, nw.RayCamera)
    assert taken.focal == pytest.approx(camera.focal / middle_depth(model, camera))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "cube"}, "--camera: expected pinhole, panorama"),
        ({"fov": 0.0, "kind": "fisheye"}, "--fov: expected 1 to 360"),
        ({"fov": 90.0}, "--fov: expected together with --camera fisheye"),
        ({"aperture": -1.0}, "--aperture: expected"),
        ({"aperture": float("nan")}, "--aperture: expected"),
        ({"aperture": 0.1, "kind": "panorama"}, "--aperture: expected together with --camera pinhole"),
        ({"focus": 1.0}, "--focus: expected together with --aperture"),
        ({"focus": -1.0, "aperture": 1.0}, "--focus: expected a depth above 0"),
        ({"shutter": 1.5}, "--shutter: expected 0 to 1"),
        ({"samples": 4}, "--samples: expected together with"),
        ({"samples": 0, "shutter": 0.5}, "--samples: expected 1 to"),
    ],
)
def test_options_that_do_not_fit_are_named(options, message):
    with pytest.raises(SettingError, match=message):
        Optics(**options)
