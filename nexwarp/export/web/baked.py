"""The files of the baked scene, which the page draws where there is no WebGPU; FORMAT.md describes them."""

import io
from collections.abc import Mapping

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.export.bake import Baked
from nexwarp.export.baked_scene import ATLAS_FILE, BAKED_FILE, MAGIC
from nexwarp.export.web.scene_file import array_of, joined_file, scene_arrays, scene_header
from nexwarp.model.model import Model
from nexwarp.model.surfels import Surfels

QUALITY = 95  # of the lossy picture: 0.1 dB against photos of the demo, at 0.3 of the size of a lossless one
LARGEST_FLOAT = float(np.finfo(np.float32).max)


@torch.no_grad()
def encode_baked(baked: Baked, cameras: Mapping[str, Camera], facts: Mapping[str, object] = {}) -> dict[str, bytes]:
    """Return the files of a baked scene, content by name; `facts` are those of `encode_scene`."""
    model, layout = baked.model, baked.layout
    picture, scale = encode_picture(baked.atlas)
    harmonics, ranges = encode_harmonics(baked.surfels)
    bare = Model(baked.surfels, None, model.exposures, model.detail_limits, model.options, model.meta)
    scene = scene_arrays(bare)
    quats = np.rint((scene["quats"].astype(np.float64) + 1) / 2 * 65535)
    count = len(scene["means"])
    farthest = scene["limits"][:, 1] if "limits" in scene else np.full(count, LARGEST_FLOAT, np.float32)
    arrays = {
        "means": scene["means"],
        "quats": quats.clip(0, 65535).astype(np.uint16),
        **{name: scene[name] for name in ("scales", "opacities", "gammas")},
        "farthest": farthest.clip(0, LARGEST_FLOAT),
        "boxes": array_of(layout.boxes),
        "rects": layout.rects.cpu().numpy().astype(np.uint16),
        "sh0": scene["sh"][:, 0],
        **{name: scene[name] for name in ("exposures",) if name in scene},
        "shN": harmonics,
    }
    header = scene_header(bare, scene, cameras, facts) | {
        "atlas": {"file": ATLAS_FILE, "width": layout.width, "height": layout.height, "scale": scale},
        "sh_ranges": ranges,
    }
    return {BAKED_FILE: joined_file(MAGIC, header, arrays), ATLAS_FILE: picture}


def encode_harmonics(surfels: Surfels) -> tuple[np.ndarray, list[float]]:
    """Quantise the SH coefficients above degree 0 to (N, C - 1, 3) uint8 codes, and the ranges of degrees 1, 2, 3.

    A code c is the value sign(c - 128) ((c - 128) / 127)^2 range: small values, which are most, have fine steps.
    """
    values = array_of(surfels.shN)
    codes, ranges = np.full(values.shape, 128, np.uint8), []
    for degree in (1, 2, 3):
        band = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
        magnitudes = np.abs(values[:, band])
        ranges.append(float(np.float32(magnitudes.max(initial=1e-6))))
        steps = np.rint(np.sqrt(magnitudes / ranges[-1]) * 127)
        codes[:, band] = (np.sign(values[:, band]) * steps.clip(0, 127) + 128).astype(np.uint8)
    return codes, ranges


def encode_atlas(atlas: torch.Tensor) -> tuple[torch.Tensor, float]:
    """Return uint8 codes of an atlas, 128 for 0, and the value that 127 steps stand for."""
    scale = max(float(atlas.abs().amax().clamp(max=1.0)), 1e-3) if atlas.numel() else 1.0
    return (atlas / scale * 127).round().clamp(-127, 127).add(128).to(torch.uint8), scale


def encode_picture(atlas: torch.Tensor) -> tuple[bytes, float]:
    """Return an atlas (height, width, 3) as a WebP picture, and the value that 127 steps stand for."""
    from PIL import Image

    codes, scale = encode_atlas(atlas)
    content = io.BytesIO()
    Image.fromarray(codes.cpu().numpy()).save(content, format="WEBP", quality=QUALITY, method=6)
    return content.getvalue(), scale
