"""The files of the baked scene, which the page draws where there is no WebGPU; docs/web.md describes them."""

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.export.bake.baked import Baked, decode_atlas, encode_atlas
from nexwarp.export.bake.fit import bake as bake_model
from nexwarp.export.web.scene_data import SceneData
from nexwarp.export.web.scene_file import joined_file, scene_header
from nexwarp.export.web.sections import pack
from nexwarp.model.model import Model
from nexwarp.model.surfels import Surfels

BAKED_FILE, ATLAS_FILE = "baked.nxb", "atlas.webp"
MAGIC = b"NXWBAKED"
QUALITY = 95  # of the lossy picture: 0.1 dB against photos of the demo, at 0.3 of the size of a lossless one
LARGEST_FLOAT = float(np.finfo(np.float32).max)
DTYPES = {"f4": "f32", "u2": "u16", "u1": "u8"}


def bake(model: Model, cameras: Mapping[str, Camera], done: Callable[[], object] = lambda: None) -> dict[str, bytes]:
    """Bake a model for the page.

    Args:
        model: the model.
        cameras: cameras of the run by name; without any, nothing is baked.
        done: called after each step.

    Returns:
        Content by file name: `baked.nxb` and `atlas.webp`; empty without cameras.
    """
    if not cameras or not len(model.surfels):
        return {}
    return encode_baked(bake_model(model, list(cameras.values()), done=done), cameras)


@torch.no_grad()
def encode_baked(baked: Baked, cameras: Mapping[str, Camera]) -> dict[str, bytes]:
    """Return the files of a baked scene, content by name."""
    model = baked.model
    picture, scale = _picture(baked)
    harmonics, ranges = encode_harmonics(baked.surfels)
    shown = Model(baked.surfels, None, model.exposures, model.detail_limits, model.options, model.meta)
    header = scene_header(SceneData.of(shown), cameras, "quantised", "")
    header |= {
        "atlas": {"file": ATLAS_FILE, "width": baked.layout.width, "height": baked.layout.height, "scale": scale},
        "sh_ranges": ranges,
    }
    stored: list[tuple[dict[str, object], bytes]] = []
    for name, array in {**_arrays(shown, baked), "shN": harmonics}.items():
        content = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        encoding, packed = pack(content.tobytes())
        kind = DTYPES[array.dtype.str[1:]]
        stored.append(({"name": name, "dtype": kind, "shape": list(array.shape), "encoding": encoding}, packed))
    return {BAKED_FILE: joined_file(MAGIC, header, stored), ATLAS_FILE: picture}


def _arrays(shown: Model, baked: Baked) -> dict[str, np.ndarray]:
    """Return the sections by name."""
    scene = SceneData.of(shown)
    quats = np.rint((scene.quats.astype(np.float64) + 1) / 2 * 65535)
    farthest = scene.limits[:, 1] if scene.limits is not None else np.full(len(scene), LARGEST_FLOAT, np.float32)
    arrays = {
        "means": scene.means,
        "quats": quats.clip(0, 65535).astype(np.uint16),
        "scales": scene.scales,
        "opacities": scene.opacities,
        "gammas": scene.gammas,
        "farthest": farthest.clip(0, LARGEST_FLOAT),
        "boxes": baked.layout.boxes.float().cpu().numpy(),
        "rects": baked.layout.rects.cpu().numpy().astype(np.uint16),
        "sh0": scene.sh[:, 0],
    }
    if scene.exposures is not None:
        arrays["exposures"] = scene.exposures.poses
    return arrays


def encode_harmonics(surfels: Surfels) -> tuple[np.ndarray, list[float]]:
    """Quantise the SH coefficients above degree 0.

    A code c is the value sign(c - 128) ((c - 128) / 127)^2 range: small values, which are most, have fine steps.

    Returns:
        (N, C - 1, 3) uint8 codes, and the ranges of degrees 1, 2, 3 and of what the surfels have above.
    """
    values = surfels.shN.detach().float().cpu().numpy()
    codes, ranges = np.full(values.shape, 128, np.uint8), []
    for degree in range(1, max(3, math.isqrt(values.shape[1])) + 1):
        band = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
        some = values[:, band]
        ranges.append(float(np.float32(np.abs(some).max(initial=1e-6))))
        steps = np.rint(np.sqrt(np.abs(some) / ranges[-1]) * 127)
        codes[:, band] = (np.sign(some) * steps.clip(0, 127) + 128).astype(np.uint8)
    return codes, ranges


def decode_harmonics(codes: np.ndarray, ranges: list[float]) -> np.ndarray:
    """Return the (N, C - 1, 3) float32 coefficients of codes."""
    steps = codes.astype(np.float32) - 128
    degrees = np.floor(np.sqrt(np.arange(codes.shape[1]) + 1)).astype(int)
    return (np.sign(steps) * (steps / 127) ** 2 * np.array(ranges, np.float32)[degrees - 1][:, None]).astype(np.float32)


def as_stored(baked: Baked) -> Baked:
    """Return a baked scene with the colours that its files hold."""
    from PIL import Image

    picture, scale = _picture(baked)
    with Image.open(io.BytesIO(picture)) as image:
        codes = torch.from_numpy(np.array(image.convert("RGB")))
    state = dict(baked.surfels.state_dict())
    state["shN"] = torch.from_numpy(decode_harmonics(*encode_harmonics(baked.surfels))).to(state["shN"])
    return replace(baked, surfels=Surfels(state), atlas=decode_atlas(codes, scale).to(baked.atlas))


def _picture(baked: Baked) -> tuple[bytes, float]:
    """Return the atlas as a WebP picture, and the value that 127 steps stand for."""
    from PIL import Image

    codes, scale = encode_atlas(baked.atlas)
    content = io.BytesIO()
    Image.fromarray(codes.cpu().numpy()).save(content, format="WEBP", quality=QUALITY, method=6)
    return content.getvalue(), scale
