"""Display modes of the viewer: each shows one buffer of a rendering as a picture, with a legend."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.io.pictures import to_uint8, viridis
from nexwarp.kernels.types import MAX_HITS, MAX_SH_DEGREE
from nexwarp.model.model import Model
from nexwarp.model.options import Exposure
from nexwarp.model.render import Rendering
from nexwarp.model.surfels import Surfels

MODES = {
    "image": "The picture: plain + textured + background.",
    "plain": "Blended colours of the surfels themselves, without the K textured hits and without background.",
    "textured": "Sum over the K heaviest hits of weight * texture colour.",
    "ids": "Index of the hit's surfel, one colour for each surfel.",
    "depth": "z-depth of the hit, in units of the scene; colours span the 2nd to 98th percentile of this view.",
    "weights": "Blending weight of the hit.",
    "normal": "Normal of the hit's surfel, facing the camera; world x, y, z as red, green, blue.",
    "alpha": "1 - transmittance after the last surfel.",
}
TEXTURED = ("image", "textured")  # modes that need the neural texture
BY_SLOT = ("ids", "depth", "weights", "normal")  # modes that show one of the K hits
QUANTILE_SAMPLES = 100_000
RANGES = {"max_hits": (0, MAX_HITS), "sh_degree": (0, MAX_SH_DEGREE), "slot": (1, MAX_HITS)}


@dataclass(frozen=True)
class Settings:
    """Display settings of one client."""

    mode: str = "image"  # a key of `MODES`
    max_hits: int = 2
    sh_degree: int = MAX_SH_DEGREE
    slot: int = 1  # rank of the hit that the modes of `BY_SLOT` show, 1 (heaviest) to 8
    as_trained: bool = True  # weight the texture's levels as at the photos' resolution where the picture's is finer
    photo_exposure: bool = True  # use the exposure of the nearby photos instead of the mean exposure

    def changed(self, name: str, value: object) -> "Settings":
        """Return these settings with a value that a browser sent, clamped to its range; ValueError for another type."""
        if type(value) is not type(getattr(self, name)) or (name == "mode" and value not in MODES):
            raise ValueError(f"{name}: expected a value that the panel offers, got {value!r:.60}")
        if isinstance(value, int) and name in RANGES:
            low, high = RANGES[name]
            value = min(max(value, low), high)
        return replace(self, **{name: value})  # type: ignore[arg-type]


@dataclass(frozen=True)
class Picture:
    """A drawn view: (H, W, 3) uint8 pixels, and the values at the two ends of the colour scale if it has one."""

    pixels: np.ndarray
    span: tuple[float, float] | None = None


@torch.no_grad()
def draw(
    model: Model, bands: Iterable[Camera], settings: Settings, stale: Callable[[], bool] = lambda: False
) -> Picture | None:
    """Render one view in the mode of the settings, as bands of rows from top to bottom.

    `stale` is called before each band but the first; True cancels the picture, which is then None.
    """
    mode, hits = settings.mode, settings.max_hits
    if mode in BY_SLOT:
        hits = max(hits, settings.slot)
    if mode not in TEXTURED:
        model = Model(model.surfels, None, model.exposures, model.detail_limits, model.options)
    degree = min(settings.sh_degree, model.options.sh_degree)
    exposure: Exposure = "photos" if settings.photo_exposure else "mean"
    parts: list[torch.Tensor] = []
    for camera in bands:
        if parts and stale():
            return None
        rendering = model.render(camera, max_hits=hits, sh_degree=degree, exposure=exposure)
        parts.append(_values(rendering, model.surfels, camera, settings))
    span = None
    if mode == "depth":
        span = _depth_span(torch.cat([part[~part.isnan()] for part in parts]))
    elif parts[0].ndim == 2:
        span = (0.0, 1.0)
    # Band by band: temporary tensors of a large picture would need several times its memory.
    return Picture(np.concatenate([_pixels(part, span) for part in parts]), span)


def _values(out: Rendering, surfels: Surfels, camera: Camera, settings: Settings) -> torch.Tensor:
    """Return the buffer of a mode: (H, W, 3) colours, or (H, W) numbers that are NaN in pixels without a hit."""
    mode, slot = settings.mode, settings.slot - 1
    if mode in ("image", "plain", "textured", "alpha"):
        return getattr(out, mode)
    ids = out.ids[..., slot].long()
    if mode in ("weights", "depth"):
        values = out.weights if mode == "weights" else out.depths
        return values[..., slot].masked_fill(ids < 0, torch.nan)
    if mode == "ids" or len(surfels) == 0:  # three multiplicative hashes, each channel at least 0.2
        factors = ids.new_tensor([2654435761, 2246822519, 3266489917])
        hashes = ((ids[..., None] + 1) * factors) % 2**32 // 2**16 % 256
        colours = 0.2 + 0.8 * hashes.float() / 255.0
    else:
        normals = surfels.normals
        behind = ((surfels.means - camera.position) * normals).sum(dim=-1, keepdim=True) > 0
        colours = torch.where(behind, -normals, normals)[ids.clamp_min(0)] * 0.5 + 0.5
    return colours * (ids >= 0)[..., None]


def _pixels(values: torch.Tensor, span: tuple[float, float] | None) -> np.ndarray:
    """Return (H, W, 3) uint8: colours, or those of numbers from violet to yellow, black where they are NaN."""
    if span is not None:
        table = viridis().to(values.device)
        steps = ((values - span[0]) / (span[1] - span[0]) * (len(table) - 1)).nan_to_num().round()
        values = table[steps.clamp(0, len(table) - 1).long()] * ~values.isnan()[..., None]
    return to_uint8(values.nan_to_num()).cpu().numpy()


def _depth_span(depths: torch.Tensor) -> tuple[float, float]:
    """Return the 2nd and 98th percentile of depths (n,), from a sample of at most twice `QUANTILE_SAMPLES`."""
    if depths.numel() == 0:
        return 0.0, 1.0
    sample = depths[:: max(depths.numel() // QUANTILE_SAMPLES, 1)]
    low, high = torch.quantile(sample, sample.new_tensor([0.02, 0.98])).tolist()
    return low, max(high, low + 1e-6 * max(abs(low), 1e-6))
