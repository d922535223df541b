"""Exported surfels: bits that come back, files that an independent reader and an independent renderer understand."""

from pathlib import Path

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.export.splats import THINNESS, Pieces, save_splats_ply, save_surfels_ply, split_large
from nexwarp.io.pictures import to_uint8
from nexwarp.run.evaluate import psnr
from tests.reference import ewa
from tests.reference.collect import rotations
from tests.scenes import intrinsics, make_surfels, random_scene
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
def test_surfels_read_back_bit_for_bit(
    tmp_path: Path, sh_degree: int, dtype: torch.dtype, device: torch.device
) -> None:
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
    save_splats_ply(tmp_path / "a.ply", make_surfels(scene), kept)
    columns = read(tmp_path / "a.ply")
    rest = numbered("f_rest", 45)
    assert list(columns) == [*PLACE, *rest, "opacity", *numbered("scale", 3), *numbered("rot", 4)]
    assert all(x.dtype == torch.float32 and x.isfinite().all() for x in columns.values())
    scales = stack(columns, *numbered("scale", 3)).exp()
    assert_close(scales[:, :2], scene["scales"], kind="value", name="scale")
    assert_close(scales[:, 2], THINNESS * scene["scales"].amin(1), kind="value", name="scale_2")
    quats = stack(columns, *numbered("rot", 4))
    assert (quats.norm(dim=1) - 1).abs().max() < 1e-6
    assert_close(rotations(quats), rotations(scene["quats"]), kind="value", name="rotation")
    assert_close(columns["opacity"].sigmoid(), scene["opacities"], kind="value", name="opacity")
    coefficients = stack(columns, *rest).view(-1, 3, 15).mT
    count = (min(given, kept) + 1) ** 2
    assert coefficients[:, : count - 1].equal(scene["sh"][:, 1:count]) and (coefficients[:, count - 1 :] == 0).all()
    assert stack(columns, *numbered("f_dc", 3)).equal(scene["sh"][:, 0])


# Large surfels become several Gaussians

CAMERA = nw.Camera(torch.eye(4), intrinsics(50, 50, 32, 24).float(), 64, 48)


def blended(pieces: Pieces, at: torch.Tensor) -> torch.Tensor:
    """Alpha of Gaussians in one plane, at (P, 2) places."""
    apart = (at[:, None] - pieces.offsets) / pieces.scales
    return 1 - (1 - pieces.opacities * torch.exp(-0.5 * apart.square().sum(-1))).prod(1)


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
    error = (blended(pieces, places) - expected).abs()
    assert error.max() < 0.06 and error.mean() < 0.008, (error.max(), error.mean())


def test_small_surfels_and_those_of_no_camera_stay_one_gaussian(tmp_path: Path) -> None:
    surfels = make_surfels(random_scene())
    with torch.no_grad():
        surfels.log_scales.fill_(-9.0)
        surfels.log_scales[::3] = 1.0
    save_splats_ply(tmp_path / "none.ply", surfels)
    save_splats_ply(tmp_path / "inf.ply", surfels, cameras=[CAMERA], max_extent=float("inf"))
    assert (tmp_path / "none.ply").read_bytes() == (tmp_path / "inf.ply").read_bytes()
    save_splats_ply(tmp_path / "split.ply", surfels, cameras=[CAMERA])
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
        save_splats_ply(tmp_path / "a.ply", surfels, cameras=[camera], max_extent=extent)
        columns = {name: x.double() for name, x in read(tmp_path / "a.ply").items()}
        theirs = ewa.render(
            stack(columns, "x", "y", "z"),
            stack(columns, *numbered("rot", 4)),
            stack(columns, *numbered("scale", 3)).exp(),
            columns["opacity"].sigmoid(),
            0.5 + 0.28209479177387814 * stack(columns, *numbered("f_dc", 3)),
            camera,
            (0.2, 0.5, 0.8),
        )
        found.append(float(psnr(to_uint8(theirs.float()), to_uint8(mine))))
    assert found[0] < 30 and found[1] >= 35, found


def test_what_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    surfels = make_surfels(random_scene(4))
    (tmp_path / "file").touch()
    for save in (save_surfels_ply, save_splats_ply):
        with pytest.raises(OSError, match="file"):
            save(tmp_path / "file" / "a.ply", surfels)
    assert [f.name for f in tmp_path.iterdir()] == ["file"]
