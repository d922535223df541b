"""Reading photos into uint8 RGB tensors, and shrinking them."""

import struct
import zlib
from pathlib import Path

import numpy as np
import torch


def read_image(path: Path) -> torch.Tensor:
    """Read a photo as COLMAP does: no EXIF orientation is applied; grey is repeated, alpha is dropped.

    Args:
        path: any file that PIL can decode, 8 or 16 bits a channel.

    Returns:
        (H, W, 3) uint8 sRGB.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file cannot be decoded or is truncated.
    """
    from PIL import Image

    if not path.is_file():
        raise FileNotFoundError(f"{path}: image not found, but the COLMAP model names it")
    try:
        with Image.open(path) as image:
            image.load()
            return torch.from_numpy(_to_rgb(image))
    except (
        OSError,
        ValueError,
        SyntaxError,
        EOFError,
        struct.error,
        zlib.error,
        Image.DecompressionBombError,
    ) as error:
        raise ValueError(f"{path}: expected a complete image file, could not decode it: {error}") from error


def _to_rgb(image) -> np.ndarray:
    """(H, W, 3) uint8 of a PIL image."""
    if image.mode.startswith("I"):  # 16-bit greyscale, which PIL's own conversion would clip at 255
        grey = np.clip((np.asarray(image).astype(np.int64) + 128) // 257, 0, 255).astype(np.uint8)
        return np.repeat(grey[:, :, None], 3, axis=2)
    if image.mode == "P":  # palettes may hold transparency, which PIL can drop only by way of RGBA
        image = image.convert("RGBA")
    return np.array(image.convert("RGB"))


def downscale_image(image: torch.Tensor, factor: int) -> torch.Tensor:
    """Average blocks of `factor` x `factor` pixels; what fills no block at the right and bottom is cropped.

    Args:
        image: (H, W, 3) uint8.
        factor: at least 1, at most min(H, W).

    Returns:
        (H // factor, W // factor, 3) uint8, the mean of the 8-bit values rounded to the nearest (half up).
    """
    if factor == 1:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    pixels = image[: height * factor, : width * factor].numpy()
    # Adding up slices is far faster than a sum over two strided axes.
    rows = pixels[::factor].astype(np.int64)
    for offset in range(1, factor):
        rows += pixels[offset::factor]
    total = rows[:, ::factor].copy()
    for offset in range(1, factor):
        total += rows[:, offset::factor]
    area = factor * factor
    return torch.from_numpy(((2 * total + area) // (2 * area)).astype(np.uint8))
