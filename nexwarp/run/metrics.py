"""Image metrics, computed from 8-bit images to be comparable with published numbers."""

import importlib.util
import warnings
from collections.abc import Sequence
from functools import lru_cache

import torch

from nexwarp.errors import SettingError
from nexwarp.io.files import one_line
from nexwarp.io.pictures import to_uint8
from nexwarp.ops.ssim import ssim_map

PIXELS_PER_DEGREE = 67.02064514160156  # FLIP's default: a display 0.7 m and 3840 pixels wide, from 0.7 m
PACKAGES = {"flip": ("flip_evaluator", "flip-evaluator"), "lpips": ("lpips", "lpips")}  # module and package
CONVENTION = (
    "From 8-bit images (float images are clamped to [0, 1] and rounded). PSNR: per image over all pixels and "
    "channels. SSIM: 11x11 Gaussian window, sigma 1.5, per channel, zero 'same' padding, C1 = 0.01^2, "
    "C2 = 0.03^2, mean over all pixels and channels. With a mask, PSNR and SSIM over the included pixels only. "
    "LPIPS: VGG, v0.1, input in [0, 1], not rescaled to [-1, 1]. FLIP: LDR, 67 pixels per degree, mean of the "
    "map. A set's figure is the mean over its images."
)


def psnr(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of two (H, W, 3) images, uint8 or float in [0, 1]; inf if equal.

    Args:
        image: the rendering.
        target: the photo.
        mask: (H, W) bool, True for included pixels; None includes all.
    """
    image, target = _unit_images(image, target)
    error = _included((image.double() - target.double()).square(), mask).mean()
    return (-10.0 * torch.log10(error)).item()


def ssim(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Structural similarity, at most 1, of two (H, W, 3) images, uint8 or float in [0, 1].

    `mask` is that of `psnr`. Excluded pixels take the target's values, as windows of included pixels may cover them.
    """
    image, target = _unit_images(image, target, mask)
    return _included(ssim_map(image, target), mask).mean(dtype=torch.float64).item()


def lpips_vgg(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float | None:
    """LPIPS (VGG, v0.1) of two (H, W, 3) images; None, with one warning, if it is not available.

    It needs the `lpips` package (`pip install nexwarp[lpips]`), which downloads the VGG weights on first use. `mask` is
    that of `psnr`; excluded pixels take the target's values.
    """
    x, y = _unit_images(image, target, mask)
    network = _lpips_network(x.device)
    if network is None:
        return None
    with torch.no_grad():
        return network(x.permute(2, 0, 1)[None], y.permute(2, 0, 1)[None], normalize=False).item()


def flip(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float | None:
    """Mean LDR-FLIP error in [0, 1] of two (H, W, 3) sRGB images at 67 pixels per degree; None if not available.

    It needs the `flip-evaluator` package (`pip install nexwarp[flip]`). `mask` is that of `lpips_vgg`.
    """
    test, reference = _unit_images(image, target, mask)
    try:
        from flip_evaluator import evaluate
    except ImportError as missing:
        warnings.warn(f"FLIP is left out: {missing} (pip install nexwarp[flip])", RuntimeWarning, stacklevel=2)
        return None
    pair = (x.cpu().contiguous().numpy() for x in (reference, test))
    _, error, _ = evaluate(*pair, "LDR", applyMagma=False, parameters={"ppd": PIXELS_PER_DEGREE})
    return float(error)


METRICS = {"psnr": psnr, "ssim": ssim, "flip": flip, "lpips": lpips_vgg}


def check_metrics(metrics: Sequence[str], device: torch.device) -> None:
    """Raise SettingError unless metrics are known, and their packages and weights are there."""
    for name in metrics:
        if name not in METRICS:
            raise SettingError(f"metrics: expected some of {', '.join(METRICS)}, got {name!r}")
        module, package = PACKAGES.get(name, ("", ""))
        if module and importlib.util.find_spec(module) is None:
            raise SettingError(
                f"--metrics: {name} needs the package {package}, which is not installed: pip install 'nexwarp[{name}]'"
            )
    if "lpips" in metrics:
        try:
            _load_lpips(device)
        except (ImportError, OSError, RuntimeError) as error:
            raise SettingError(f"--metrics: lpips cannot be computed: {one_line(error)}") from None


def _load_lpips(device: torch.device) -> torch.nn.Module:
    import lpips

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchvision deprecates the arguments that lpips passes
        return lpips.LPIPS(net="vgg", version="0.1", verbose=False).eval().to(device)


@lru_cache(maxsize=2)
def _lpips_network(device: torch.device) -> torch.nn.Module | None:
    try:
        return _load_lpips(device)
    except (ImportError, OSError, RuntimeError) as error:
        warnings.warn(f"LPIPS is left out: {error} (pip install nexwarp[lpips])", RuntimeWarning, stacklevel=3)
        return None


def _unit_images(
    image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Check two images and return them as float32 multiples of 1/255; excluded pixels take the target's values."""
    for name, tensor in (("image", image), ("target", target)):
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name}: expected a torch.Tensor, got {type(tensor).__name__}")
        if tensor.ndim != 3 or tensor.shape[-1] != 3:
            raise ValueError(f"{name}: expected shape (H, W, 3), got {tuple(tensor.shape)}")
    if target.shape != image.shape:
        raise ValueError(f"target: expected shape {tuple(image.shape)}, got {tuple(target.shape)}")
    if target.device != image.device:
        raise ValueError(f"target: expected a tensor on {image.device}, got one on {target.device}")
    image, target = (to_uint8(picture).float() / 255.0 for picture in (image, target))
    return image if mask is None else torch.where(_check_mask(mask, image)[..., None], image, target), target


def _check_mask(mask: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    if mask.dtype != torch.bool or mask.shape != image.shape[:2]:
        expected = f"bool of shape {tuple(image.shape[:2])}"
        raise ValueError(f"mask: expected {expected}, got {mask.dtype} of shape {tuple(mask.shape)}")
    if not bool(mask.any()):
        raise ValueError("mask: expected at least one included pixel, got none")
    return mask.to(image.device)


def _included(values: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Return the values (P, C) of the P included pixels of (H, W, C) values; all of them without a mask."""
    return values if mask is None else values[_check_mask(mask, values)]
