"""What the viewer shows of a rendering: every buffer as a picture, and a legend that says how to read it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch

from nexwarp.camera import Camera
from nexwarp.kernels.types import MAX_HITS
from nexwarp.model.model import Model
from nexwarp.model.options import RenderChanges
from nexwarp.render import Rendering
from nexwarp.representation.surfels import Surfels

MODES = {
    "image": "The picture: plain + textured + background.",
    "plain": "Blended colours of the surfels themselves, without the K textured hits and without background.",
    "textured": "Sum over the K heaviest hits of weight * texture colour.",
    "ids": "Which surfel the hit is, one colour each.",
    "depth": "z-depth of the hit, in units of the scene; colours span the 2nd to 98th percentile of this view.",
    "weights": "Blending weight of the hit.",
    "normal": "Normal of the hit's surfel, turned towards the camera; world x, y, z as red, green, blue.",
    "alpha": "1 - transmittance left behind the last surfel.",
    "hit count": f"How many of a pixel's {MAX_HITS} heaviest hits weigh at least 2 %.",
}
TEXTURED = ("image", "textured")
"""Modes that need the neural texture."""
BY_SLOT = ("ids", "depth", "weights", "normal")
"""Modes that show one of the K hits."""
COUNTED = 0.02  # a hit's weight from which "hit count" counts it; nearly all pixels have more than 8 in all
QUANTILE_SAMPLES = 100_000


@dataclass(frozen=True)
class Settings:
    """What a client asks to see; a value out of its range is taken to the nearest end.

    Attributes:
        mode: a key of `MODES`.
        max_hits: K, 0 to 8.
        sh_degree: 0 to 3.
        slot: which hit to show in the modes of `BY_SLOT`, 1 (heaviest) to 8.
        as_trained: weight the texture's levels as at the photos' resolution where the picture's is finer.
        photo_exposure: show colours at the exposure of the photos around, not at the mean one.
    """

    mode: str = "image"
    max_hits: int = 2
    sh_degree: int = 3
    slot: int = 1
    as_trained: bool = True
    photo_exposure: bool = True

    def changed(self, **values: Any) -> "Settings":
        """Return these settings with other values, which may be anything; ValueError for what cannot be meant."""
        if values.get("mode", self.mode) not in MODES:
            raise ValueError(f"mode: expected one of {', '.join(MODES)}, got {values['mode']!r}")
        ranges = {"max_hits": (0, MAX_HITS), "sh_degree": (0, 3), "slot": (1, MAX_HITS)}
        for name in ranges.keys() & values.keys():
            low, high = ranges[name]
            if isinstance(values[name], bool) or not isinstance(values[name], int):
                raise ValueError(f"{name}: expected an integer, got {values[name]!r}")
            values[name] = min(max(values[name], low), high)
        for name in {"as_trained", "photo_exposure"} & values.keys():
            if not isinstance(values[name], bool):
                raise ValueError(f"{name}: expected True or False, got {values[name]!r}")
        return replace(self, **values)


@dataclass(frozen=True)
class Picture:
    """What is shown.

    Attributes:
        pixels: (H, W, 3) uint8.
        span: values at the two ends of the colours; None where colours stand for no number.
    """

    pixels: np.ndarray
    span: tuple[float, float] | None = None


@torch.no_grad()
def draw(
    model: Model,
    bands: Iterable[Camera],
    settings: Settings,
    stale: Callable[[], bool] = lambda: False,
) -> Picture | None:
    """Render one view the way the settings say.

    Args:
        model: what to show.
        bands: cameras of the picture's bands of rows from top to bottom, or of the whole.
        settings: what to show of it; its K and SH degree replace those of the model's options, the degree up to
            that of the options.
        stale: asked before each band but the first; True gives the picture up, and returns None.
    """
    hits = settings.max_hits
    if settings.mode in BY_SLOT:
        hits = max(hits, settings.slot)
    elif settings.mode == "hit count":
        hits = MAX_HITS
    if settings.mode not in TEXTURED:
        model = Model(model.surfels, None, model.exposures, model.detail_limits, model.options)
    changes: RenderChanges = {
        "max_hits": hits,
        "sh_degree": min(settings.sh_degree, model.options.sh_degree),
        "exposure": "photos" if settings.photo_exposure else "mean",
    }
    parts: list[torch.Tensor] = []
    for camera in bands:
        if parts and stale():
            return None
        out = model.render(camera, **changes)
        parts.append(_values(out, model.surfels, camera, settings))
    colours, span = _colours(torch.cat(parts), settings.mode)
    pixels = (colours.nan_to_num().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    return Picture(pixels.cpu().numpy(), span)


def _values(out: Rendering, surfels: Surfels, camera: Camera, settings: Settings) -> torch.Tensor:
    """What a mode shows: (H, W, 3) colours, or (H, W) numbers, NaN where there is nothing to tell."""
    mode, slot = settings.mode, settings.slot - 1
    if mode in ("image", "plain", "textured"):
        return getattr(out, mode)
    if mode == "alpha":
        return out.alpha
    if mode == "hit count":
        count = (out.weights >= COUNTED).sum(dim=2).to(out.weights)
        return _where_any(count > 0, count)
    ids = out.ids[..., slot].long()
    if mode == "weights":
        return _where_any(ids >= 0, out.weights[..., slot])
    if mode == "depth":
        return _where_any(ids >= 0, out.depths[..., slot])
    if mode == "ids" or len(surfels) == 0:
        return _id_colours(ids) * (ids >= 0)[..., None]
    normals = _normals(surfels, camera.position)[ids.clamp_min(0)]
    return (normals * 0.5 + 0.5) * (ids >= 0)[..., None]


def _where_any(there: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    return torch.where(there, values, values.new_tensor(torch.nan))


def _colours(values: torch.Tensor, mode: str) -> tuple[torch.Tensor, tuple[float, float] | None]:
    """(H, W, 3) colours in [0, 1], black where there is nothing to tell; and the span of a scale."""
    if values.ndim == 3:
        return values, None
    span = (0.0, float(MAX_HITS)) if mode == "hit count" else (0.0, 1.0)
    if mode == "depth":
        span = _span(values[~values.isnan()])
    return _scale(values, *span) * ~values.isnan()[..., None], span


def _normals(surfels: Surfels, position: torch.Tensor) -> torch.Tensor:
    """(N, 3) unit normals in the world frame, on the side that `position` is on."""
    normals = surfels.normals
    behind = ((surfels.means - position) * normals).sum(dim=-1, keepdim=True) > 0
    return torch.where(behind, -normals, normals)


def _span(depths: torch.Tensor) -> tuple[float, float]:
    if depths.numel() == 0:
        return 0.0, 1.0
    some = depths[:: max(depths.numel() // QUANTILE_SAMPLES, 1)]
    low, high = torch.quantile(some, some.new_tensor([0.02, 0.98])).tolist()
    return low, max(high, low + 1e-6 * max(abs(low), 1e-6))


def _scale(values: torch.Tensor, low: float, high: float) -> torch.Tensor:
    """Colours (..., 3) of values: viridis, from dark violet at `low` to yellow at `high`."""
    table = viridis().to(values.device)
    steps = ((values - low) / (high - low) * (len(table) - 1)).nan_to_num().round()
    return table[steps.clamp(0, len(table) - 1).long()]


def _id_colours(ids: torch.Tensor) -> torch.Tensor:
    """Colours (..., 3) that tell integers apart: three multiplicative hashes, none too dark to see."""
    factors = ids.new_tensor([2654435761, 2246822519, 3266489917])
    hashes = ((ids[..., None] + 1) * factors) % 2**32 // 2**16 % 256
    return 0.2 + 0.8 * hashes.float() / 255.0


@lru_cache(maxsize=1)
def viridis() -> torch.Tensor:
    """(256, 3) float32 colours in [0, 1]."""
    from kornia.color import ColorMap

    return ColorMap("viridis", 256).colors.T.float().contiguous()
