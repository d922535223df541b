"""All passes of a view in one file: laws, references, and bits that come back."""

from dataclasses import fields
from pathlib import Path

import pytest
import torch

import nexwarp as nw
from nexwarp.io.pictures import load_exr, save_exr
from nexwarp.model.buffers import Buffers, load_buffers, render_buffers, save_buffers
from nexwarp.model.texture import DetailLimits
from tests.reference.collect import camera_rays, pixel_centers, rotations
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import FLIPS, assert_close

BACKGROUND = (0.3, 0.9, 0.1)
PASSES = [f.name for f in fields(Buffers) if f.name not in ("camera", "background")]


def make(
    count: int = 24, max_hits: int = 2, textured: bool | str = True, device: torch.device | str = "cpu"
) -> Buffers:
    scene = random_scene(count, device=device)
    texture = make_texture(device=device, residual=textured == "residual") if textured else None
    surfels, camera = make_surfels(scene), make_camera(scene)
    limits = None
    if textured == "residual":
        limits = DetailLimits(*(torch.full((len(surfels),), x / camera.focal, device=device) for x in (3.5, 4.0)))
    options = nw.RenderOptions(max_hits=max_hits, background=BACKGROUND)
    return render_buffers(nw.Model(surfels, texture, detail_limits=limits, options=options), camera)


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
        **dict.fromkeys(["image", "plain", "textured", "normals", "colors.0", "colors.1"], three),
        **dict.fromkeys(["alpha", "expected_depth", "median_depth", "top_depth"], one),
        **dict.fromkeys([f"{n}.{k}" for n in ("depths", "weights") for k in (0, 1)], one),
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
    assert missed.any()
    for name in ("expected_depth", "median_depth", "top_depth", "normals"):
        assert (getattr(full, name)[missed] == 0).all(), name
    # All hits' weights: nothing is missing from the mean.
    assert_close(full.weights.sum(-1), full.alpha, kind="value", name="weights")
    for max_hits in (0, 1, 2):
        fewer = make(count=8, max_hits=max_hits, device=device)
        for name in ("expected_depth", "median_depth", "normals"):
            assert getattr(fewer, name).equal(getattr(full, name)), name
        # Another kernel computes the same depth, which CUDA's fast math may round otherwise.
        assert_close(fewer.top_depth, full.depths[..., 0], kind="value", name="top_depth")


def test_median_depth_is_where_half_of_the_light_is_left(device: torch.device) -> None:
    """Hits are blended in the order of their surfels' centres; the first that leaves at most half is the median's."""
    scene = random_scene(8, device=device)
    full = make(count=8, max_hits=8, device=device)
    viewmat = scene["viewmat"].double()
    centres = scene["means"].double() @ viewmat[2, :3] + viewmat[2, 3]
    order = torch.where(full.ids >= 0, centres[full.ids.clamp_min(0).long()], torch.inf).argsort(dim=-1, stable=True)
    weights, depths = (x.gather(-1, order).double() for x in (full.weights, full.depths))
    left = 1 - weights.cumsum(-1) + weights  # transmittance before each hit
    last = ((left > 0.5) & (weights > 0)).sum(-1, keepdim=True) - 1
    hit = last[..., 0] >= 0
    expected = torch.where(hit, depths.gather(-1, last.clamp_min(0))[..., 0], 0.0)
    assert 0.1 < (full.alpha > 0.5).double().mean() < 0.9 and ((last > 0) & (full.alpha > 0.5)[..., None]).any()
    assert_close(full.median_depth, expected, kind="value", name="median_depth", allow_flips=FLIPS)


def test_normals_are_the_mean_over_all_hits_and_face_the_camera(device: torch.device) -> None:
    """Each hit's normal counts by its weight, on the side that its ray comes from."""
    scene = random_scene(8, device=device)
    full = make(count=8, max_hits=8, device=device)
    there = full.ids >= 0
    hit = there.any(-1)
    axes = rotations(scene["quats"].double())[..., 2]
    own = axes[full.ids.clamp_min(0).long()]
    viewmat = scene["viewmat"].double()
    intrinsics = (scene["K"][0, 0], scene["K"][1, 1], scene["K"][0, 2], scene["K"][1, 2])
    pixels = pixel_centers(scene["width"], scene["height"], viewmat)
    rays = (camera_rays(pixels, *intrinsics) @ viewmat[:3, :3]).view(*hit.shape, 3)
    facing = torch.where((own * rays[:, :, None]).sum(-1, keepdim=True) > 0, -own, own)
    assert (facing != own).any() and (facing == own).any()
    expected = torch.nn.functional.normalize((full.weights.double()[..., None] * facing).sum(2), dim=-1)
    assert_close(full.normals[hit], expected[hit], kind="value", name="normals")
    assert ((full.normals * rays).sum(-1)[hit] < 0).all()
    assert ((full.normals.norm(dim=-1)[hit] - 1).abs() < 1e-5).all()


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
