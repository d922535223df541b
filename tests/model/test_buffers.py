from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.io.pictures import load_exr, save_exr
from nexwarp.model.buffers import Buffers, load_buffers, render_buffers, save_buffers
from nexwarp.model.texture import DetailLimits
from tests.scenes import make_camera, make_surfels, make_texture, random_scene

BACKGROUND = (0.3, 0.9, 0.1)
PASSES = [f.name for f in fields(Buffers) if f.name not in ("camera", "background")]


def make(count: int = 24, max_hits: int = 2, textured: bool | str = True, device: Any = "cpu") -> Buffers:
    scene = random_scene(count, device=device)
    texture = make_texture(device=device, residual=textured == "residual") if textured else None
    surfels, camera = make_surfels(scene), make_camera(scene)
    limits = None
    if textured == "residual":
        limits = DetailLimits(*(torch.full((len(surfels),), x / camera.focal, device=device) for x in (3.5, 4.0)))
    options = nw.RenderOptions(max_hits=max_hits, background=BACKGROUND)
    return render_buffers(nw.Model(surfels, texture, detail_limits=limits, options=options), camera)


@pytest.mark.parametrize(("max_hits", "textured"), [(2, True), (2, False), (8, True), (0, False), (2, "residual")])
def test_buffers_add_up_from_the_file_alone(tmp_path, device, max_hits, textured):
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
    import numpy as np
    import OpenEXR

    buffers = make()
    save_buffers(tmp_path / "a.exr", buffers)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        kinds = {p.name(): {c: x.pixels.dtype for c, x in p.channels.items()} for p in file.parts}
        red = next(p for p in file.parts if p.name() == "image").channels["R"].pixels
        ids = next(p for p in file.parts if p.name() == "ids.1").channels["Y"].pixels
    three, one = dict.fromkeys("RGB", np.float32), {"Y": np.float32}
    assert kinds == {
        **dict.fromkeys(["image", "plain", "textured", "normals", "colors.0", "colors.1"], three),
        **dict.fromkeys(["alpha", "expected_depth", "median_depth", "top_depth"], one),
        **dict.fromkeys([f"{n}.{k}" for n in ("depths", "weights") for k in (0, 1)], one),
        "ids.0": {"Y": np.uint32},
        "ids.1": {"Y": np.uint32},
    }
    assert (red == buffers.image[..., 0].detach().numpy()).all()
    assert (ids.view("int32") == buffers.ids[..., 1].numpy()).all() and (ids == 2**32 - 1).any()


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
