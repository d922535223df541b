"""All passes of a view in one file: laws, references, and bits that come back."""

from dataclasses import fields
from pathlib import Path

import pytest
import torch

import nexwarp as nw
from nexwarp.buffers import Buffers, load_buffers, render_buffers, save_buffers
from nexwarp.io.pictures import load_exr, save_exr
from tests.reference.collect import camera_rays, pixel_centers, rotations
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import assert_close

BACKGROUND = (0.3, 0.9, 0.1)
PASSES = [f.name for f in fields(Buffers) if f.name not in ("camera", "background")]


def make(count: int = 24, max_hits: int = 2, textured: bool = True, device: torch.device | str = "cpu") -> Buffers:
    scene = random_scene(count, device=device)
    texture = make_texture(device=device, residual=textured == "residual") if textured else None
    surfels, camera = make_surfels(scene), make_camera(scene)
    if textured == "residual":
        surfels.footprints = torch.full((len(surfels),), 3.5 / camera.focal, device=device)
        surfels.far_footprints = torch.full((len(surfels),), 4.0 / camera.focal, device=device)
    return render_buffers(surfels, texture, camera, max_hits, BACKGROUND)


@pytest.mark.parametrize(("max_hits", "textured"), [(2, True), (2, False), (8, True), (0, False), (2, "residual")])
def test_buffers_add_up_from_the_file_alone(
    tmp_path: Path, device: torch.device, max_hits: int, textured: bool | str
) -> None:
    save_buffers(tmp_path / "a.exr", make(max_hits=max_hits, textured=textured, device=device))
    b = load_buffers(tmp_path / "a.exr")
    behind = (1 - b.alpha)[..., None] * b.background
    for sum_of_hits in (b.textured, (b.weights[..., None] * b.colors).sum(2)):
        assert (b.plain + sum_of_hits + behind - b.image).abs().max() <= 1e-5
    assert b.image.std() > 0.05 and (max_hits == 0 or b.textured.abs().max() > 0.1)


@pytest.mark.parametrize("max_hits", [0, 1, 2])
def test_file_reads_back_bit_for_bit(tmp_path: Path, max_hits: int) -> None:
    before = make(max_hits=max_hits)
    save_buffers(tmp_path / "a.exr", before)
    after = load_buffers(tmp_path / "a.exr")
    for name in PASSES:
        mine, theirs = getattr(after, name), getattr(before, name)
        assert mine.dtype == theirs.dtype and mine.shape == theirs.shape, name
        assert mine.view(torch.int32).equal(theirs.view(torch.int32)), name
    assert after.camera.viewmat.equal(before.camera.viewmat.detach()) and after.camera.K.equal(before.camera.K)
    for name in ("width", "height", "near"):
        assert getattr(after.camera, name) == getattr(before.camera, name)
    assert after.background.tolist() == torch.tensor(BACKGROUND).tolist()
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]


def test_file_holds_named_channels(tmp_path: Path) -> None:
    """As any OpenEXR reader sees it."""
    import numpy as np
    import OpenEXR

    buffers = make()
    save_buffers(tmp_path / "a.exr", buffers)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        kinds = {p.name(): {c: x.pixels.dtype for c, x in p.channels.items()} for p in file.parts}
        ids = next(p for p in file.parts if p.name() == "ids.1").channels["Y"].pixels
    three, one = dict.fromkeys("RGB", np.float32), {"Y": np.float32}
    assert kinds == {
        **dict.fromkeys(["image", "plain", "textured", "normal", "colors.0", "colors.1"], three),
        **dict.fromkeys(
            ["alpha", "expected_depth", "top_depth", *(f"{n}.{k}" for n in ("depths", "weights") for k in (0, 1))], one
        ),
        "ids.0": {"Y": np.uint32},
        "ids.1": {"Y": np.uint32},
    }
    assert ((ids == 2**32 - 1) == (buffers.ids[..., 1] == -1).numpy()).all()


def test_expected_depth_is_the_mean_over_all_hits(device: torch.device) -> None:
    """Of a scene of 8 surfels at most 8 are hit: the buffers of K = 8 hold all of them. K does not matter."""
    full = make(count=8, max_hits=8, device=device)
    total = full.weights.double().sum(-1)
    expected = (full.weights.double() * full.depths).sum(-1) / total.clamp_min(1e-30)
    assert_close(full.expected_depth, expected, kind="value", name="expected_depth")
    missed = total == 0
    assert missed.any() and (full.expected_depth[missed] == 0).all() and (full.normal[missed] == 0).all()
    # All hits' weights: nothing is missing from the mean.
    assert_close(full.weights.sum(-1), full.alpha, kind="value", name="weights")
    for max_hits in (0, 1, 2):
        fewer = make(count=8, max_hits=max_hits, device=device)
        assert fewer.expected_depth.equal(full.expected_depth)
        assert fewer.top_depth.equal(full.depths[..., 0]) and fewer.normal.equal(full.normal)


def test_normals_are_the_heaviest_surfels_and_face_the_camera(device: torch.device) -> None:
    scene = random_scene(device=device)
    buffers = make(device=device)
    hit = buffers.ids[..., 0] >= 0
    axes = rotations(scene["quats"].double())[..., 2]
    own = axes[buffers.ids[..., 0].clamp_min(0).long()]
    viewmat = scene["viewmat"].double()
    intrinsics = (scene["K"][0, 0], scene["K"][1, 1], scene["K"][0, 2], scene["K"][1, 2])
    pixels = pixel_centers(scene["width"], scene["height"], viewmat)
    rays = (camera_rays(pixels, *intrinsics) @ viewmat[:3, :3]).view(*hit.shape, 3)
    cosine = (buffers.normal * own).sum(-1)[hit]
    assert (cosine.abs() - 1).abs().max() < 1e-5 and (cosine < 0).any() and (cosine > 0).any()
    assert ((buffers.normal * rays).sum(-1)[hit] < 0).all()


def test_a_single_quad_has_its_depths_and_normal() -> None:
    """A wall across z = 2, seen head on: every depth is 2, the normal is -z."""
    eye = torch.eye(4)
    surfels = nw.Surfels.from_activated(
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.full((1, 2), 10.0),
        torch.tensor([0.8]),
        torch.full((1, 2), 4.0),
        torch.zeros(1, 1, 3),
    )
    camera = nw.Camera(eye, torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
    buffers = render_buffers(surfels, None, camera, max_hits=0)
    two = torch.full((16, 16), 2.0)
    assert torch.allclose(buffers.expected_depth, two) and torch.allclose(buffers.top_depth, two)
    assert buffers.normal.equal(torch.tensor([0.0, 0.0, -1.0]).expand(16, 16, 3))


def test_nothing_in_view(tmp_path: Path) -> None:
    scene = random_scene(4)
    surfels = nw.Surfels.from_activated(
        *(scene[k][:0] for k in ("means", "quats", "scales", "opacities", "gammas", "sh"))
    )
    buffers = render_buffers(surfels, make_texture(), make_camera(scene), 2, BACKGROUND)
    save_buffers(tmp_path / "a.exr", buffers)
    after = load_buffers(tmp_path / "a.exr")
    assert torch.allclose(after.image, torch.tensor(BACKGROUND).expand_as(after.image))
    for name in ("plain", "textured", "colors", "alpha", "weights", "expected_depth", "top_depth", "normal"):
        assert (getattr(after, name) == 0).all(), name
    assert (after.ids == -1).all()


def test_bad_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"a\.exr: no such file, expected an OpenEXR file"):
        load_buffers(tmp_path / "a.exr")
    (tmp_path / "text.exr").write_text("not a picture")
    with pytest.raises(ValueError, match=r"text\.exr: expected a whole OpenEXR file"):
        load_exr(tmp_path / "text.exr")
    save_buffers(tmp_path / "cut.exr", make())
    content = (tmp_path / "cut.exr").read_bytes()
    for length in (0, 100, len(content) // 5, len(content) // 2, len(content) - 10):
        (tmp_path / "cut.exr").write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"cut\.exr: expected a whole OpenEXR file"):
            load_exr(tmp_path / "cut.exr")
    save_exr(tmp_path / "other.exr", {"image": torch.zeros(3, 4, 3)})
    with pytest.raises(ValueError, match=r"other\.exr: expected the buffers of a nexwarp rendering"):
        load_buffers(tmp_path / "other.exr")


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    buffers = make()
    (tmp_path / "file").write_text("kept")
    with pytest.raises(OSError, match="file"):
        save_buffers(tmp_path / "file" / "a.exr", buffers)
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="expected a file to write, found a folder"):
        save_buffers(tmp_path / "folder", buffers)
    assert {f.name for f in tmp_path.rglob("*")} == {"file", "folder"}
    with pytest.raises(TypeError, match=r"parts\['x'\]: expected float32 or int32, got torch.float64"):
        save_exr(tmp_path / "new" / "a.exr", {"x": torch.zeros(3, 4).double()})
    with pytest.raises(ValueError, match=r"parts\['x'\]: expected shape \(H, W\) or \(H, W, 3\), got \(3, 4, 2\)"):
        save_exr(tmp_path / "new" / "a.exr", {"x": torch.zeros(3, 4, 2)})
    assert not (tmp_path / "new").exists()
