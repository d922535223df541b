"""Read photos and masks into uint8 tensors, and reduce them."""

import io
import os
import struct
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import numpy as np
import torch

from nexwarp.errors import FormatError
from nexwarp.io.files import one_line
from nexwarp.io.pictures import display_light, exr_size, load_deep, load_exr_colors, to_uint8

if TYPE_CHECKING:
    import PIL.Image

# PIL supports other formats; some of them start other programs.
FORMATS = ("JPEG", "MPO", "PNG", "WEBP", "TIFF", "BMP", "PPM", "GIF", "TGA", "JPEG2000", "AVIF", "HEIF")
MAX_SUM = 2**32 - 1
MAX_PIXELS = 178_956_970  # PIL's own error limit, twice its limit for a warning
# Larger images are refused above a ratio of pixels to bytes that no photo reaches: (2,000, 16,000 for bilevel images).
HONEST_PIXELS, HONEST_RATIO = 40_000_000, (2_000, 16_000)
MAX_READS = 1_000_000  # a second; a GIF file of 100 MB has as many
WHITE = 128  # threshold of a mask; if no value reaches it, as in a mask of 0 and 1, all values above 0 are used
WIDTH, HEIGHT, BITS, PHOTOMETRIC, ORIENTATION, SAMPLE_FORMAT = 256, 257, 258, 262, 274, 339  # TIFF tags
WHITE_IS_ZERO, UNSIGNED = 0, 1
MAKE, MODEL, EXIF_IFD = 271, 272, 0x8769  # EXIF tags
EXIF_ERRORS = (OSError, ValueError, SyntaxError, KeyError, TypeError, struct.error)  # of PIL, for damaged EXIF
EXR, DEEP = ".exr", (".png", ".tif", ".tiff")  # suffixes of files of linear light, and of those of up to 16 bits
COPY_QUALITY = 97  # of upright copies of JPEG files

Color: TypeAlias = tuple[float, float, float]  # sRGB in [0, 1]
Item = TypeVar("Item")
Result = TypeVar("Result")


@cache
def decodable_formats() -> list[str]:
    """PIL's names of the formats that are read; HEIF is one of them if the package pillow-heif is installed."""
    from PIL import Image

    Image.init()  # so that it knows the formats that this build can decode
    if "HEIF" not in Image.OPEN:
        with suppress(ImportError):
            import pillow_heif

            pillow_heif.register_heif_opener()
    return [name for name in FORMATS if name in Image.OPEN]


@contextmanager
def quiet_pillow() -> Iterator[None]:
    """Suppress PIL's warning of very large images; twice that size is an error in any case."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        yield


def read_in_threads(
    read: Callable[[Item], Result],
    items: Sequence[Item],
    threads: int,
    done: Callable[[int], None] = lambda count: None,
) -> list[Result]:
    """Return what `read` returns of each item; decoding frees the GIL. `done` is called with the number of them.

    An error ends the reading: items that wait are left.
    """
    results = []
    with ThreadPoolExecutor(threads) as pool:
        for result in pool.map(read, items):
            results.append(result)
            done(len(results))
    return results


class _Bounded(io.BufferedReader):
    """A file that limits each read to the file's size, and the number of reads.

    PIL reads lengths that damaged files give, and Python allocates the whole length before reading. Between the markers
    of a damaged JPEG file PIL reads byte by byte.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(str(path)))
        self._size, self._reads = os.fstat(self.fileno()).st_size, 0

    def read(self, size: int | None = -1, /) -> bytes:
        self._reads += 1
        if self._reads > MAX_READS:
            raise ValueError(f"its content needs more than {MAX_READS:,} reads")
        return super().read(-1 if size is not None and size > self._size else size)


@contextmanager
def _opened(path: Path) -> Iterator["PIL.Image.Image"]:
    """Open an image with PIL; errors in the block, too, become a ValueError of one line."""
    from PIL import Image, UnidentifiedImageError

    try:
        with _Bounded(path) as file, Image.open(file, formats=decodable_formats()) as image:
            # PIL's own check can be disabled by other libraries.
            pixels = image.width * image.height
            if pixels > MAX_PIXELS:
                raise Image.DecompressionBombError
            if pixels > HONEST_PIXELS + HONEST_RATIO[image.mode == "1"] * path.stat().st_size:
                raise ValueError(f"{image.width}x{image.height} pixels are more than a file of this size holds")
            _check_numbers(path, image)
            yield image
    except (FormatError, FileNotFoundError):
        raise
    except Image.DecompressionBombError:
        raise ValueError(
            f"{path}: expected an image of at most {MAX_PIXELS // 10**6} megapixels, got more; reduce it first"
        ) from None
    except UnidentifiedImageError:
        raise ValueError(
            f"{path}: expected a complete image file, could not decode it: no format is known; "
            "photos have 8 or 16 bits a channel"
        ) from None
    except Exception as error:  # PIL's decoders raise many types for damaged files
        raise ValueError(f"{path}: expected a complete image file, could not decode it: {one_line(error)}") from error


def _check_numbers(path: Path, image: "PIL.Image.Image") -> None:
    """Raise FormatError where the range of an image's numbers is unknown: floats, signed and 32-bit integers."""
    tags = getattr(image, "tag_v2", {})
    formats = tags.get(SAMPLE_FORMAT, (UNSIGNED,))
    if image.mode == "F" or (image.mode == "I" and tags) or any(kind != UNSIGNED for kind in formats):
        numbers = "floats" if image.mode == "F" else "signed or 32-bit integers"
        raise FormatError(f"{path}: expected 8 or 16 bits a channel, got {numbers}, whose range is unknown; convert it")
    if image.mode.startswith("I;16") and (tags.get(BITS, (16,))[0] != 16 or tags.get(PHOTOMETRIC) == WHITE_IS_ZERO):
        raise FormatError(f"{path}: expected 8 or 16 bits a channel with 0 as black, got another TIFF file; convert it")


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image in pixels as stored, from its header; errors are those of `read_image`."""
    if path.suffix.lower() == EXR and path.is_file():
        return exr_size(path)
    with quiet_pillow(), _opened(path) as image:
        tags = getattr(image, "tag_v2", None)
        return image.size if tags is None else (int(tags[WIDTH]), int(tags[HEIGHT]))


def _orientation(image: "PIL.Image.Image") -> int:
    """Return the EXIF orientation, 1 to 8, of an image that is not decoded yet; 1 (upright) without a valid one."""
    if image.format == "PNG" and not image.info.keys() & {"exif", "Raw profile type exif", "xmp"}:
        return 1  # PIL would decode the whole file to look for EXIF behind the pixels
    try:
        value = image.getexif().get(ORIENTATION)
    except EXIF_ERRORS:
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def is_turned(path: Path) -> bool:
    """Whether the EXIF orientation of an image says that its pixels are not upright; errors as of `read_image`."""
    with quiet_pillow(), _opened(path) as image:
        return _orientation(image) != 1


@contextmanager
def _loaded(path: Path, upright: bool = False) -> Iterator["PIL.Image.Image"]:
    """Open an image and decode its pixels, as stored or upright."""
    from PIL import ImageOps

    with _opened(path) as image:
        turned = upright and _orientation(image) != 1
        if not turned:
            with suppress(*EXIF_ERRORS):
                image.getexif().pop(ORIENTATION, None)  # by which PIL turns TIFF files, and no others
        image.load()
        if turned:
            ImageOps.exif_transpose(image, in_place=True)
        yield image


def read_image(path: Path, white: float | None = None) -> torch.Tensor:
    """Read a photo (H, W, 3) uint8 sRGB as COLMAP does; see `read_transparent`."""
    return read_transparent(path, white)[0]


def read_transparent(path: Path, white: float | None = None) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Read a photo (H, W, 3) uint8 sRGB without EXIF orientation, grey repeated, and its alpha (H, W) uint8, or None.

    With `white` the file holds linear light, of which this value becomes white; what is brighter is clipped. The
    largest number of 8 or 16 bits a channel is 1. OpenEXR files hold linear light always, with a `white` of 1 if None.
    ValueError: the file cannot be decoded, is truncated, holds numbers of unknown range (floats, signed or 32-bit
    integers), or has more than 178 megapixels; or PyAV is missing for a PNG or TIFF file of linear light.
    """
    if white is None and path.suffix.lower() != EXR:
        with _loaded(path) as image:
            alpha = _alpha(image)
            return torch.from_numpy(_to_rgb(image)), None if alpha is None else torch.from_numpy(alpha)
    width, height = image_size(path)
    if width * height > MAX_PIXELS:
        raise ValueError(f"{path}: expected an image of at most {MAX_PIXELS // 10**6} megapixels, got more")
    if path.suffix.lower() == EXR:
        linear = torch.from_numpy(load_exr_colors(path))
    elif path.suffix.lower() in DEEP:
        linear = torch.from_numpy(load_deep(path).astype(np.float32) / 65535)
    else:
        linear = read_image(path).float() / 255
    return to_uint8(display_light((linear / (white or 1.0)).clamp(0, 1))), None


def copy_upright(path: Path, target: Path) -> torch.Tensor:
    """Write an upright copy of a photo, in the format of the target's suffix, and return its (H, W, 3) uint8 pixels.

    The copy keeps of EXIF the camera and how it was set (focal length). Errors are those of `read_image`.
    """
    from PIL import Image

    with _loaded(path, upright=True) as image:
        pixels = _to_rgb(image)
    kept = Image.Exif()
    with _opened(path) as image, suppress(*EXIF_ERRORS):
        exif = image.getexif()
        kept.get_ifd(EXIF_IFD).update(exif.get_ifd(EXIF_IFD))
        kept.update({tag: exif[tag] for tag in (MAKE, MODEL) if tag in exif})
    target.parent.mkdir(parents=True, exist_ok=True)
    copy = Image.fromarray(pixels)
    try:
        copy.save(target, quality=COPY_QUALITY, subsampling=0, exif=kept.tobytes())
    except (ValueError, TypeError, struct.error):  # EXIF that PIL cannot write, as above 64 KB
        copy.save(target, quality=COPY_QUALITY, subsampling=0)
    return torch.from_numpy(pixels)


def read_mask(path: Path) -> torch.Tensor:
    """Read a mask (H, W) bool: True for values of at least 128, of 16 bits 32768; without any, for those above 0.

    The value of a pixel is its brightness, on black where it is transparent. In a palette file it is the index, as in
    label maps, unless the palette's colours in use are grey, or black and one other colour.
    """
    with _loaded(path) as image:
        values, white = _mask_values(image), WHITE
        if image.mode.startswith("I"):
            white = 256 * WHITE
    used = values >= white
    return torch.from_numpy(used if used.any() else values > 0)


def read_grey(path: Path) -> np.ndarray:
    """Read the numbers (H, W) float32 of a grey image, 0 to 255 or 65535; FormatError for another, else as above."""
    with _loaded(path) as image:
        if image.mode != "L" and not image.mode.startswith("I"):
            raise FormatError(f"{path}: expected one channel of 8 or 16 bits, got the mode {image.mode}")
        return np.asarray(image).astype(np.float32)


def _mask_values(image: "PIL.Image.Image") -> np.ndarray:
    """Return the values (H, W) that decide which pixels of a mask are used."""
    if image.mode == "1":
        return np.array(image).astype(np.uint8)
    if image.mode.startswith("I"):
        return np.array(image)
    if image.mode != "P":
        return np.array(_on_black(image).convert("L"))
    shown = _on_black(image).convert("RGB")
    used = np.array([color for _, color in shown.getcolors(256) or []])
    black_and_another = len(used) == 2 and not used.any(axis=1).all()
    if black_and_another or (used == used[:, :1]).all():
        return np.array(shown).max(axis=2)
    return np.array(image)


def _on_black(image: "PIL.Image.Image") -> "PIL.Image.Image":
    """Composite a transparent image on black."""
    from PIL import Image

    if not image.has_transparency_data:
        return image
    return Image.alpha_composite(Image.new("RGBA", image.size, (0, 0, 0, 255)), _to_rgba(image))


def _alpha(image: "PIL.Image.Image") -> np.ndarray | None:
    """Return the alpha (H, W) uint8 of an image; None if it has none."""
    if not image.has_transparency_data:
        return None
    if image.mode.startswith("I"):  # PNG files with one transparent value of 16 bits
        return np.where(np.asarray(image) == image.info["transparency"], 0, 255).astype(np.uint8)
    return np.array(_to_rgba(image).getchannel("A"))


def _to_rgba(image: "PIL.Image.Image") -> "PIL.Image.Image":
    """Convert to RGBA; PIL has no direct way from premultiplied grey."""
    return image.convert("LA" if image.mode == "La" else image.mode).convert("RGBA")


def _to_rgb(image: "PIL.Image.Image") -> np.ndarray:
    """Convert a PIL image to (H, W, 3) uint8."""
    if image.mode.startswith("I"):  # 16-bit grey, which PIL's conversion would clip at 255
        grey = ((np.asarray(image).clip(0, 65535).astype(np.uint32) + 128) // 257).astype(np.uint8)
        return np.repeat(grey[:, :, None], 3, axis=2)
    if image.mode in ("P", "PA", "La"):  # PIL drops their transparency only through RGBA
        image = _to_rgba(image)
    return np.array(image.convert("RGB"))


def compose(image: torch.Tensor, alpha: torch.Tensor, background: Color) -> torch.Tensor:
    """Composite a photo (H, W, 3) uint8, not premultiplied, of alpha (H, W) uint8 on a colour in [0, 1], in sRGB."""
    out = torch.empty_like(image)
    for channel, color in enumerate(background):
        a = alpha.float() / 255.0
        mixed = image[:, :, channel].float().mul_(a).add_((1.0 - a) * (255.0 * color))
        out[:, :, channel] = mixed.add_(0.5).clamp_(0, 255).byte()
    return out


def downscale_mask(mask: torch.Tensor, factor: int) -> torch.Tensor:
    """Reduce a mask (H, W) bool in blocks as `downscale_image`; a pixel is True if its whole block is."""
    if factor == 1:
        return mask
    height, width = mask.shape[0] // factor, mask.shape[1] // factor
    blocks = mask[: height * factor, : width * factor].reshape(height, factor, width, factor)
    return blocks.all(dim=3).all(dim=1)


def resize_nearest(values: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """Resample values (H, W) to (height, width) by nearest neighbours."""
    rows = ((torch.arange(height) + 0.5) * (values.shape[0] / height)).long()
    columns = ((torch.arange(width) + 0.5) * (values.shape[1] / width)).long()
    return values[rows][:, columns]


def downscale_image(image: torch.Tensor, factor: int) -> torch.Tensor:
    """Average blocks of `factor` x `factor` pixels of an image (H, W, C) uint8; incomplete ones are cropped.

    Returns (H // factor, W // factor, C) uint8, the mean of the 8-bit values rounded to the nearest (half up).
    """
    if factor == 1:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    pixels = image[: height * factor, : width * factor].numpy()
    # Adding slices is much faster than a sum over two strided axes.
    area = factor * factor
    rows = pixels[::factor].astype(np.uint32 if area * 511 < MAX_SUM else np.int64)
    for offset in range(1, factor):
        rows += pixels[offset::factor]
    total = rows[:, ::factor].copy()
    for offset in range(1, factor):
        total += rows[:, offset::factor]
    return torch.from_numpy(((2 * total + area) // (2 * area)).astype(np.uint8))
