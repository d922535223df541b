"""Evaluation: its figures are those of the pictures that it writes."""

import os
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.data import View
from nexwarp.io.pictures import CAPTION_HEIGHT, error_map, to_uint8
from nexwarp.run.evaluate import CONVENTION, evaluate, psnr, ssim
from tests.cli.support import picture
from tests.scenes import make_camera, make_surfels, make_texture, random_scene

WIDTH, HEIGHT, GAP = 40, 30, 4
OPTIONS = nw.RenderOptions(max_hits=2, background=(0.2, 0.4, 0.6), sh_degree=2)
NAMES = ("a.png", "deep/er/b.c.jpg")


@pytest.fixture(scope="module")
def model() -> nw.Model:
    return nw.Model(make_surfels(random_scene(24, width=WIDTH, height=HEIGHT)), make_texture(), options=OPTIONS)


def views_of(model: nw.Model) -> list[View]:
    """Two views whose photos are the rendering with noise, more of it in the second."""
    rng = torch.Generator().manual_seed(3)
    camera = make_camera(random_scene(24, width=WIDTH, height=HEIGHT))
    picture = rendered(model, camera).float()
    photos = [picture + std * torch.randn(picture.shape, generator=rng) for std in (8, 40)]
    return [View(camera, p.clamp(0, 255).byte(), None, n) for p, n in zip(photos, NAMES, strict=True)]


@torch.no_grad()
def rendered(model: nw.Model, camera: nw.Camera) -> torch.Tensor:
    return to_uint8(model.render(camera).image)


def test_figures_are_those_of_the_written_pictures(tmp_path, model):
    views = views_of(model)
    done: list[str] = []
    result = evaluate(model, views, renders=tmp_path, progress=done.append)
    assert done == list(NAMES) == list(result["views"])
    assert result["convention"] == CONVENTION
    for view in views:
        written = picture(tmp_path / "test" / Path(view.name).with_suffix(".png"))
        assert torch.equal(written, rendered(model, view.camera))
        figures = result["views"][view.name]
        assert figures["psnr"] == pytest.approx(psnr(written, view.image), abs=1e-9)
        assert figures["ssim"] == pytest.approx(ssim(written, view.image), abs=1e-9)
    each: list[Any] = [result["views"][name] for name in NAMES]
    first, second = each
    assert first["psnr"] > second["psnr"] + 5 and first["ssim"] > second["ssim"]
    for key in ("psnr", "ssim"):
        assert result[key] == pytest.approx((first[key] + second[key]) / 2, abs=1e-12)
    with pytest.raises(ValueError, match=r"^views: expected at least one view"):
        evaluate(model, [])


def test_strips_show_photo_render_and_error(tmp_path, model):
    views = views_of(model)
    evaluate(model, views, renders=tmp_path)
    for view in views:
        strip = picture(tmp_path / "compare" / Path(view.name).with_suffix(".png"))
        assert strip.shape == (HEIGHT + CAPTION_HEIGHT, 3 * WIDTH + 2 * GAP, 3)
        panels = [strip[CAPTION_HEIGHT:, i * (WIDTH + GAP) : i * (WIDTH + GAP) + WIDTH] for i in range(3)]
        render = rendered(model, view.camera)
        for panel, expected in zip(panels, [view.image, render, error_map(render, view.image)], strict=True):
            assert torch.equal(panel, expected)
        assert (strip[:, WIDTH : WIDTH + GAP] == 255).all() and (strip[:CAPTION_HEIGHT] < 128).any()
    files = sorted(str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*") if file.is_file())
    stems = ("a", os.path.join("deep", "er", "b.c"))
    assert files == sorted(os.path.join(folder, f"{stem}.png") for folder in ("test", "compare") for stem in stems)
