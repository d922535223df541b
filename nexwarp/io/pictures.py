"""Pictures: atomically written PNG, JPEG and OpenEXR files, error maps, strips with captions."""

import io
import json
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nexwarp.errors import FormatError, MissingError, StorageError, check_finite
from nexwarp.io.files import one_line, write_atomically, written_aside
from nexwarp.io.json_files import parse_json
from nexwarp.io.video import check_av

ERROR_SCALE = 0.25
CAPTION_HEIGHT = 16
METADATA = "nexwarp"
MAX_SIDE = 2**16  # pixels
MAX_RATIO = 1100  # of zlib: pixels to bytes
PNG = {"format": "PNG", "compress_level": 3}  # 6, the default, takes three times as long for 7 % less
THREADS = 8  # that compress pictures; twice as many wait for one at the most
MOST_HELD = 2**29  # values of the pictures that wait


def to_uint8(image: torch.Tensor) -> torch.Tensor:
    """Clamp a float image to [0, 1] and round it to uint8; a uint8 image is returned unchanged.

    TypeError: it is neither uint8 nor floating. ValueError: it holds NaN or infinity.
    """
    if image.dtype == torch.uint8:
        return image
    if not image.is_floating_point():
        raise TypeError(f"image: expected uint8 or a floating dtype, got {image.dtype}")
    check_finite("image", image)
    return (image.detach().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def save_png(path: str | os.PathLike[str], image: torch.Tensor) -> None:
    """Write an (H, W, 3) image, uint8 or float in [0, 1], as a PNG file, atomically; missing folders are created."""
    write_atomically(path, encoded(_shown("image", image).numpy(), **PNG), durable=False)


@contextmanager
def png_files() -> Iterator[Callable[[Path, torch.Tensor], None]]:
    """Yield a function like `save_png` that lets threads compress a picture, which must not change any more.

    Files are written in order, by the calling thread, in later calls and when the block ends: these raise what writing
    raises. If the block fails, the last pictures are missing.
    """
    coming: deque[tuple[Path, Future[bytes], int]] = deque()

    def write_first() -> None:
        path, content, _ = coming.popleft()
        write_atomically(path, content.result(), durable=False)

    with ThreadPoolExecutor(THREADS, "pictures") as pool:

        def save(path: Path, image: torch.Tensor) -> None:
            held = sum(pixels for _, _, pixels in coming) + image.numel()
            while coming and (len(coming) >= 2 * THREADS or held > MOST_HELD or coming[0][1].done()):
                held -= coming[0][2]
                write_first()
            coming.append((path, pool.submit(encoded, _shown("image", image).numpy(), **PNG), image.numel()))

        try:
            yield save
            while coming:
                write_first()
        finally:
            pool.shutdown(cancel_futures=True)


def save_jpeg(path: str | os.PathLike[str], image: torch.Tensor, quality: int) -> None:
    """Write an image as a JPEG file of quality 1 to 100 with full colour resolution; see `save_png`."""
    content = encoded(_shown("image", image).numpy(), format="JPEG", quality=quality, subsampling=0)
    write_atomically(path, content, durable=False)


def encoded(pixels: np.ndarray, **options: Any) -> bytes:
    """Return the content of a file of uint8 pixels (H, W, 3 or 4), with options of PIL; compressing frees the GIL."""
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(pixels).save(content, **options)
    return content.getvalue()


def save_exr(
    path: str | os.PathLike[str], parts: Mapping[str, torch.Tensor], metadata: Mapping[str, object] | None = None
) -> None:
    """Write tensors losslessly as the named parts of one OpenEXR file, atomically.

    A part is (H, W, 3) float32 (channels R, G, B), (H, W) float32 (channel Y) or (H, W) int32 (UINT channel Y; -1
    becomes 4294967295). The metadata, which JSON can hold, become the text attribute `nexwarp` of the first part,
    together with the list `parts` of all names. TypeError, ValueError: a part of another shape or dtype.
    """
    import OpenEXR

    files: list[OpenEXR.Part] = []
    for name, tensor in parts.items():
        if tensor.dtype not in (torch.float32, torch.int32):
            raise TypeError(f"parts[{name!r}]: expected float32 or int32, got {tensor.dtype}")
        if not (tensor.ndim == 2 or (tensor.ndim == 3 and tensor.shape[2] == 3)):
            raise ValueError(f"parts[{name!r}]: expected shape (H, W) or (H, W, 3), got {tuple(tensor.shape)}")
        values = np.ascontiguousarray(tensor.detach().cpu().numpy())
        values = values.view(np.uint32) if values.dtype == np.int32 else values
        planes = {c: np.ascontiguousarray(values[..., i]) for i, c in enumerate("RGB")} if values.ndim == 3 else {}
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        if not files:
            header[METADATA] = json.dumps({"parts": list(parts), **(metadata or {})})
        files.append(OpenEXR.Part(header, planes or {"Y": values}, name))
    with written_aside(path, durable=False) as temporary:
        try:
            OpenEXR.File(files).write(str(temporary))
        except RuntimeError as error:  # for example a full disk
            reason = str(error).replace(str(temporary), str(path))
            raise StorageError(f"{path}: cannot be written ({reason})") from None


def load_exr(path: str | os.PathLike[str]) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read the parts of a file of `save_exr`, bit for bit, and its metadata, with the entry `parts`.

    FileNotFoundError: no such file. FormatError: it is not OpenEXR, damaged, or has other channels than `save_exr` has.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingError(f"{path}: no such file, expected an OpenEXR file")
    with _exr_parts(path) as parts:
        tensors = {part.name(): _tensor(_planes(part)) for part in parts}
        metadata = dict(parse_json("metadata", str(parts[0].header[METADATA]).encode("utf-8", "replace")))
        # OpenEXR prints a message and omits the parts that it cannot read.
        if list(metadata["parts"]) != list(tensors):
            raise ValueError("parts of it cannot be read")
    return tensors, metadata


def load_exr_channel(path: Path) -> np.ndarray:
    """Read the only channel (H, W) of an OpenEXR file as float32; FormatError if it has more, or is damaged."""
    with _exr_parts(path) as parts:
        planes = [plane for part in parts for plane in _planes(part).values()]
    if len(planes) != 1:
        raise FormatError(f"{path}: expected one channel, got {len(planes)}")
    return np.asarray(planes[0], np.float32)


def load_exr_colors(path: Path) -> np.ndarray:
    """Read the channels R, G, B of an OpenEXR file's first part as (H, W, 3) float32; FormatError without them."""
    planes: dict[str, np.ndarray] = {}
    with _exr_parts(path) as parts:
        for part in reversed(parts):  # of a name that parts share, the first
            planes |= _planes(part)
    if not planes.keys() >= {*"RGB"}:
        raise FormatError(f"{path}: expected the channels R, G and B, got {', '.join(planes)}")
    colors = np.stack([np.asarray(planes[name], np.float32) for name in "RGB"], axis=-1)
    if np.isnan(colors).any():
        raise FormatError(f"{path}: expected numbers, got NaN")
    return colors


@contextmanager
def _exr_parts(path: Path, header_only: bool = False) -> Iterator[list[Any]]:
    """Yield the parts of an OpenEXR file; FormatError for what OpenEXR or the block raises of a damaged one."""
    import OpenEXR

    if not header_only:
        exr_size(path)  # which refuses what would not fit in memory
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=header_only) as file:
            yield file.parts
    except Exception as error:  # OpenEXR raises RuntimeError and other types
        whole = f"expected a whole OpenEXR file, but it cannot be read ({one_line(error)})"
        raise FormatError(f"{path}: {whole}") from None


def _planes(part: Any) -> dict[str, np.ndarray]:
    """Return the channels (H, W) of a part of an OpenEXR file by name."""
    return {name: channel.pixels for name, channel in part.channels.items()}


def load_deep(path: Path) -> np.ndarray:
    """Read a PNG or TIFF file as (H, W, 3) uint16, through PyAV (extra `video`), since PIL keeps 8 bits of 16.

    SettingError: PyAV is missing. FormatError: the file is damaged.
    """
    check_av(path)
    import av

    options = {"format_whitelist": "png_pipe,tiff_pipe", "protocol_whitelist": "file"}
    try:
        with av.open(f"file:{path.absolute()}", options=options) as file:
            return next(file.decode(video=0)).to_ndarray(format="rgb48le")
    except (av.error.FFmpegError, StopIteration) as error:
        raise FormatError(f"{path}: expected a whole PNG or TIFF file, could not read it ({one_line(error)})") from None


def linear_light(display: torch.Tensor) -> torch.Tensor:
    """Return the linear light of sRGB values, both 0 to 1."""
    return torch.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def display_light(linear: torch.Tensor) -> torch.Tensor:
    """Return the sRGB values of linear light: the inverse of `linear_light`."""
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def _tensor(channels: Mapping[str, np.ndarray]) -> torch.Tensor:
    """Return (H, W, 3) values of the channels R, G, B, or (H, W) of Y."""
    names = [name for name in "RGBY" if name in channels]
    if len(names) != len(channels) or "".join(names) not in ("RGB", "Y"):
        raise ValueError(f"expected channels R, G, B or Y, got {', '.join(sorted(channels))}")
    if any(channels[name].dtype not in (np.float32, np.uint32) for name in names):
        raise ValueError("expected channels of FLOAT or UINT")
    planes = [channels[name].view(np.int32) if channels[name].dtype == np.uint32 else channels[name] for name in names]
    return torch.from_numpy(np.stack(planes, axis=-1) if len(planes) == 3 else planes[0])


def exr_size(path: Path) -> tuple[int, int]:
    """Return width and height of an OpenEXR file's first part, from its header.

    FormatError: the file is damaged, or its headers announce more than it can hold.
    """
    total, sizes = 0, []
    with _exr_parts(path, header_only=True) as parts:
        for part in parts:
            low, high = part.header["dataWindow"]
            width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
            if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
                raise ValueError(f"expected 1 to {MAX_SIDE} pixels a side, got {width}x{height}")
            sizes.append((width, height))
            total += width * height * 4 * len(part.header["channels"])
        limit = MAX_RATIO * path.stat().st_size
        if total > limit:
            raise ValueError(f"expected at most {limit:,} bytes of pixels from a file of this size, got {total:,}")
        return sizes[0]


def error_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Colour-code the absolute error of two (H, W, 3) images, uint8 or float in [0, 1], averaged over channels.

    Returns (H, W, 3) uint8: viridis from 0 (dark violet) to 0.25 and above (yellow), in 256 steps.
    """
    first, second = _shown("image", image), _shown("target", target)
    red, green, blue = (torch.maximum(first, second) - torch.minimum(first, second)).unbind(-1)
    steps = (torch.arange(3 * 255 + 1) / (3 * ERROR_SCALE)).round().clamp(max=255.0).long()
    return to_uint8(viridis())[steps][red.int() + green + blue]


def side_by_side(images: Sequence[torch.Tensor], gap: int = 4, captions: Sequence[str] | None = None) -> torch.Tensor:
    """Join (H, W_i, 3) images of one height, uint8 or float in [0, 1], into one (H, W, 3) uint8 strip.

    `gap` white pixels part neighbours; captions stand on a white band of 16 pixels above the images.
    """
    from PIL import Image, ImageDraw, ImageFont

    panels = [_shown(f"images[{i}]", image) for i, image in enumerate(images)]
    for i, text in enumerate(captions or ()):  # cropped at the right
        band = Image.new("RGB", (panels[i].shape[1], CAPTION_HEIGHT), "white")
        ImageDraw.Draw(band).text((2, 2), text, fill="black", font=ImageFont.load_default())
        panels[i] = torch.cat([torch.from_numpy(np.array(band)), panels[i]])
    white = torch.full((len(panels[0]), gap, 3), 255, dtype=torch.uint8)
    return torch.cat([part for panel in panels for part in (white, panel)][1:], dim=1)


@lru_cache(maxsize=1)
def viridis() -> torch.Tensor:
    """Return (256, 3) float32 colours in [0, 1]."""
    from kornia.color import ColorMap

    return ColorMap("viridis", 256).colors.T.float().contiguous()


def _shown(name: str, image: torch.Tensor) -> torch.Tensor:
    """Check an (H, W, 3) image and return it as uint8 on the CPU; NaN becomes 0 (black)."""
    if image.ndim != 3 or image.shape[-1] != 3:
        raise ValueError(f"{name}: expected shape (H, W, 3), got {tuple(image.shape)}")
    return to_uint8(image.detach().cpu().nan_to_num() if image.is_floating_point() else image.cpu())
