import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.paths import look_at
from nexwarp.errors import FormatError, RunError, SettingError
from nexwarp.export import splats as splat_files
from nexwarp.export.mesh import Mesh, _surface, _without_crumbs, extract_mesh, save_mesh
from nexwarp.export.splats import gaussians, save_splats_ply, save_surfels_ply, split_large
from nexwarp.io.pictures import to_uint8
from nexwarp.ops.tsdf import DistanceField
from nexwarp.run.evaluate import psnr
from tests.reference import ewa
from tests.reference.collect import rotations
from tests.render_support import rays_of
from tests.scenes import intrinsics, make_camera, make_surfels, random_scene
from tests.tolerances import assert_close


def read(path: Path) -> dict[str, torch.Tensor]:
    """The vertices, by property, as another program sees them."""
    plyfile = pytest.importorskip("plyfile", reason="an independent reader of PLY (extra `dev`)")
    data = plyfile.PlyData.read(str(path))
    assert [element.name for element in data.elements] == ["vertex"] and data.byte_order == "<"
    vertex = data["vertex"]
    return {p.name: torch.from_numpy(np.array(vertex[p.name])) for p in vertex.properties}


def stack(columns: dict[str, torch.Tensor], *names: str) -> torch.Tensor:
    return torch.stack([columns[name] for name in names], dim=1)


def numbered(name: str, count: int) -> list[str]:
    return [f"{name}_{i}" for i in range(count)]


PLACE = ["x", "y", "z", "nx", "ny", "nz", *numbered("f_dc", 3)]


@pytest.mark.parametrize("sh_degree", [0, 2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_surfels_read_back_bit_for_bit(tmp_path, sh_degree, dtype, device):
    scene = random_scene(sh_degree=sh_degree, dtype=dtype, device=device)
    surfels = make_surfels(scene)
    with torch.no_grad():
        surfels.raw_quats.mul_(3.0)
        surfels.means[0] = torch.tensor([-0.0, 1e-42, 9e15])
    save_surfels_ply(tmp_path / "new" / "a.ply", surfels)
    columns = read(tmp_path / "new" / "a.ply")
    rest = numbered("f_rest", 3 * (sh_degree + 1) ** 2 - 3)
    names = {"means": ["x", "y", "z"], "sh0": numbered("f_dc", 3), "logit_opacities": ["opacity"]}
    names |= {"log_scales": numbered("scale", 2), "raw_quats": numbered("rot", 4), "raw_gammas": numbered("gamma", 2)}
    for name, properties in names.items():
        before = surfels.state_dict()[name].cpu().reshape(len(surfels), -1)
        after = stack(columns, *properties)
        assert after.dtype == dtype and after.numpy().tobytes() == before.contiguous().numpy().tobytes(), name
    assert list(columns) == [*PLACE, *rest, "opacity", *numbered("scale", 2), *numbered("rot", 4), "gamma_0", "gamma_1"]
    if rest:  # all of red, then all of green, then all of blue
        assert stack(columns, *rest).view(len(surfels), 3, -1).mT.equal(scene["sh"][:, 1:].cpu())
    normals = rotations(scene["quats"].cpu())[..., 2]
    assert_close(stack(columns, "nx", "ny", "nz"), normals, kind="value", name="normal")
    assert [f.name for f in (tmp_path / "new").iterdir()] == ["a.ply"]


@pytest.mark.parametrize("given", [0, 1, 3])
@pytest.mark.parametrize("kept", [0, 2, 3])
def test_splats_are_flat_gaussians(tmp_path: Path, given: int, kept: int) -> None:
    scene = random_scene(sh_degree=given)
    save_splats_ply(tmp_path / "a.ply", gaussians(make_surfels(scene), kept))
    columns = read(tmp_path / "a.ply")
    rest = numbered("f_rest", 45)
    assert list(columns) == [*PLACE, *rest, "opacity", *numbered("scale", 3), *numbered("rot", 4)]
    assert all(x.dtype == torch.float32 and x.isfinite().all() for x in columns.values())
    scales = stack(columns, *numbered("scale", 3)).exp()
    along = torch.linspace(-9, 9, 20_001, dtype=torch.float64)[:, None, None]
    kernel, gaussian = ((-(along.abs() ** (2 * x)) / 2).exp().sum(0) for x in (scene["gammas"], 1))
    assert_close(scales[:, :2], scene["scales"] * kernel / gaussian, kind="value", name="scale")
    assert_close(scales[:, 2], splat_files.THINNESS * scales[:, :2].amin(1), kind="value", name="scale_2")
    quats = stack(columns, *numbered("rot", 4))
    assert (quats.norm(dim=1) - 1).abs().max() < 1e-6
    assert_close(rotations(quats), rotations(scene["quats"]), kind="value", name="rotation")
    assert_close(columns["opacity"].sigmoid(), scene["opacities"], kind="value", name="opacity")
    coefficients = stack(columns, *rest).view(-1, 3, 15).mT
    count = (min(given, kept) + 1) ** 2
    assert coefficients[:, : count - 1].equal(scene["sh"][:, 1:count]) and (coefficients[:, count - 1 :] == 0).all()
    assert stack(columns, *numbered("f_dc", 3)).equal(scene["sh"][:, 0])


@pytest.mark.parametrize("degree", [0, 3])
def test_gltf_holds_the_gaussians_of_the_ply(tmp_path: Path, degree: int) -> None:
    """By the ratified KHR_gaussian_splatting: linear scales, opacities in [0, 1], quaternions xyzw."""
    splats = gaussians(make_surfels(random_scene(sh_degree=3)), degree, [CAMERA])
    save_splats_ply(tmp_path / "a.ply", splats)
    splat_files.save_splats_glb(tmp_path / "a.glb", splats, [CAMERA])
    columns, content = read(tmp_path / "a.ply"), (tmp_path / "a.glb").read_bytes()
    assert struct.unpack_from("<4sII", content) == (b"glTF", 2, len(content))
    length, kind = struct.unpack_from("<I4s", content, 12)
    tree, start = json.loads(content[20 : 20 + length]), 20 + length
    assert kind == b"JSON" and length % 4 == 0
    assert struct.unpack_from("<I4s", content, start) == (len(content) - start - 8, b"BIN\0")
    assert tree["buffers"] == [{"byteLength": len(content) - start - 8}]
    primitive = tree["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and tree["extensionsUsed"] == list(primitive["extensions"])
    assert primitive["extensions"][splat_files.SPLATTING] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    sizes, found = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}, {}
    for name, number in primitive["attributes"].items():
        accessor = tree["accessors"][number]
        view = tree["bufferViews"][accessor["bufferView"]]
        assert accessor["componentType"] == 5126 and view["byteOffset"] % 4 == 0
        offset, count = start + 8 + view["byteOffset"], view["byteLength"] // 4
        values = torch.frombuffer(bytearray(content), dtype=torch.float32, offset=offset, count=count)
        found[name.removeprefix(f"{splat_files.SPLATTING}:")] = values.view(accessor["count"], sizes[accessor["type"]])
    assert found["POSITION"].equal(stack(columns, "x", "y", "z"))
    corners = tree["accessors"][primitive["attributes"]["POSITION"]]
    assert corners["min"] == found["POSITION"].amin(0).tolist() and corners["max"] == found["POSITION"].amax(0).tolist()
    assert_close(found["SCALE"], stack(columns, *numbered("scale", 3)).exp(), kind="value", name="scale")
    assert_close(found["OPACITY"][:, 0], columns["opacity"].sigmoid(), kind="value", name="opacity")
    assert found["ROTATION"].equal(stack(columns, "rot_1", "rot_2", "rot_3", "rot_0"))
    names = [f"SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]
    assert names == [name for name in found if name.startswith("SH")]
    assert found[names[0]].equal(stack(columns, *numbered("f_dc", 3)))
    rest = stack(columns, *numbered("f_rest", 45)).view(-1, 3, 15)
    assert all(found[name].equal(rest[..., i]) for i, name in enumerate(names[1:]))
    linear = (found["COLOR_0"][:, :3] - (0.5 + 0.28209479177387814 * found[names[0]]).clamp(0, 1).pow(2.2)).abs()
    assert linear.max() < 0.01 and found["COLOR_0"][:, 3:].equal(found["OPACITY"])
    with pytest.raises(FormatError, match="expected surfels"):
        splat_files.save_splats_glb(tmp_path / "none.glb", gaussians(make_surfels(random_scene(0))), [CAMERA])


# Large surfels become several Gaussians

CAMERA = nw.Camera(torch.eye(4), intrinsics(50, 50, 32, 24).float(), 64, 48)


@pytest.mark.parametrize("opacity", [0.03, 0.3, 0.8, 0.97, 1.0])
@pytest.mark.parametrize("scales", [(0.5, 0.02), (0.6, 0.4), (3.0, 3.0)])
def test_the_pieces_of_a_surfel_have_its_alpha(opacity: float, scales: tuple[float, float]) -> None:
    mean, sizes = torch.tensor([[0.0, 0.0, 1.0]]).double(), torch.tensor([scales]).double()
    pieces = split_large(mean, sizes, torch.tensor([opacity]).double(), [CAMERA], 0.25)
    assert pieces.whole == 0 and len(pieces.ids) > 1 and (pieces.ids == 0).all()
    # A grid has at most 16 pieces on either side, so that of the largest is coarser than asked for.
    assert (pieces.scales.amax(0) <= (0.25 if scales[0] < 1 else 0.5)).all()
    places = 3.5 * sizes * (2 * torch.rand(4000, 2, dtype=torch.float64) - 1)
    expected = min(opacity, 0.99) * torch.exp(-0.5 * (places / sizes).square().sum(1))
    apart = (places[:, None] - pieces.offsets) / pieces.scales
    blended = 1 - (1 - pieces.opacities * torch.exp(-0.5 * apart.square().sum(-1))).prod(1)
    error = (blended - expected).abs()
    assert error.max() < 0.06 and error.mean() < 0.008, (error.max(), error.mean())


def test_small_surfels_and_those_of_no_camera_stay_one_gaussian(tmp_path: Path) -> None:
    surfels = make_surfels(random_scene())
    with torch.no_grad():
        surfels.log_scales.fill_(-9.0)
        surfels.log_scales[::3] = 1.0
    save_splats_ply(tmp_path / "none.ply", gaussians(surfels))
    save_splats_ply(tmp_path / "inf.ply", gaussians(surfels, 3, [CAMERA], float("inf")))
    assert (tmp_path / "none.ply").read_bytes() == (tmp_path / "inf.ply").read_bytes()
    save_splats_ply(tmp_path / "split.ply", gaussians(surfels, 3, [CAMERA]))
    one, several = read(tmp_path / "none.ply"), read(tmp_path / "split.ply")
    kept = torch.exp(one["scale_0"]) < 1
    count = int(kept.sum())
    assert len(several["x"]) > len(one["x"]) and all(several[n][:count].equal(x[kept]) for n, x in one.items())


def test_huge_surfels_do_not_become_a_flood() -> None:
    means = torch.rand(900, 3) + torch.tensor([0.0, 0.0, 2.0])
    pieces = split_large(means, torch.full((900, 2), 80.0).exp(), torch.full((900,), 0.9), [CAMERA], 0.3)
    assert 900 < len(pieces.ids) <= 50_000 + 16 * 900 and len(pieces.ids.unique()) == 900


def test_an_affine_renderer_shows_large_surfels_as_we_do(tmp_path: Path) -> None:
    """A floor that runs up to the camera: one Gaussian each it is another picture, split it is ours to 35 dB."""
    means = torch.cartesian_prod(torch.tensor([-0.7, 0.7]), torch.tensor([0.6]), torch.tensor([0.8, 2.0, 3.2]))
    quats = torch.tensor([[0.5**0.5, 0.5**0.5, 0.0, 0.0]]).expand(6, 4)
    sh, scales = torch.rand(6, 1, 3) * 3 - 1.5, torch.full((6, 2), 0.5)
    surfels = nw.Surfels.from_activated(means, quats, scales, torch.full((6,), 0.9), torch.ones(6, 2), sh)
    # So fine that the renderer's blur does not count.
    camera = nw.Camera(torch.eye(4), intrinsics(300, 300, 200, 150).float(), 400, 300)
    with torch.no_grad():
        mine = nw.render(surfels, None, camera, background=(0.2, 0.5, 0.8)).image
    found = []
    for extent in (float("inf"), 0.1):
        save_splats_ply(tmp_path / "a.ply", gaussians(surfels, 3, [camera], extent))
        columns = {name: x.double() for name, x in read(tmp_path / "a.ply").items()}
        quats, scales = (stack(columns, *numbered(name, n)) for name, n in (("rot", 4), ("scale", 3)))
        shape = stack(columns, "x", "y", "z"), quats, scales.exp(), columns["opacity"].sigmoid()
        colors = 0.5 + 0.28209479177387814 * stack(columns, *numbered("f_dc", 3))
        theirs = ewa.render(*shape, colors, camera, (0.2, 0.5, 0.8))
        found.append(float(psnr(to_uint8(theirs.float()), to_uint8(mine))))
    assert found[0] < 30 and found[1] >= 35, found


# Meshes: a fused sphere lies on the sphere, faces outwards and is whole

RADIUS, VOXEL = 1.0, 0.03


def cameras_around(device: torch.device) -> list[nw.Camera]:
    faces = [[3.0, 0, 0], [-3, 0, 0], [0, 3, 0], [0, -3, 0], [0, 0.1, 3], [0, 0.1, -3]]
    places = faces + [[x, y, z] for x in (-1.7, 1.7) for y in (-1.7, 1.7) for z in (-1.7, 1.7)]
    K = torch.tensor([[120.0, 0, 64], [0, 120, 64], [0, 0, 1]])
    up = torch.tensor([0.0, 0.0, 1.0])
    poses = [look_at(torch.tensor(place, dtype=torch.float32), torch.zeros(3), up) for place in places]
    return [nw.Camera(pose, K, 128, 128).to(device) for pose in poses]


def sphere_depths(camera: nw.Camera) -> torch.Tensor:
    """Exact z-depths of a sphere around the origin, 0 beside it."""
    rays = rays_of(camera).double()
    center = camera.viewmat[:3, 3].double()
    a, b = (rays * rays).sum(-1), rays @ center
    square = b * b - a * (center @ center - RADIUS**2)
    return torch.where(square > 0, (b - square.clamp_min(0).sqrt()) / a, 0.0).float()


def fused(views: list[tuple[nw.Camera, torch.Tensor]]) -> Mesh:
    """The surface in depths of cameras, in dark red: three times as bright, and dimmed."""
    field = DistanceField(VOXEL, 4 * VOXEL, views[0][1].device)
    for camera, depths in views:
        field.reserve(camera, depths, 10_000)
    field.allocate()
    for camera, depths in views:
        field.fuse(camera, depths, depths.new_tensor([1.5, 0.0, 0.0]).repeat(128, 128, 1))
    return _without_crumbs(_surface(field, lambda colors: 0.5 / float(colors.amax()), lambda *_: None))


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
    assert (np.abs(z - 2.9) < VOXEL).sum() > 1000 and ((np.abs(z - 2) < 4 * VOXEL).sum() > 1000) == kept


def test_a_sphere_is_a_sphere_and_closed_across_blocks(sphere):
    """Within a fifth of a voxel, with normals and triangles that face outwards, and the photos' colour."""
    radii = np.linalg.norm(sphere.vertices, axis=1)
    assert np.abs(radii - RADIUS).mean() < 0.2 * VOXEL and np.abs(radii - RADIUS).max() < VOXEL
    assert (sphere.normals * (sphere.vertices / radii[:, None])).sum(1).min() > 0.5
    a, b, c = (sphere.vertices[sphere.triangles[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a) * a).sum(1).min() >= -1e-9
    assert np.abs(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 / (4 * np.pi) - 1) < 0.05
    assert (np.abs(sphere.colors[:, 0].astype(int) - 128) <= 1).all() and (sphere.colors[:, 1:] == 0).all()
    # Edges have two triangles, but where one was too thin to be kept: vertices on blocks' borders are one.
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
    scene = random_scene(20)
    model = nw.Model(make_surfels(scene), None, options=nw.RenderOptions(max_hits=0))
    camera = make_camera(scene)
    with pytest.raises(SettingError, match="--voxel: expected a length above 0"):
        extract_mesh(model, [camera], voxel=float("nan"))
    with pytest.raises(SettingError, match="--voxel: expected a side whose blocks"):
        monkeypatch.setattr("nexwarp.export.mesh.MOST_BLOCKS", 3)
        extract_mesh(model, [camera], voxel=0.01)
    monkeypatch.undo()
    away = nw.Camera(torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ camera.viewmat.detach(), camera.K, 23, 18)
    with pytest.raises(RunError, match="expected surfaces that a training camera sees"):
        extract_mesh(model, [away])
