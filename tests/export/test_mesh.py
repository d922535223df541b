"""Meshes: a fused sphere lies on the sphere, faces outwards and is whole; files, and what is refused."""

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.paths import look_at
from nexwarp.errors import RunError, SettingError
from nexwarp.export.mesh import Mesh, _surface, _without_crumbs, extract_mesh, save_mesh
from nexwarp.ops.tsdf import DistanceField
from tests import scenes
from tests.render_support import rays_of

pytestmark = pytest.mark.usefixtures("one_torch_thread")

RADIUS, VOXEL = 1.0, 0.03


def cameras_around(device: torch.device) -> list[nw.Camera]:
    faces = [[3.0, 0, 0], [-3, 0, 0], [0, 3, 0], [0, -3, 0], [0, 0.1, 3], [0, 0.1, -3]]
    places = faces + [[x, y, z] for x in (-1.7, 1.7) for y in (-1.7, 1.7) for z in (-1.7, 1.7)]
    K = torch.tensor([[120.0, 0, 64], [0, 120, 64], [0, 0, 1]])
    up = torch.tensor([0.0, 0.0, 1.0])
    return [
        nw.Camera(look_at(torch.tensor(p, dtype=torch.float32), torch.zeros(3), up), K, 128, 128).to(device)
        for p in places
    ]


def sphere_depths(camera: nw.Camera) -> torch.Tensor:
    """Exact z-depths of a sphere around the origin, 0 beside it."""
    rays = rays_of(camera).double()
    center = camera.viewmat[:3, 3].double()
    a, b = (rays * rays).sum(-1), rays @ center
    square = b * b - a * (center @ center - RADIUS**2)
    return torch.where(square > 0, (b - square.clamp_min(0).sqrt()) / a, 0.0).float()


def fused(views: list[tuple[nw.Camera, torch.Tensor]]) -> Mesh:
    """The surface in depths of cameras, in dark red."""
    field = DistanceField(VOXEL, 4 * VOXEL, views[0][1].device)
    for camera, depths in views:
        field.reserve(camera, depths, 10_000)
    field.allocate()
    for camera, depths in views:
        field.fuse(camera, depths, depths.new_tensor([0.5, 0.0, 0.0]).repeat(128, 128, 1))
    return _without_crumbs(_surface(field, lambda *_: None))


@pytest.fixture
def sphere(device: torch.device) -> Mesh:
    return fused([(camera, sphere_depths(camera)) for camera in cameras_around(device)])


@pytest.mark.parametrize(("past", "kept"), [(6, True), (20, False)])
def test_a_surface_outlasts_some_views_that_see_past_it_but_not_many(past, kept, device):
    """Two views see a sheet at depth 2, the others what is at 2.9: a thin surface stays, a floater goes."""
    camera = cameras_around(device)[0]
    mesh = fused([(camera, torch.full((128, 128), z, device=device)) for z in [2.0] * 2 + [2.9] * past])
    viewmat = camera.viewmat.double().cpu().numpy()
    z = mesh.vertices @ viewmat[2, :3] + viewmat[2, 3]
    assert (np.abs(z - 2.9) < VOXEL).sum() > 1000
    assert ((np.abs(z - 2) < 4 * VOXEL).sum() > 1000) == kept


def test_a_sphere_is_a_sphere(sphere):
    """Within a fifth of a voxel, with normals and triangles that face outwards, and the photos' colour."""
    radii = np.linalg.norm(sphere.vertices, axis=1)
    assert np.abs(radii - RADIUS).mean() < 0.2 * VOXEL and np.abs(radii - RADIUS).max() < VOXEL
    outward = sphere.vertices / radii[:, None]
    assert (sphere.normals * outward).sum(1).min() > 0.5
    a, b, c = (sphere.vertices[sphere.triangles[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a) * a).sum(1).min() >= -1e-9
    assert np.abs(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 / (4 * np.pi) - 1) < 0.05
    assert (np.abs(sphere.colors[:, 0].astype(int) - 128) <= 1).all() and (sphere.colors[:, 1:] == 0).all()


def test_a_sphere_is_closed_across_blocks(sphere):
    """Edges have two triangles, but where a triangle was too thin to be kept: vertices on blocks' borders are one."""
    edges = np.sort(np.concatenate([sphere.triangles[:, p] for p in ([0, 1], [1, 2], [2, 0])]), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).mean() > 0.998 and counts.max() == 2


def test_crumbs_go_and_the_rest_stays(sphere):
    crumb = Mesh(
        np.concatenate([sphere.vertices, 5 + np.eye(3, dtype=np.float32)]),
        np.concatenate([sphere.normals, np.eye(3, dtype=np.float32)]),
        np.concatenate([sphere.colors, np.zeros((3, 3), np.uint8)]),
        np.concatenate([sphere.triangles, len(sphere.vertices) + np.array([[0, 1, 2]], np.int32)]),
    )
    cleaned = _without_crumbs(crumb)
    assert np.array_equal(cleaned.triangles, sphere.triangles) and np.array_equal(cleaned.vertices, sphere.vertices)


def test_files_are_read_back(sphere, tmp_path):
    plyfile = pytest.importorskip("plyfile", reason="an independent reader of PLY (extra `dev`)")
    save_mesh(tmp_path / "mesh.ply", sphere)
    vertices, faces = plyfile.PlyData.read(str(tmp_path / "mesh.ply")).elements
    names = (["x", "y", "z"], ["nx", "ny", "nz"], ["red", "green", "blue"])
    assert [p.name for p in vertices.properties] == [name for group in names for name in group]
    for group, expected in zip(names, (sphere.vertices, sphere.normals, sphere.colors), strict=True):
        found = np.stack([vertices[name] for name in group], 1)
        assert found.dtype == expected.dtype and np.array_equal(found, expected), group
    assert np.array_equal(np.stack(faces["vertex_indices"]), sphere.triangles)


def test_what_cannot_be_a_mesh_is_named(monkeypatch):
    scene = scenes.random_scene(20)
    model = nw.Model(scenes.make_surfels(scene), None, options=nw.RenderOptions(max_hits=0))
    camera = scenes.make_camera(scene)
    with pytest.raises(SettingError, match="--voxel: expected a length above 0"):
        extract_mesh(model, [camera], voxel=float("nan"))
    with pytest.raises(SettingError, match="--voxel: expected a side whose blocks"):
        monkeypatch.setattr("nexwarp.export.mesh.MOST_BLOCKS", 3)
        extract_mesh(model, [camera], voxel=0.01)
    monkeypatch.undo()
    away = nw.Camera(torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ camera.viewmat.detach(), camera.K, 23, 18)
    with pytest.raises(RunError, match="expected surfaces that a training camera sees"):
        extract_mesh(model, [away])
