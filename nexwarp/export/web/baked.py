"""The files of the baked scene, which the page draws where there is no WebGPU; FORMAT.md describes them."""

from collections.abc import Mapping

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.export.baked_scene import ATLAS_FILE, BAKED_FILE, MAGIC, BakedScene
from nexwarp.export.web.scene_file import array_of, joined_file, scene_arrays, scene_header
from nexwarp.io.pictures import encoded
from nexwarp.model.model import Model

QUALITY = 95  # of the lossy picture: 0.1 dB against photos of the demo, at 0.3 of the size of a lossless one
LARGEST_FLOAT = float(np.finfo(np.float32).max)


@torch.no_grad()
def encode_baked(
    scene: BakedScene, model: Model, cameras: Mapping[str, Camera], facts: Mapping[str, object] = {}
) -> dict[str, bytes]:
    """Return the files of the scene that `bake` has made of a model, content by name.

    `facts` are those of `encode_scene`. The model's SH of degrees that it does not show are kept.
    """
    assert scene.harmonics is not None
    sh0, shN = scene.harmonics
    height, width = scene.texels.shape[:2]
    picture, scale = encode_picture(scene.texels[..., :3])
    harmonics, ranges = encode_harmonics(torch.cat([shN, model.surfels.shN[:, shN.shape[1] :]], dim=1))
    arrays = scene_arrays(model)
    quats = np.rint((arrays["quats"].astype(np.float64) + 1) / 2 * 65535)
    farthest = arrays["limits"][:, 1] if "limits" in arrays else np.full(len(quats), LARGEST_FLOAT, np.float32)
    sections = {
        "means": arrays["means"],
        "quats": quats.clip(0, 65535).astype(np.uint16),
        "scales": arrays["scales"],
        "opacities": array_of(scene.shape.opacities),
        "gammas": arrays["gammas"],
        "farthest": farthest.clip(0, LARGEST_FLOAT),
        "boxes": array_of(scene.boxes),
        "rects": (array_of(scene.rects) + np.array([0, 0, 1, 1])).astype(np.uint16),
        "sh0": array_of(sh0[:, 0]),
        **{name: arrays[name] for name in ("exposures",) if name in arrays},
        "shN": harmonics,
    }
    header = scene_header(model, arrays, cameras, facts) | {
        "texture": None,
        "atlas": {"file": ATLAS_FILE, "width": width, "height": height, "scale": scale},
        "sh_ranges": ranges,
    }
    return {BAKED_FILE: joined_file(MAGIC, header, sections), ATLAS_FILE: picture}


def encode_harmonics(coefficients: torch.Tensor) -> tuple[np.ndarray, list[float]]:
    """Quantise SH coefficients above degree 0, (N, C - 1, 3), to uint8 codes; also return ranges of degrees 1, 2, 3.

    A code c is the value sign(c - 128) ((c - 128) / 127)^2 range: small values, which are most, have fine steps.
    """
    values = array_of(coefficients)
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
    codes, scale = encode_atlas(atlas)
    return encoded(codes.cpu().numpy(), format="WEBP", quality=QUALITY, method=6), scale
