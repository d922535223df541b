"""Evaluation on held-out views, with metrics computed from 8-bit images to be comparable with published numbers."""

import os
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from statistics import fmean
from typing import Any, cast

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch.nn.functional import conv2d, max_pool2d, normalize

from nexwarp.data import View
from nexwarp.errors import FormatError, MissingError, SettingError, check_package, require
from nexwarp.io.files import check_tensors_header, one_line
from nexwarp.io.pictures import error_map, png_files, side_by_side, to_uint8
from nexwarp.model.model import Model
from nexwarp.ops.ssim import ssim_map
from nexwarp.run.folder import COMPARE, TEST, picture_name
from nexwarp.train.ranks.ranks import Ranks

PIXELS_PER_DEGREE = 67.02064514160156  # FLIP's default: a display 0.7 m and 3840 pixels wide, from 0.7 m
CONVENTION = (
    "From 8-bit images (float images are clamped to [0, 1] and rounded). PSNR: per image over all pixels and "
    "channels. SSIM: 11x11 Gaussian window, sigma 1.5, per channel, zero 'same' padding, C1 = 0.01^2, "
    "C2 = 0.03^2, mean over all pixels and channels. With a mask, PSNR and SSIM over the included pixels only. "
    "LPIPS: VGG, v0.1, input in [0, 1], not rescaled to [-1, 1]. FLIP: LDR, 67 pixels per degree, mean of the "
    "map. A set's figure is the mean over its images."
)

# Convolutions of torchvision's `features` in five blocks; LPIPS compares what leaves each of them.
BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of ImageNet's colours, for inputs in [-1, 1]

Values = dict[str, float | None]  # of a view, by metric


@torch.no_grad()
def evaluate(
    model: Model,
    views: Sequence[View],
    *,
    renders: Path | None = None,
    mask_mode: str = "ignore",
    metrics: Sequence[str] = ("psnr", "ssim"),
    progress: Callable[[int, int], object] = lambda *_: None,
    ranks: Ranks | None = None,
) -> dict[str, Any]:
    """Render views, on the model's device, and compare them with their photos.

    Return the metrics, means over the views; flip and lpips are None where their packages or weights are missing. Also
    `views`, the metrics of each by name, and `convention`, how they are computed.

    Args:
        model: what is rendered.
        views: held-out views.
        renders: folder for the images: `test/` gets each rendering, `compare/` a strip of photo, rendering and error
            map. None writes nothing.
        mask_mode: treatment of masked-out pixels: `ignore` excludes them from the metrics, `background` compares them
            with the background colour.
        metrics: names among psnr, ssim, flip and lpips. FLIP and LPIPS need whole images: ignored pixels are copied
            from the photo.
        progress: called with the number of views that are evaluated, and their total.
        ranks: share the views, and return the same on all of them; only rank 0 writes. None is this process alone.
    """
    if not views:
        raise ValueError("views: expected at least one view to evaluate, got none")
    if unknown := [name for name in metrics if name not in METRICS]:
        raise ValueError(f"metrics: expected some of {', '.join(METRICS)}, got {unknown[0]!r}")
    ranks = Ranks.alone(model.device) if ranks is None else ranks
    results: dict[str, Values] = {}
    with png_files() as save:
        for begin in range(0, len(views), ranks.size):
            group = views[begin : begin + ranks.size]
            mine = _judge(model, group[ranks.rank], mask_mode, metrics) if ranks.rank < len(group) else None
            for view, (picture, values) in zip(group, _gathered(mine, group, ranks), strict=True):
                results[view.name] = values
                if renders is not None and ranks.first:
                    photo, mask = compared(model, view, mask_mode)
                    quality = values["psnr"] if "psnr" in values else psnr(picture, photo, mask)
                    captions = ["photo", f"render {quality:.2f} dB", "error (0 to 0.25)"]
                    strip = side_by_side([photo, picture, error_map(picture, photo)], captions=captions)
                    save(renders / TEST / picture_name(view.name), picture)
                    save(renders / COMPARE / picture_name(view.name), strip)
                progress(len(results), len(views))
    summary: dict[str, object] = {"views": results, "convention": CONVENTION}
    for name in metrics:
        known = [value for values in results.values() if (value := values[name]) is not None]
        summary[name] = fmean(known) if len(known) == len(results) else None
    return summary


def _judge(model: Model, view: View, mask_mode: str, metrics: Sequence[str]) -> tuple[torch.Tensor, Values]:
    """Render a view; return the picture, (H, W, 3) uint8 on the CPU, and its metrics."""
    picture = to_uint8(model.render_image(view.camera))
    photo, mask = compared(model, view, mask_mode)
    photo = photo.to(picture.device)
    return picture.cpu(), {name: METRICS[name](picture, photo, mask) for name in metrics}


def compared(model: Model, view: View, mask_mode: str) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return the photo that a rendering is compared with, (H, W, 3) uint8, and the mask of what counts."""
    photo = to_uint8(view.image)
    if view.mask is None or mask_mode != "background":
        return photo, view.mask
    background = to_uint8(torch.as_tensor(model.options.background, dtype=torch.float32))
    return torch.where(view.mask[..., None], photo, background), None


def _gathered(
    mine: tuple[torch.Tensor, Values] | None, views: Sequence[View], ranks: Ranks
) -> list[tuple[torch.Tensor, Values]]:
    """Return what each rank has made of its view; None is a rank without one."""
    values = ranks.gather(None if mine is None else mine[1])
    pictures = ranks.gather_bytes(b"" if mine is None else mine[0].contiguous().numpy().tobytes())
    return [
        (
            torch.frombuffer(bytearray(pixels), dtype=torch.uint8).view(view.camera.height, view.camera.width, 3),
            cast(Values, value),
        )
        for view, pixels, value in zip(views, pictures, values, strict=False)
    ]


def psnr(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of two (H, W, 3) images, uint8 or float in [0, 1]; inf if equal.

    `mask`, (H, W) bool, is True for included pixels; None includes all.
    """
    image, target = _unit_images(image, target, mask)
    error = _included((image.double() - target.double()).square(), mask).mean()
    return (-10.0 * torch.log10(error)).item()


def ssim(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Structural similarity, at most 1, of two images as of `psnr`.

    Excluded pixels take the target's values, as windows of included pixels may cover them.
    """
    image, target = _unit_images(image, target, mask)
    with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):
        return _included(ssim_map(image, target), mask).mean(dtype=torch.float64).item()


def lpips_vgg(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float | None:
    """LPIPS (VGG, v0.1) of two images as of `ssim`, at least 16 pixels a side; None, with one warning, without weights.

    The weights come from `weights_file` (docs/quality.md). It is computed on the GPU where there is one.
    """
    x, y = _unit_images(image, target, mask)
    device = torch.device("cuda") if torch.cuda.is_available() else x.device
    distance = _lpips_distance(device)
    if distance is None:
        return None
    with torch.no_grad(), torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):
        return distance(x.to(device), y.to(device)).item()


def flip(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float | None:
    """Mean LDR-FLIP error in [0, 1] of two images as of `ssim`, at 67 pixels per degree; None if not available.

    It needs the `flip-evaluator` package (`pip install nexwarp[flip]`).
    """
    test, reference = _unit_images(image, target, mask)
    try:
        from flip_evaluator import evaluate as evaluate_flip
    except ImportError as missing:
        warnings.warn(f"FLIP is left out: {missing} (pip install nexwarp[flip])", RuntimeWarning, stacklevel=2)
        return None
    pair = (x.cpu().contiguous().numpy() for x in (reference, test))
    _, error, _ = evaluate_flip(*pair, "LDR", applyMagma=False, parameters={"ppd": PIXELS_PER_DEGREE})
    return float(error)


METRICS = {"psnr": psnr, "ssim": ssim, "flip": flip, "lpips": lpips_vgg}


def check_metrics(metrics: Sequence[str], device: torch.device) -> None:
    """Raise SettingError unless metrics are known, and their packages and weights are there."""
    for name in metrics:
        require(name in METRICS, f"metrics: expected some of {', '.join(METRICS)}, got {name!r}")
    if "flip" in metrics:
        check_package("--metrics: flip", "flip_evaluator", "flip")
    if "lpips" in metrics:
        try:
            load_vgg(weights_file(), device)
        except (OSError, RuntimeError, ValueError) as error:
            raise SettingError(f"--metrics: lpips cannot be computed: {one_line(error)}") from None


@lru_cache(maxsize=2)
def _lpips_distance(device: torch.device) -> "VGG | None":
    try:
        return load_vgg(weights_file(), device)
    except (OSError, RuntimeError, ValueError) as error:
        warnings.warn(f"LPIPS is left out: {one_line(error)}", RuntimeWarning, stacklevel=3)
        return None


def _unit_images(
    image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Check two images and return them as float32 multiples of 1/255; excluded pixels take the target's values."""
    if image.ndim != 3 or image.shape[-1] != 3:
        raise ValueError(f"image: expected shape (H, W, 3), got {tuple(image.shape)}")
    if target.shape != image.shape:
        raise ValueError(f"target: expected shape {tuple(image.shape)}, got {tuple(target.shape)}")
    image, target = (to_uint8(picture).float() / 255.0 for picture in (image, target))
    if mask is None:
        return image, target
    if mask.dtype != torch.bool or mask.shape != image.shape[:2]:
        expected = f"bool of shape {tuple(image.shape[:2])}"
        raise ValueError(f"mask: expected {expected}, got {mask.dtype} of shape {tuple(mask.shape)}")
    if not bool(mask.any()):
        raise ValueError("mask: expected at least one included pixel, got none")
    return torch.where(mask.to(image.device)[..., None], image, target), target


def _included(values: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Return the values (P, C) of the P included pixels of (H, W, C) values; all of them without a mask."""
    return values if mask is None else values[mask.to(values.device)]


def weights_file() -> Path:
    """Return the file of the weights: $NEXWARP_LPIPS, else lpips/vgg16.safetensors in the user's cache folder."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(os.environ.get("NEXWARP_LPIPS") or cache / "nexwarp" / "lpips" / "vgg16.safetensors")


class VGG(torch.nn.Module):
    """Distances of features that VGG-16 computes of two pictures."""

    def __init__(self, weights: dict[str, torch.Tensor]) -> None:
        """Take `0.weight`, `0.bias` ... `28.bias` of torchvision's features, and the heads `lin0` ... `lin4`."""
        super().__init__()
        self.weights = {name: values.float() for name, values in weights.items()}

    def forward(self, image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the distance, a scalar, of two (H, W, 3) pictures as they are: the paper and 3DGS pass [0, 1]."""
        pictures = torch.stack([image, target]).permute(0, 3, 1, 2).float()
        shift, scale = (pictures.new_tensor(values)[:, None, None] for values in (SHIFT, SCALE))
        features, distance = (pictures - shift) / scale, pictures.new_zeros(())
        for block, layers in enumerate(BLOCKS):
            if block > 0:
                features = max_pool2d(features, 2)
            for layer in layers:
                weight, bias = (self.weights[f"{layer}.{name}"] for name in ("weight", "bias"))
                features = conv2d(features, weight, bias, padding=1).relu()
            first, second = normalize(features, eps=1e-10)
            head = self.weights[f"lin{block}"][:, None, None]
            distance = distance + ((first - second).square() * head).sum(0).mean()
        return distance


def load_vgg(file: Path, device: torch.device | str = "cpu") -> VGG:
    """Read the network, for pictures on a device, from a file of `python -m benchmarks.lpips_weights`."""
    if not file.is_file():
        raise MissingError(f"{file}: expected a file, which `python -m benchmarks.lpips_weights` in a clone writes")
    try:
        check_tensors_header(file)
        weights = load_file(file)
    except SafetensorError as error:
        raise FormatError(f"{file}: damaged, {error}") from None
    expected = {f"{layer}.{name}" for layers in BLOCKS for layer in layers for name in ("weight", "bias")}
    expected |= {f"lin{block}" for block in range(len(BLOCKS))}
    if missing := sorted(expected - weights.keys()):
        raise FormatError(f"{file}: expected the weights of LPIPS with VGG-16, {missing[0]} is missing")
    return VGG({name: values.to(device) for name, values in weights.items()})
