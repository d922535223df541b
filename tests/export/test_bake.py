import copy
import json
import struct

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.similarity import upright
from nexwarp.export.bake import bake, evaluate, lay_out, mean_colors, measure, observe, texels_at
from nexwarp.export.baked_scene import ATLAS_FILE, BAKED_FILE, BakedScene
from nexwarp.export.glb import CUTOFF, bake_cards, make_cards, save_glb
from nexwarp.export.splats import gaussians, save_splats_spz
from nexwarp.export.web.baked import encode_atlas, encode_baked, encode_harmonics
from tests.export.web import support
from tests.export.web.support import as_stored, psnr, ring, small_model
from tests.narrowing import present
from tests.tolerances import assert_close


@pytest.fixture(scope="module")
def model() -> nw.Model:
    return small_model(sh_degree=1)


@pytest.fixture(scope="module")
def cameras() -> dict[str, nw.Camera]:
    return ring()


@pytest.fixture(scope="module")
def baked(model, cameras) -> BakedScene:
    return bake(model, list(cameras.values()), steps=40)


def test_texels_have_one_owner_each_and_lie_where_sampling_looks_for_them(model, cameras):
    seen = observe(model, list(cameras.values()))
    layout = lay_out(seen.boxes, seen.pixels, seen.influence)
    owners = torch.zeros(layout.height, layout.width, dtype=torch.long)
    ((places, ids, local),) = layout.centres()
    owners.index_put_((places[:, 1], places[:, 0]), torch.ones(len(ids), dtype=torch.long), accumulate=True)
    assert owners.max() == 1 and owners[0].sum() == 0, "the first row is that of surfels without a texture"
    assert owners.sum() == len(ids) > 0
    scene = evaluate(model, seen, layout)
    scene.texels.copy_(torch.rand(scene.texels.shape, generator=torch.Generator().manual_seed(0)))
    x, y = places.T
    assert_close(texels_at(scene, ids, local), scene.texels[y, x], kind="value", name="texels")
    # Beyond its box a surfel has the colours of the box's side.
    x, y = (layout.rects[ids, :2] + layout.rects[ids, 2:] - 1).long().T
    assert_close(texels_at(scene, ids, local + 100.0), scene.texels[y, x], kind="value", name="beyond")


def test_an_atlas_that_is_too_small_has_larger_texels(model, cameras, monkeypatch):
    seen = observe(model, list(cameras.values()))
    large = lay_out(seen.boxes, 2 * seen.pixels, seen.influence)
    monkeypatch.setattr("nexwarp.export.bake.SIDE", 128)
    small = lay_out(seen.boxes, 2 * seen.pixels, seen.influence)
    assert max(small.width, small.height) <= 128 < max(large.width, large.height)


def test_texels_of_a_full_atlas_are_in_proportion_to_what_surfels_change_in_photos(monkeypatch):
    monkeypatch.setattr("nexwarp.export.bake.SIDE", 512)
    boxes, pixels = torch.tensor([-1.0, -1.0, 1.0, 1.0]).repeat(100, 1), torch.full((100, 2), 100.0)
    influence = torch.linspace(400.0, 4000.0, 100)
    texels = lay_out(boxes, pixels, influence).rects[:, 2:].prod(1)
    shares = texels / influence
    assert shares.max() / shares.min() < 1.25, "sides are whole numbers"
    assert 0.7 * 512**2 < texels.sum() <= 512**2
    pixels[0] = 2.0  # a few pixels in all: no more texels than these need
    assert tuple(lay_out(boxes, pixels, influence).rects[0, 2:]) == (5, 5)


@pytest.mark.parametrize("residual", [True, False])
def test_the_first_atlas_has_the_colors_of_the_texture(residual, cameras):
    """A texture without dependence on the direction, on a surfel that is textured in all views, is baked exactly."""
    model = small_model(1, residual=residual, sh_degree=0)
    seen = observe(model, list(cameras.values()))
    assert seen.textured[0] == 1
    image = evaluate(model, seen, lay_out(seen.boxes, 4 * seen.pixels, seen.influence)).render(cameras["1.png"])
    expected = model.render(cameras["1.png"]).image.detach()
    plain = model.bare(max_hits=0).render(cameras["1.png"]).image.detach()
    assert psnr(image, expected) > max(45, psnr(plain, expected) + 10)


def test_the_fit_approaches_the_model(baked, model, cameras):
    gains, (start, _) = [], measure(model, list(cameras.values()))
    for camera in cameras.values():
        expected = model.render(camera).image.detach()
        first = psnr(start.render(camera), expected)
        plain = psnr(model.bare(max_hits=0).render(camera).image.detach(), expected)
        fitted = psnr(as_stored(baked).render(camera), expected)
        assert fitted > plain + 6 and fitted > 24
        gains.append(fitted - first)
    assert sum(gains) > len(gains), "the fit helps by 1 dB"


def test_codes_are_near_the_values(baked):
    atlas = baked.texels[..., :3]
    codes, scale = encode_atlas(atlas)
    inside = atlas.clamp(-scale, scale)
    assert float((support.decode_atlas(codes, scale) - inside).abs().max()) <= 0.51 * scale / 127
    values = present(baked.harmonics)[1].numpy()
    steps, ranges = encode_harmonics(present(baked.harmonics)[1])
    error = np.abs(support.decode_harmonics(steps, ranges) - values)
    assert (error <= np.sqrt(np.abs(values) * ranges[0]) / 127 + ranges[0] / 127**2).all()


@pytest.mark.cuda
def test_a_gpu_bakes_what_the_cpu_bakes(model, baked, cameras, tmp_path):
    views = list(cameras.values())
    moved = copy.deepcopy(model).cuda()
    there = bake(moved, views, steps=40)
    for camera in views:
        assert psnr(as_stored(there).render(camera).cpu(), as_stored(baked).render(camera)) > 35
    assert encode_baked(there, moved, cameras).keys() == {BAKED_FILE, ATLAS_FILE}
    pytest.importorskip("trimesh")
    save_glb(tmp_path / "scene.glb", bake_cards(moved, views, steps=1), views)


def test_the_gltf_file_holds_the_surfels(model, cameras, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    file = tmp_path / "scene.glb"
    scene, seen = measure(model, list(cameras.values()))
    save_glb(file, make_cards(model, scene, seen, "mask"), list(cameras.values()))
    read = trimesh.load(file)
    (mesh,) = read.geometry.values()
    surfels = model.surfels
    visible = (surfels.opacities > CUTOFF).nonzero()[:, 0]
    assert mesh.vertices.shape == (4 * len(visible), 3) and mesh.faces.shape == (2 * len(visible), 3)
    turn = read.graph.get(read.graph.nodes_geometry[0])[0]
    assert np.allclose(turn[:3, :3], upright(list(cameras.values()))) and not turn[:3, 3].any()
    back = torch.from_numpy(np.asarray(mesh.vertices)).float().reshape(-1, 4, 3)
    across = (back - surfels.means[visible, None]) @ surfels.normals[visible, :, None]
    assert float(across.detach().abs().max()) < 1e-4, "corners lie in the surfels' planes"
    assert_close(back.mean(1), surfels.means[visible].detach(), kind="gradient", name="centres")
    # The texture in the middle of a quad: the colour and the alpha at the surfel's centre.
    image = np.asarray(mesh.visual.material.baseColorTexture).astype(float) / 255
    middle = mesh.visual.uv.reshape(-1, 4, 2).mean(1)
    places = np.stack([middle[:, 0] * image.shape[1], (1 - middle[:, 1]) * image.shape[0]], 1) - 0.5
    found = support.bilinear(torch.from_numpy(image), torch.from_numpy(places)).numpy()
    added = texels_at(scene, visible, torch.zeros(len(visible), 2))[:, :3]
    colors = mean_colors(model, seen)[visible] + added
    assert np.abs(found[:, :3] - colors.clamp(0, 1).detach().numpy()).mean() < 0.05
    assert np.abs(found[:, 3] - surfels.opacities[visible].detach().numpy()).max() < 0.05
    size = struct.unpack("<I", file.read_bytes()[12:16])[0]
    (material,) = json.loads(file.read_bytes()[20 : 20 + size])["materials"]
    assert material["alphaMode"] == "MASK" and "KHR_materials_unlit" in material["extensions"]


@pytest.mark.parametrize("unit", [1.0, 1e-3, 3e4])
def test_spz_files_hold_the_gaussians(model, tmp_path, unit):
    library = pytest.importorskip("gaussforge").GaussForge()
    surfels = copy.deepcopy(model.surfels)
    with torch.no_grad():
        surfels.means *= unit
        surfels.log_scales.clamp_(-9.9, 5.9)
    save_splats_spz(tmp_path / "a.spz", gaussians(surfels))
    found = library.read((tmp_path / "a.spz").read_bytes(), "spz")["data"]
    positions, colors, alphas = (np.frombuffer(found[name], np.float32) for name in ("positions", "colors", "alphas"))
    means = surfels.means.detach().numpy()
    step = max(np.abs(means).max() * 2.0**-22, 2.0**-24)
    assert np.abs(positions.reshape(-1, 3) - means).max() <= step
    assert np.abs(colors.reshape(-1, 3) - surfels.sh0[:, 0].detach().numpy()).max() < 0.02
    assert np.abs(1 / (1 + np.exp(-alphas)) - surfels.opacities.detach().numpy()).max() < 1 / 255


def test_what_spz_cannot_hold_is_said(model, tmp_path):
    pytest.importorskip("gaussforge")
    surfels = copy.deepcopy(model.surfels)
    with torch.no_grad():
        surfels.log_scales.fill_(-12.0)
    with pytest.warns(UserWarning, match=r"SPZ holds scales from 4.5e-05 to 379 units; .* change their size"):
        save_splats_spz(tmp_path / "a.spz", gaussians(surfels))
    empty = nw.Surfels.from_activated(*(torch.zeros(0, *shape) for shape in ((3,), (4,), (2,), (), (2,), (16, 3))))
    with pytest.raises(ValueError, match="expected surfels to write, the model has none"):
        save_splats_spz(tmp_path / "b.spz", gaussians(empty))
    with torch.no_grad():
        surfels.means[:] *= 1e9
    with pytest.raises(ValueError, match="SPZ holds Gaussians up to 8,384,512 units from the origin"):
        save_splats_spz(tmp_path / "b.spz", gaussians(surfels))
