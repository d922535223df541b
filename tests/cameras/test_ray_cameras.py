"""Cameras of rays: what they render is what pinholes render, and no surfel is lost."""

import math

import pytest
import torch

import nexwarp as nw
from nexwarp.model import render as module
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.native.warp import tile_size_on
from nexwarp.ops.rays import RayTiles
from nexwarp.run.evaluate import psnr
from tests import scenes
from tests.panorama_support import places, turned
from tests.tolerances import FLIPS, assert_close, assert_same_ids

BUFFERS = ("image", "plain", "textured", "depths", "weights", "alpha")
SURFACE = ("expected_depth", "median_depth", "top_depth", "normals")


def make_model(scene, max_hits=2, textured=True):
    surfels = scenes.make_surfels(scene)
    texture = None
    if textured:
        texture = scenes.make_texture(dtype=surfels.means.dtype, device=surfels.device)
    options = RenderOptions(max_hits=max_hits, background=(0.2, 0.4, 0.6))
    return Model(surfels, texture, options=options)


@pytest.mark.parametrize("max_hits", [0, 2, 8])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_pinhole_given_as_rays_is_the_pinhole(device, seed, max_hits):
    scene = scenes.random_scene(60, seed=seed, width=67, height=45, device=device)
    model, camera = make_model(scene, max_hits), scenes.make_camera(scene)
    with torch.no_grad():
        expected, actual = model.render(camera), model.render(nw.RayCamera.pinhole(camera))
    assert_same_ids(actual.ids, expected.ids, name="ids", allow_flips=FLIPS)
    for name in (*BUFFERS, *SURFACE):
        if getattr(expected, name).numel():
            assert_close(getattr(actual, name), getattr(expected, name), kind="value", name=name, allow_flips=FLIPS)


def everywhere(surfels, keys, rays):
    """Lists that cull nothing."""
    order = torch.sort(keys.float(), stable=True).indices.int()
    side = tile_size_on(rays.is_cuda)
    columns, rows = -(-rays.shape[1] // side), -(-rays.shape[0] // side)
    offsets = torch.arange(columns * rows + 1, device=rays.device) * len(order)
    return RayTiles(order.repeat(columns * rows), offsets, columns)


def cameras_of(viewmat, width=150, height=90):
    K = torch.tensor([[40.0, 0, 70], [0, 41, 44], [0, 0, 1]]).to(viewmat)
    return {
        "panorama": nw.RayCamera.panorama(viewmat, width, height),
        "tiny panorama": nw.RayCamera.panorama(viewmat, 20),
        "fisheye": nw.RayCamera.fisheye(viewmat, K, (-0.02, 0.003, 0.0, 0.0), width, height),
        "orthographic": nw.RayCamera.orthographic(viewmat, width, height, 0.05),
    }


@pytest.mark.parametrize("kind", ["panorama", "tiny panorama", "fisheye", "orthographic"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lists_lose_no_surfel(device, kind, seed, monkeypatch):
    scene = scenes.random_scene(200, seed=seed, device=device)
    scene["means"] = scene["means"] * torch.tensor([1.0, 1.0, 2.0], device=device) - scene["means"].mean(0)
    model = make_model(scene, textured=False)
    camera = cameras_of(scene["viewmat"])[kind]
    culled = model.render(camera)
    assert culled.alpha.mean() > 0.05
    monkeypatch.setattr(module, "intersect_rays", everywhere)
    whole = model.render(camera)
    for name in ("ids", *BUFFERS, *SURFACE):
        assert torch.equal(getattr(culled, name), getattr(whole, name)), name


def crowd():
    """Surfels of all directions all around a camera."""
    generator = torch.Generator().manual_seed(3)
    directions = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator), dim=-1)
    means = directions * (2 + 2 * torch.rand(400, 1, generator=generator))
    quats, scales = torch.randn(400, 4, generator=generator), 0.4 + 0.1 * torch.rand(400, 2, generator=generator)
    sh = 0.5 * torch.randn(400, 4, 3, generator=generator)
    surfels = nw.Surfels.from_activated(means, quats, scales, 0.95 * torch.ones(400), torch.ones(400, 2), sh)
    return Model(surfels, None, options=RenderOptions(max_hits=2))


VIEWMAT = scenes.rigid((0.9, 0.1, 0.2, -0.1), (0.1, -0.2, 0.1)).float()


def test_crops_of_a_panorama_are_pinhole_views():
    """Each pixel of a pinhole view by distance, looked up in a fine panorama."""
    model = crowd()
    wide = model.render(nw.RayCamera.panorama(VIEWMAT, 1024)).image
    K = torch.tensor([[40.0, 0, 24], [0, 40.0, 20], [0, 0, 1]])
    for yaw, pitch in ((0.0, 0.0), (1.2, 0.3), (3.1, -0.6), (0.3, 1.4)):
        view = turned(VIEWMAT, yaw, pitch)
        camera = nw.Camera(view, K, 48, 40)
        rays = nw.RayCamera.pinhole(camera)
        expected = model.render(camera, order="distance").image
        x, y = places(rays.rays @ view[:3, :3] @ VIEWMAT[:3, :3].T, 1024)
        around = torch.cat([wide[:, -1:], wide, wide[:, :1]], 1).permute(2, 0, 1)[None]
        place = torch.stack([(x + 1) / 1026, y / 512], -1)[None] * 2 - 1
        sample = torch.nn.functional.grid_sample(around, place, padding_mode="border", align_corners=False)
        assert psnr(sample[0].permute(1, 2, 0).clamp(0, 1), expected.clamp(0, 1)) > 40, (yaw, pitch)


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


def test_an_orthographic_view_is_a_pinhole_far_away():
    scene = scenes.random_scene(60, width=64, height=48, dtype=torch.float64)
    model = make_model(scene)
    far, pixel = 3e4, 0.1
    viewmat = scene["viewmat"]
    camera = nw.RayCamera.orthographic(viewmat, 64, 48, pixel)
    back = viewmat.clone()
    back[2, 3] += far
    K = torch.tensor([[far / pixel, 0, 32], [0, far / pixel, 24], [0, 0, 1]], dtype=torch.float64)
    with torch.no_grad():
        actual, expected = model.render(camera), model.render(nw.Camera(back, K, 64, 48, near=far))
    assert actual.alpha.mean() > 0.05
    assert psnr(actual.image.clamp(0, 1), expected.image.clamp(0, 1)) > 50
    assert (actual.median_depth - (expected.median_depth - far))[actual.alpha > 0.6].abs().median() < 1e-3


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda v: nw.RayCamera.panorama(v, 2), "width: expected"),
        (lambda v: nw.RayCamera.panorama(v, True), "width: expected an int"),
        (lambda v: nw.RayCamera.panorama(2 * v, 8), "viewmat: expected"),
        (lambda v: nw.RayCamera.fisheye(v, torch.eye(3), (0, 0), 8, 8), "distortion: expected k1"),
        (lambda v: nw.RayCamera.fisheye(v, torch.eye(3), (0, 0, 0, math.nan), 8, 8), "distortion: expected"),
        (lambda v: nw.RayCamera.orthographic(v, 8, 8, 0.0), "pixel: expected"),
        (lambda v: nw.RayCamera(v, torch.full((2, 2, 3), math.inf), 0.1, 1.0), "rays: expected finite"),
        (lambda v: nw.RayCamera(v, torch.zeros(2, 3), 0.1, 1.0), "rays: expected shape"),
    ],
)
def test_bad_cameras_are_named(make, match):
    with pytest.raises((TypeError, ValueError), match=match):
        make(torch.eye(4))
