"""Pictures for people: written whole or not at all, error maps, strips with captions."""

import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from nexwarp.ops.checks import check_range

ERROR_SCALE = 0.25
CAPTION_HEIGHT = 16


def save_png(path: str | os.PathLike[str], image: torch.Tensor) -> None:
    """Write an (H, W, 3) image, uint8 or float in [0, 1], to a temporary name, then rename it to `path`.

    The folder is made if need be; a file already at `path` stays as it is when anything fails.
    """
    from PIL import Image

    path, pixels = Path(path), _to_uint8("image", image).numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        Image.fromarray(pixels).save(temporary, format="PNG")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def save_exr(path: str | os.PathLike[str], parts: Mapping[str, torch.Tensor]) -> None:
    """Write tensors as the named parts of one OpenEXR file, exactly: float32 as FLOAT, int32 as UINT.

    Args:
        path: where to; written aside, then renamed.
        parts: name -> (H, W, 3) float32 (channels R, G, B), (H, W) float32 (channel Y) or (H, W) int32 (channel Y; -1
            becomes 4294967295).
    """
    import OpenEXR

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.exr")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    files = []
    for name, tensor in parts.items():
        values = np.ascontiguousarray(tensor.detach().cpu().numpy())
        if values.dtype == np.int32:
            values = values.view(np.uint32)
        planes = {"R": 0, "G": 1, "B": 2} if values.ndim == 3 else {"Y": None}
        channels = {c: np.ascontiguousarray(values if i is None else values[..., i]) for c, i in planes.items()}
        files.append(OpenEXR.Part(dict(header), channels, name))
    try:
        OpenEXR.File(files).write(str(temporary))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def error_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Colour the absolute error, averaged over channels, of two (H, W, 3) images: (H, W, 3) uint8.

    The colours are viridis over 0 (dark violet) to 0.25 (yellow), in 256 steps; larger errors are yellow too.
    """
    a, b = _to_uint8("image", image), _to_uint8("target", target)
    if a.shape != b.shape:
        raise ValueError(f"target: expected shape {tuple(a.shape)}, got {tuple(b.shape)}")
    error = (a.int() - b.int()).abs().float().mean(-1) / 255.0
    return _viridis()[(error / ERROR_SCALE * 255.0).round().clamp(max=255.0).long()]


def side_by_side(images: Sequence[torch.Tensor], gap: int = 4, captions: Sequence[str] | None = None) -> torch.Tensor:
    """Join (H, W_i, 3) images of one height, uint8 or float in [0, 1], into one uint8 strip with white gaps.

    Args:
        images: from left to right.
        gap: white pixels between two neighbours.
        captions: one for each image, printed on a white band above it that is 16 pixels high.

    Returns:
        (H, sum of W_i + gaps, 3), or 16 pixels higher with captions.
    """
    check_range("gap", gap, 0)
    if not images:
        raise ValueError("images: expected at least one, got none")
    panels = [_to_uint8(f"images[{i}]", image) for i, image in enumerate(images)]
    if len({len(panel) for panel in panels}) > 1:
        raise ValueError(f"images: expected images of one height, got heights {[len(panel) for panel in panels]}")
    if captions is not None:
        if len(captions) != len(panels):
            raise ValueError(f"captions: expected {len(panels)}, one for each image, got {len(captions)}")
        panels = [
            torch.cat([_caption(text, panel.shape[1]), panel]) for text, panel in zip(captions, panels, strict=True)
        ]
    white = torch.full((len(panels[0]), gap, 3), 255, dtype=torch.uint8)
    return torch.cat([part for panel in panels for part in (white, panel)][1:], dim=1)


def _caption(text: str, width: int) -> torch.Tensor:
    """(CAPTION_HEIGHT, width, 3) uint8, black text on white, cut off at the right."""
    import numpy as np
    from PIL import Image, ImageDraw, ImageFont

    band = Image.new("RGB", (width, CAPTION_HEIGHT), "white")
    ImageDraw.Draw(band).text((2, 2), text, fill="black", font=ImageFont.load_default())
    return torch.from_numpy(np.array(band))


@lru_cache(maxsize=1)
def _viridis() -> torch.Tensor:
    """(256, 3) uint8."""
    from kornia.color import ColorMap

    return (ColorMap("viridis", 256).colors.T * 255.0).round().to(torch.uint8)


def _to_uint8(name: str, image: torch.Tensor) -> torch.Tensor:
    """Check an (H, W, 3) image and return it in 8 bits on the CPU; NaN becomes 0, so that it shows."""
    if not isinstance(image, torch.Tensor) or not (image.dtype == torch.uint8 or image.is_floating_point()):
        raise TypeError(
            f"{name}: expected a uint8 or floating torch.Tensor, got {getattr(image, 'dtype', type(image))}"
        )
    if image.ndim != 3 or image.shape[-1] != 3:
        raise ValueError(f"{name}: expected shape (H, W, 3), got {tuple(image.shape)}")
    image = image.detach().cpu()
    return image if image.dtype == torch.uint8 else (image.nan_to_num().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
