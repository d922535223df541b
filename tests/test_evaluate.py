"""Evaluation: its figures are those of the pictures that it writes."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import nexwarp as nw
from nexwarp.data import View
from nexwarp.io.pictures import CAPTION_HEIGHT, error_map, to_uint8
from nexwarp.run.evaluate import evaluate
from nexwarp.run.metrics import CONVENTION, ssim
from tests.scenes import make_camera, make_surfels, make_texture, random_scene

WIDTH, HEIGHT, GAP = 40, 30, 4
OPTIONS = {"max_hits": 2, "background": [0.2, 0.4, 0.6], "sh_degree": 2, "low_pass": False, "clamp_texture": False}
NAMES = ("a.png", "deep/er/b.c.jpg")


@pytest.fixture(scope="module")
def surfels():
    return make_surfels(random_scene(24, width=WIDTH, height=HEIGHT))


@pytest.fixture(scope="module")
def texture():
    return make_texture()


def read(file: Path) -> torch.Tensor:
    with Image.open(file) as image:
        assert image.mode == "RGB"
        return torch.from_numpy(np.array(image))


def views_of(surfels: nw.Surfels, texture: nw.NeuralTexture) -> list[View]:
    """Two views whose photos are the rendering with noise, more of it in the second."""
    rng = torch.Generator().manual_seed(3)
    camera = make_camera(random_scene(24, width=WIDTH, height=HEIGHT))
    picture = rendered(surfels, texture, camera).float()
    photos = [picture + std * torch.randn(picture.shape, generator=rng) for std in (8, 40)]
    return [View(camera, p.clamp(0, 255).byte(), None, n) for p, n in zip(photos, NAMES, strict=True)]


@torch.no_grad()
def rendered(surfels: nw.Surfels, texture: nw.NeuralTexture, camera: nw.Camera) -> torch.Tensor:
    return to_uint8(nw.render(surfels, texture, camera, **OPTIONS).image)


def psnr_of(a: torch.Tensor, b: torch.Tensor) -> float:
    return -10 * math.log10((((a.double() - b.double()) / 255) ** 2).mean().item())


def test_figures_are_those_of_the_written_pictures(tmp_path, surfels, texture):
    views, done = views_of(surfels, texture), []
    result = evaluate(surfels, texture, views, options=OPTIONS, renders=tmp_path, progress=done.append)
    assert done == list(NAMES) == list(result["views"])
    assert result["convention"] == CONVENTION
    for view in views:
        picture = read(tmp_path / "test" / Path(view.name).with_suffix(".png"))
        assert torch.equal(picture, rendered(surfels, texture, view.camera))
        figures = result["views"][view.name]
        assert figures["psnr"] == pytest.approx(psnr_of(picture, view.image), abs=1e-5)
        assert figures["ssim"] == pytest.approx(ssim(picture, view.image), abs=1e-9)
    first, second = (result["views"][name] for name in NAMES)
    assert first["psnr"] > second["psnr"] + 5 and first["ssim"] > second["ssim"]
    for key in ("psnr", "ssim"):
        assert result[key] == pytest.approx((first[key] + second[key]) / 2, abs=1e-12)


def test_strips_show_photo_render_and_error(tmp_path, surfels, texture):
    views = views_of(surfels, texture)
    evaluate(surfels, texture, views, options=OPTIONS, renders=tmp_path)
    for view in views:
        strip = read(tmp_path / "compare" / Path(view.name).with_suffix(".png"))
        assert strip.shape == (HEIGHT + CAPTION_HEIGHT, 3 * WIDTH + 2 * GAP, 3)
        panels = [strip[CAPTION_HEIGHT:, i * (WIDTH + GAP) : i * (WIDTH + GAP) + WIDTH] for i in range(3)]
        picture = rendered(surfels, texture, view.camera)
        for panel, expected in zip(panels, [view.image, picture, error_map(picture, view.image)], strict=True):
            assert torch.equal(panel, expected)
        assert (strip[:, WIDTH : WIDTH + GAP] == 255).all() and (strip[:CAPTION_HEIGHT] < 128).any()
    files = sorted(str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*") if file.is_file())
    stems = ("a", os.path.join("deep", "er", "b.c"))
    assert files == sorted(os.path.join(folder, f"{stem}.png") for folder in ("test", "compare") for stem in stems)


def test_without_a_folder_the_figures_are_the_same(tmp_path, monkeypatch, surfels, texture):
    views = views_of(surfels, texture)
    monkeypatch.chdir(tmp_path)
    plain = evaluate(surfels, texture, views, options=OPTIONS)
    assert os.listdir(tmp_path) == []
    assert plain == evaluate(surfels, texture, views, options=OPTIONS, renders=tmp_path / "renders")


def test_nothing_learns_from_an_evaluation(surfels, texture):
    evaluate(surfels, texture, views_of(surfels, texture), options=OPTIONS)
    assert all(p.grad is None for p in (*surfels.parameters(), *texture.parameters()))


def test_no_views(surfels, texture):
    with pytest.raises(ValueError, match=r"^views: expected at least one view"):
        evaluate(surfels, texture, [], options=OPTIONS)
