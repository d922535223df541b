import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import skimage.metrics
import torch
from safetensors.torch import save_file

import nexwarp as nw
from nexwarp.data import View
from nexwarp.errors import SettingError
from nexwarp.io.pictures import CAPTION_HEIGHT, error_map, to_uint8
from nexwarp.ops import ssim as ops_ssim
from nexwarp.run import evaluate as metrics
from nexwarp.run.evaluate import BLOCKS, CONVENTION, evaluate, load_vgg
from tests.cli.support import picture
from tests.scenes import make_camera, make_surfels, make_texture, random_scene


def images(height: int = 48, width: int = 61) -> list[torch.Tensor]:
    """A smooth picture with an edge, and a noisy version of it; uint8."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    target = torch.stack([x, y, (x + y > 0.9).float()], -1)
    noisy = (target + 0.1 * torch.randn(target.shape)).clamp(0, 1)
    return [(picture * 255).round().to(torch.uint8) for picture in (noisy, target)]


def ssim_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    return ops_ssim.ssim_map(*(x / 255 if x.dtype == torch.uint8 else x for x in (image, target)))


def test_ssim_map_is_scikit_images_away_from_the_border(device: torch.device) -> None:
    image, target = images()
    pair = (x.double().numpy() / 255 for x in (image, target))
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0, "full": True}
    _, expected = skimage.metrics.structural_similarity(*pair, channel_axis=2, **options)
    actual = ssim_map(image.to(device), target.to(device)).cpu().double()
    inside = slice(5, -5)
    difference = (actual - torch.from_numpy(expected))[inside, inside]
    assert difference.abs().max() < 2e-4  # moments in float32: 1e-7 over C2 = 9e-4 where the image is flat
    assert abs(difference.mean().item()) < 1e-6
    assert metrics.ssim(image, target) == pytest.approx(actual.mean().item(), abs=1e-6)


def test_psnr_by_hand(device: torch.device) -> None:
    black, white = torch.zeros(4, 6, 3, device=device), torch.ones(4, 6, 3, device=device)
    assert metrics.psnr(black, white) == 0.0 and metrics.psnr(black, black) == math.inf
    assert metrics.psnr(black, torch.full_like(black, 51, dtype=torch.uint8)) == pytest.approx(20 * math.log10(5))
    one = black.to(torch.uint8)
    one[1, 2, 0] = 255
    assert metrics.psnr(one, black) == pytest.approx(10 * math.log10(4 * 6 * 3))


@pytest.mark.parametrize("metric", [metrics.psnr, metrics.ssim])
def test_metrics_do_not_see_below_8_bits(metric: Callable[..., float]) -> None:
    image, target = images()
    exact = image.double() / 255
    shaken = exact + 0.45 / 255 * (2 * torch.rand(exact.shape).double() - 1)
    assert metric(shaken, target) == metric(image, target) == metric(exact.float(), target.float() / 255)
    assert metric(exact * 3 - 1, target) == metric((exact * 3 - 1).clamp(0, 1), target)
    assert metric(*[picture.flip(1) for picture in (image, target)]) == pytest.approx(metric(image, target), abs=1e-5)


def test_to_uint8_rounds_and_clamps() -> None:
    values = torch.tensor([-1.0, 0.0, 0.49 / 255, 0.51 / 255, 254.6 / 255, 1.0, 7.0])
    assert to_uint8(values).tolist() == [0, 0, 0, 1, 255, 255, 255]
    every = torch.arange(256, dtype=torch.uint8)
    assert to_uint8(every.float() / 255).equal(every) and to_uint8(every) is every
    with pytest.raises(ValueError, match="image: expected finite values, got nan at index"):
        to_uint8(torch.tensor([0.0, float("nan")]))
    with pytest.raises(TypeError, match=r"image: expected uint8 or a floating dtype, got torch\.int64"):
        to_uint8(torch.zeros(3, dtype=torch.int64))


def vgg_weights() -> dict[str, torch.Tensor]:
    """Random weights by the names of torchvision's VGG-16, in place of the real 29 MB."""
    generator, channels = torch.Generator().manual_seed(0), 3
    weights: dict[str, torch.Tensor] = {}
    for block, (layers, width) in enumerate(zip(BLOCKS, (64, 128, 256, 512, 512), strict=True)):
        for layer in layers:
            kernel = torch.randn(width, channels, 3, 3, generator=generator) * (2 / (9 * channels)) ** 0.5
            weights |= {f"{layer}.weight": kernel, f"{layer}.bias": torch.zeros(width)}
            channels = width
        weights[f"lin{block}"] = torch.rand(width, generator=generator)
    return weights


@pytest.fixture
def no_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """The file of LPIPS's weights, which does not exist."""
    monkeypatch.setenv("NEXWARP_LPIPS", str(tmp_path / "vgg16.safetensors"))
    metrics._lpips_distance.cache_clear()
    yield tmp_path / "vgg16.safetensors"
    metrics._lpips_distance.cache_clear()


def noisy_and_blurred() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """(40, 48, 3) in [0, 1]: random, the same with noise, and the same blurred."""
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(40, 48, 3, generator=generator)
    noisy = (image + 0.2 * torch.randn(40, 48, 3, generator=generator)).clamp(0, 1)
    return image, noisy, torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], 5, 1, 2)[0].permute(1, 2, 0)


def test_lpips_is_that_of_its_authors(no_weights: Path) -> None:
    """The values are those of the package lpips 0.1.4 with these weights, images in [0, 1]."""
    image, noisy, blurred = noisy_and_blurred()
    save_file(vgg_weights(), no_weights)
    distance = load_vgg(no_weights)
    assert distance(image, noisy).item() == pytest.approx(0.0870887, rel=1e-5)
    assert distance(image, blurred).item() == pytest.approx(0.2263193, rel=1e-5)
    eighth = metrics.lpips_vgg(image, noisy)  # of 8-bit images
    assert eighth is not None and abs(eighth - 0.0870887) < 1e-3 and metrics.lpips_vgg(image, image) == 0.0


@pytest.mark.skipif(not metrics.weights_file().is_file(), reason="no file of LPIPS's weights")
def test_lpips_of_its_authors_weights() -> None:
    """The values are those of the package lpips 0.1.4 with the weights of `benchmarks.lpips_weights`."""
    image, noisy, blurred = noisy_and_blurred()
    distance = load_vgg(metrics.weights_file())
    assert distance(image, noisy).item() == pytest.approx(0.1034049, rel=1e-5)
    assert distance(image, blurred).item() == pytest.approx(0.5712027, rel=1e-5)


def test_lpips_without_weights_is_left_out_with_one_warning(no_weights: Path) -> None:
    image = torch.zeros(16, 17, 3)
    with pytest.warns(RuntimeWarning, match=r"LPIPS is left out.*vgg16.*python -m benchmarks.lpips_weights"):
        assert metrics.lpips_vgg(image, image) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert metrics.lpips_vgg(image, image) is None


def test_damaged_lpips_weights_are_named(no_weights: Path) -> None:
    incomplete = {name: values[:1] for name, values in vgg_weights().items() if name != "lin3"}
    save_file(incomplete, no_weights)
    with pytest.raises(SettingError, match=r"lpips cannot be computed: .*vgg16.safetensors: .*lin3 is missing"):
        metrics.check_metrics(["lpips"], torch.device("cpu"))
    no_weights.write_bytes(b"nothing")
    with pytest.raises(SettingError, match=r"lpips cannot be computed: .*vgg16.safetensors: damaged"):
        metrics.check_metrics(["lpips"], torch.device("cpu"))


def test_a_mask_leaves_the_rest_out() -> None:
    image, target = images()
    mask = torch.zeros(48, 61, dtype=torch.bool)
    mask[10:30, 20:50] = True
    spoilt = torch.where(mask[..., None], image, 255 - image)
    assert metrics.psnr(spoilt, target, mask) == metrics.psnr(image[10:30, 20:50], target[10:30, 20:50])
    assert metrics.psnr(spoilt, target) < metrics.psnr(spoilt, target, mask) - 5
    assert metrics.ssim(spoilt, target, mask) == metrics.ssim(image, target, mask)
    inner = ssim_map(torch.where(mask[..., None], image, target), target)[10:30, 20:50]
    assert metrics.ssim(image, target, mask) == pytest.approx(inner.mean().item(), abs=1e-6)
    everywhere = torch.ones_like(mask)
    assert metrics.psnr(image, target, everywhere) == pytest.approx(metrics.psnr(image, target), abs=1e-9)
    assert metrics.ssim(image, target, everywhere) == pytest.approx(metrics.ssim(image, target), abs=1e-9)


@pytest.mark.parametrize("metric", [metrics.psnr, metrics.ssim])
def test_masks_that_do_not_fit_are_refused(metric: Callable[..., float]) -> None:
    image, target = images()
    with pytest.raises(ValueError, match=r"^mask: expected bool of shape \(48, 61\), got torch.uint8 of shape"):
        metric(image, target, torch.ones(48, 61, dtype=torch.uint8))
    with pytest.raises(ValueError, match=r"^mask: expected at least one included pixel, got none$"):
        metric(image, target, torch.zeros(48, 61, dtype=torch.bool))


def test_flip_is_left_out_with_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.warns(RuntimeWarning, match=r"^FLIP is left out: .*nexwarp\[flip\]"):
        assert metrics.flip(*images()) is None


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
    done: list[tuple[int, int]] = []
    result = evaluate(model, views, renders=tmp_path, progress=lambda *call: done.append(call))
    assert done == [(1, 2), (2, 2)] and list(result["views"]) == list(NAMES)
    assert result["convention"] == CONVENTION
    for view in views:
        written = picture(tmp_path / "test" / Path(view.name).with_suffix(".png"))
        assert torch.equal(written, rendered(model, view.camera))
        figures = result["views"][view.name]
        assert figures["psnr"] == pytest.approx(metrics.psnr(written, view.image), abs=1e-9)
        assert figures["ssim"] == pytest.approx(metrics.ssim(written, view.image), abs=1e-9)
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
