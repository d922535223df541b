import dataclasses

import torch
from torch.autograd import gradcheck

import nexwarp as nw
from nexwarp import ops
from nexwarp.data import Scene as Capture
from nexwarp.train.losses import depth_normals, normal_loss
from nexwarp.train.recipe import Config, LossWeights
from nexwarp.train.trainer import Trainer
from tests.scenes import make_camera, make_surfels, random_scene
from tests.tolerances import assert_close
from tests.trainer_support import small

PINHOLE = ((20.0, 22.0), (9.5, 6.5), (18, 13))  # focal lengths, principal point, size


def pinhole(device: torch.device) -> ops.Pinhole:
    (fx, fy), (cx, cy), (width, height) = PINHOLE
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64, device=device)
    return ops.Pinhole(K, width, height, 0.01)


def plane_depths(normal: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Exact z-depths of the plane normal . x = -2 in the camera's frame."""
    (fx, fy), (cx, cy), (width, height) = PINHOLE
    places = (torch.arange(n, dtype=torch.float64, device=device) + 0.5 for n in (height, width))
    y, x = torch.meshgrid(*places, indexing="ij")
    return -2.0 / (torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], -1) @ normal)


def test_a_plane_has_its_normal(device: torch.device) -> None:
    """Seen from a turned camera, in the world's frame, on the side that faces the camera; the border has none."""
    viewmat = random_scene(dtype=torch.float64, device=device)["viewmat"]
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -0.9], dtype=torch.float64, device=device), dim=0)
    found = depth_normals(plane_depths(normal, device), viewmat, pinhole(device))
    expected = torch.zeros_like(found)
    expected[1:-1, 1:-1] = normal @ viewmat[:3, :3]
    assert_close(found, expected, kind="value", name="normals")
    viewmat = viewmat.clone()
    viewmat[:3, 3] *= 1e-9  # the unit of the world does not matter
    found = depth_normals(1e-9 * plane_depths(normal, device), viewmat, pinhole(device))
    assert_close(found, expected, kind="value", name="normals of a tiny world")


def test_beside_a_pixel_without_a_surface_there_is_no_normal(device: torch.device) -> None:
    depths = torch.full(PINHOLE[2][::-1], 2.0, dtype=torch.float64, device=device)
    depths[6, 9] = 0.0
    known = depth_normals(depths, torch.eye(4).to(depths), pinhole(device)).any(-1)
    assert sorted(((~known[1:-1, 1:-1]).nonzero() + 1).tolist()) == [[5, 9], [6, 8], [6, 10], [7, 9]]


def test_depth_normals_against_differences(device: torch.device) -> None:
    depths = 2 + torch.rand(5, 6, dtype=torch.float64, device=device)
    viewmat = random_scene(dtype=torch.float64, device=device)["viewmat"]
    K = torch.tensor([[9.0, 0, 3], [0, 9, 2.5], [0, 0, 1]], dtype=torch.float64, device=device)
    camera = ops.Pinhole(K, 6, 5, 0.01)
    inputs = depths.requires_grad_(), viewmat.clone().requires_grad_()
    assert gradcheck(lambda d, v: depth_normals(d, v, camera), inputs)


def test_normal_loss_by_its_definition(device: torch.device) -> None:
    """The sum over hits of w (1 - n . N), where the K-buffer has all hits."""
    scene = random_scene(8, dtype=torch.float64, device=device)
    surfels, camera = make_surfels(scene), make_camera(scene)
    out = nw.render(surfels, None, camera, max_hits=8)
    toward = depth_normals(out.median_depth, camera.viewmat, out.intermediates.pinhole)
    _, rays = ops.unproject(out.depths, camera.viewmat, out.intermediates.pinhole)
    normals = surfels.normals[out.ids.clamp_min(0).long()]
    normals = normals * torch.where((normals * rays[:, :, None]).sum(-1, keepdim=True) > 0, -1.0, 1.0)
    errors = (out.weights * (1 - (normals * toward[:, :, None]).sum(-1))).sum(-1) * toward.any(-1)
    assert errors.max() > 0.1
    assert_close(normal_loss(out), errors.mean(), kind="value", name="loss")
    counts = torch.rand(errors.shape, device=device) > 0.5
    assert_close(normal_loss(out, counts), (errors * counts).mean(), kind="value", name="masked loss")


def test_the_loss_starts_as_that_of_2dgs() -> None:
    config = Config(losses=LossWeights(normals=0.05))
    assert [config.normals_at(i) for i in (1, 6_999, 7_000, 30_000)] == [0, 0, 0.05, 0.05]
    assert Config().normals_at(30_000) == 0
    short = dataclasses.replace(config, iterations=100)
    assert [short.normals_at(i) for i in (9, 23, 24)] == [0, 0, 0.05]


def test_a_training_has_the_loss_once_it_starts(tiny_scene: Capture) -> None:
    """Before, its steps are those of a training without them, to the last bit."""
    found = []
    for factors in ({}, {"normals": 0.05}):
        trainer = Trainer(tiny_scene, small(losses=LossWeights(**factors)), "cpu")
        steps = [trainer.step() for _ in range(4)]
        found.append([{name: x.item() for name, x in step.losses.items()} for step in steps])
    assert found[1][0] == found[0][0]
    added = [with_them.keys() - without.keys() for without, with_them in zip(*found, strict=True)]
    assert added == [set(), set(), {"normals"}, {"normals"}]
