import dataclasses
import math

import pytest
import torch

import nexwarp as nw
from nexwarp.run.evaluate import psnr
from tests import scenes
from tests.render_support import rays_of
from tests.tolerances import assert_close

BACKGROUND = (0.2, 0.4, 0.6)


def crowd():
    """Surfels of all directions all around a camera."""
    generator = torch.Generator().manual_seed(3)
    directions = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator), dim=-1)
    means = directions * (2 + 2 * torch.rand(400, 1, generator=generator))
    quats, scales = torch.randn(400, 4, generator=generator), 0.4 + 0.1 * torch.rand(400, 2, generator=generator)
    sh = 0.5 * torch.randn(400, 4, 3, generator=generator)
    surfels = nw.Surfels.from_activated(means, quats, scales, 0.95 * torch.ones(400), torch.ones(400, 2), sh)
    return nw.Model(surfels, None, options=nw.RenderOptions(max_hits=2, background=BACKGROUND))


VIEWMAT = scenes.rigid((0.9, 0.1, 0.2, -0.1), (0.1, -0.2, 0.1)).float()


@pytest.mark.parametrize(("yaw", "pitch"), [(0.0, 0.0), (0.8, 0.3), (3.1, -0.6), (0.3, 1.4)])
def test_rays_of_a_pinhole_turned_anywhere_show_its_picture(device, yaw, pitch):
    """Across the borders of faces, too: blended by distance, and depths in units of the rays."""
    model = crowd().to(device)
    c, s, d, e = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    turn = torch.tensor([[c, 0, -s], [s * e, d, c * e], [s * d, -e, c * d]])
    view = VIEWMAT.clone()
    view[:3] = turn @ VIEWMAT[:3]
    camera = nw.Camera(view, torch.tensor([[90.0, 0, 48], [0, 90.0, 40], [0, 0, 1]]), 96, 80)
    rays = nw.RayCamera(VIEWMAT, rays_of(camera) @ turn, camera.near, camera.focal)
    out, expected = (model.render(x.to(device), order="distance") for x in (rays, camera))
    for name in ("image", "plain", "textured", "alpha"):
        assert (getattr(out, name) - getattr(expected, name)).square().mean().sqrt() < 0.02, name
    for name in ("weights", "depths", "expected_depth", "median_depth", "top_depth", "normals"):
        error = (getattr(out, name) - getattr(expected, name)).abs()
        assert error.median() < 0.01 and error.mean() < 0.08, name
    assert (out.ids == expected.ids).double().mean() > 0.93 and not out.image.requires_grad


def test_panoramas_show_all_around_and_faces_meet():
    """Turned by a quarter, the same picture a quarter farther; mirrored faces would differ at their borders."""
    model, quarter = crowd(), torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    turned = VIEWMAT.clone()
    turned[:3] = quarter @ VIEWMAT[:3]
    first, second = (model.render(nw.RayCamera.panorama(x, 256)) for x in (VIEWMAT, turned))
    assert_close(second.image, first.image.roll(-64, 1), kind="value", name="image", allow_flips=0.01)
    fine = model.render(nw.RayCamera.panorama(VIEWMAT, 1024)).image
    halved = torch.nn.functional.avg_pool2d(fine.permute(2, 0, 1), 4).permute(1, 2, 0)
    assert psnr(halved.clamp(0, 1), first.image.clamp(0, 1)) > 30


def test_pixels_without_a_ray_show_the_background():
    camera = nw.RayCamera.fisheye(VIEWMAT, torch.tensor([[11.0, 0, 32], [0, 11, 32], [0, 0, 1]]), (0,) * 4, 64, 64)
    model = crowd()
    assert 0.05 < (camera.rays.norm(dim=-1) == 0).double().mean() < 0.5
    for rays in (camera, dataclasses.replace(camera, rays=torch.zeros(4, 5, 3))):
        out, empty = model.render(rays), rays.rays.norm(dim=-1) == 0
        assert_close(out.image[empty], torch.tensor(BACKGROUND).expand(int(empty.sum()), 3), kind="value", name="image")
        assert (out.alpha[empty] == 0).all() and (out.ids[empty] == -1).all() and (out.depths[empty] == 0).all()
        assert (out.normals[empty] == 0).all()


def test_a_fisheye_inverts_its_lens():
    K = torch.tensor([[30.0, 0, 32], [0, 31, 24], [0, 0, 1]], dtype=torch.float64)
    k = (0.05, -0.02, 0.003, -0.0001)
    camera = nw.RayCamera.fisheye(torch.eye(4, dtype=torch.float64), K, k, 64, 48, max_angle=1.5)
    rays = camera.rays
    angle = torch.acos(rays[..., 2].clamp(-1, 1))
    factor = angle * (1 + sum(c * angle ** (2 * i + 2) for i, c in enumerate(k)))
    across = rays[..., :2] / rays[..., :2].norm(dim=-1, keepdim=True) * factor[..., None]
    x, y = across[..., 0] * 30 + 32, across[..., 1] * 31 + 24
    seen = rays.norm(dim=-1) > 0
    assert seen.double().mean() > 0.5
    expected = torch.arange(64, dtype=torch.float64) + 0.5
    assert (x - expected)[seen].abs().max() < 1e-4
    assert (y - (torch.arange(48, dtype=torch.float64) + 0.5)[:, None])[seen].abs().max() < 1e-4


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda v: nw.RayCamera.panorama(v, 2), "width: expected"),
        (lambda v: nw.RayCamera.panorama(v, True), "width: expected an int"),
        (lambda v: nw.RayCamera.panorama(2 * v, 8), "viewmat: expected"),
        (lambda v: nw.RayCamera.fisheye(v, torch.eye(3), (0, 0), 8, 8), "distortion: expected k1"),
        (lambda v: nw.RayCamera.fisheye(v, torch.eye(3), (0, 0, 0, math.nan), 8, 8), "distortion: expected"),
        (lambda v: nw.RayCamera(v, torch.zeros(2, 2, 3), 0.1, 1e9), "focal: expected"),
        (lambda v: nw.RayCamera(v, torch.full((2, 2, 3), math.inf), 0.1, 1.0), "rays: expected finite"),
        (lambda v: nw.RayCamera(v, torch.zeros(2, 3), 0.1, 1.0), "rays: expected shape"),
    ],
)
def test_bad_cameras_are_named(make, match):
    with pytest.raises((TypeError, ValueError), match=match):
        make(torch.eye(4))
