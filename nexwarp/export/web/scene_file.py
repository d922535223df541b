"""Scene files: one binary file with a JSON header that the web page streams; FORMAT.md describes it."""

import json
import struct
import zlib
from collections.abc import Mapping

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import focus_ahead, up_direction
from nexwarp.errors import FormatError, SettingError
from nexwarp.export.web import quantise
from nexwarp.model.model import Model
from nexwarp.model.texture import NeuralTexture

SCENE_FILE = "scene.nxw"
QUALITIES = ("quantised", "full")
MAGIC = b"NXWSCENE"
FORMAT_VERSION = 1
LARGEST_SURFELS = 2**24
ALIGNMENT = 8
DTYPES = {"u1": "u8", "u2": "u16", "u4": "u32", "f2": "f16", "f4": "f32"}
MOST_CAMERAS = 200
DRAWN_OPTIONS = ("max_hits", "background", "sh_degree", "clamp_texture", "exposure")


@torch.no_grad()
def scene_arrays(model: Model) -> dict[str, np.ndarray]:
    """Return N activated surfels, float32: "means", "quats" (wxyz), "scales", "opacities", "gammas", "sh" (N, C, 3).

    Where the model has them, with "limits" (N, 2), nearest and farthest, and "exposures" (V, 9), position, direction
    and coefficients of each photo. FormatError: the model is not what the web page draws.
    """
    surfels, options = model.surfels, model.options
    if len(surfels) > LARGEST_SURFELS:
        raise FormatError(f"model: expected at most {LARGEST_SURFELS:,} surfels, got {len(surfels):,}")
    if options.order != "depth":
        raise FormatError(f"order: expected depth, which the web page draws, got {options.order}")
    if options.max_hits and not isinstance(model.texture, NeuralTexture | None):
        name = type(model.texture).__name__
        raise FormatError(f"texture: expected a nexwarp.NeuralTexture, which the web page draws, got {name}")
    arrays = surfels.activated()._asdict()
    if model.detail_limits is not None and options.detail_limits:
        arrays["limits"] = torch.stack([model.detail_limits.nearest, model.detail_limits.farthest], 1)
    arrays["sh"] = surfels.sh
    exposures = model.exposures
    if exposures is not None and options.exposure == "photos":
        arrays["exposures"] = torch.cat([exposures.positions, exposures.directions, exposures.coefficients], 1)
    return {name: array_of(x) for name, x in arrays.items()}


def array_of(tensor: torch.Tensor) -> np.ndarray:
    """Return a tensor's values as float32."""
    return np.ascontiguousarray(tensor.detach().float().cpu().numpy())


def encode_scene(
    model: Model,
    cameras: Mapping[str, Camera],
    *,
    quality: str = "quantised",
    facts: Mapping[str, object] = {},
    poster: bytes | None = None,
) -> bytes:
    """Return the content of a scene file of a quality, with cameras by name; of more than 200, every n-th is kept.

    `facts` are the "title" and "metres" of FORMAT.md; `poster` is a JPEG picture, shown until the scene is loaded.
    """
    if quality not in QUALITIES:
        raise SettingError(f"--quality: expected {' or '.join(QUALITIES)}, got {quality!r:.60}")
    arrays = scene_arrays(model)
    header = scene_header(model, arrays, cameras, facts) | {"quality": quality}
    if quality == "quantised":
        arrays = quantised(arrays)
    if header["texture"]:
        assert isinstance(model.texture, NeuralTexture)
        grid = array_of(model.texture.grid).astype(np.float16)  # as in model files
        weights = np.concatenate([array_of(matrix).ravel() for matrix in model.texture.mlp.parameters()])
        if quality == "full":
            arrays |= {"mlp": weights, "grid": grid}
        else:
            codes, ranges = quantise.encode_levels(grid)
            arrays |= {"mlp": weights.astype(np.float16), "grid_ranges": ranges, "grid": codes}
    return joined_file(MAGIC, header, arrays, poster)


def quantised(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the sections of `scene_arrays` by name, in the order of the file; surfels are in Morton order."""
    order = quantise.morton_order(arrays["means"])
    surfels = {name: array[order] for name, array in arrays.items() if name != "exposures"}
    quats, swapped = quantise.encode_quats(surfels["quats"])
    scales, gammas = (np.where(swapped[:, None], x[:, ::-1], x) for x in (surfels["scales"], surfels["gammas"]))
    sh = surfels["sh"]
    means, mean_ranges = quantise.encode_chunks(surfels["means"].astype(np.float64), np.uint16)
    scale_codes, scale_ranges = quantise.encode_chunks(quantise.log_of(scales), np.uint16)
    gamma_codes, gamma_ranges = quantise.encode_chunks(quantise.log_of(gammas), np.uint8)
    degrees = range(round(sh.shape[1] ** 0.5))
    bands = [quantise.encode_band(sh[:, degree**2 : (degree + 1) ** 2]) for degree in degrees]
    sections = {
        "ranges": np.concatenate([mean_ranges, scale_ranges, gamma_ranges, *(band[1] for band in bands)], axis=1),
        "means": means.T,
        "quats": quats,
        "scales": scale_codes.T,
        "opacities": np.rint(surfels["opacities"].clip(0, 1) * 255).astype(np.uint8),
        "gammas": gamma_codes.T,
    }
    if "limits" in surfels:
        codes, sections["limits_scale"] = quantise.encode_limits(surfels["limits"])
        sections["limits"] = codes.T
    sections["sh"] = np.concatenate([band[0] for band in bands], axis=1).T
    return sections | {name: arrays[name] for name in ("exposures",) if name in arrays}


def joined_file(
    magic: bytes, header: Mapping[str, object], arrays: Mapping[str, np.ndarray], poster: bytes | None = None
) -> bytes:
    """Return the file of a header and its sections; arrays are compressed where that saves at least 2 %."""
    entries: list[dict[str, object]] = []
    parts: list[bytes] = []
    # Offsets depend on the header's length and it on them: they are counted from the end of the header.
    position = 0
    if poster is not None:
        header = {**header, "poster": {"type": "image/jpeg"}}
        arrays = {"poster": np.frombuffer(poster, np.uint8), **arrays}
    for name, array in arrays.items():
        content = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
        packed = content if name == "poster" else zlib.compress(content, 9)
        compressed = len(packed) < 0.98 * len(content)
        stored = packed if compressed else content
        entry: dict[str, object] = {"name": name, "dtype": DTYPES[array.dtype.str[1:]], "shape": list(array.shape)}
        entry |= {"encoding": "deflate" if compressed else "raw", "offset": position, "bytes": len(stored)}
        entries.append(entry)
        parts.append(stored + bytes(-len(stored) % ALIGNMENT))
        position += len(parts[-1])
    text = json.dumps({**header, "sections": entries}, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % ALIGNMENT)
    return b"".join([magic, struct.pack("<II", FORMAT_VERSION, len(text)), text, *parts])


def scene_header(
    model: Model, arrays: Mapping[str, np.ndarray], cameras: Mapping[str, Camera], facts: Mapping[str, object]
) -> dict[str, object]:
    """Return the header of a model and its `scene_arrays`, without quality and sections."""
    options, exposures, means = model.options, model.exposures, arrays["means"]
    kept = list(cameras.items())[:: -(-len(cameras) // MOST_CAMERAS) or 1]
    views = [camera for _, camera in kept]
    low, high = (np.percentile(means, q, axis=0) if len(means) else np.zeros(3) for q in (2, 98))
    focus, share = focus_ahead(views)
    center = focus.numpy() if share > 0.5 else (low + high) / 2
    radius = float(np.median(np.linalg.norm(means - center, axis=1))) if len(means) else 0.0
    header: dict[str, object] = {
        "format_version": FORMAT_VERSION,
        "generator": "nexwarp",
        "title": "",
        "metres": None,
        **facts,
        "surfels": len(means),
        "sh_coefficients": arrays["sh"].shape[1],
        "chunk": quantise.CHUNK,
        "options": {**{name: getattr(options, name) for name in DRAWN_OPTIONS}, "detail_limits": "limits" in arrays},
        "texture": None,
        "exposures": None,
        "near": views[0].near if views else 0.01,
        "cameras": [
            {
                "name": name,
                "viewmat": _floats(camera.viewmat.detach().double().cpu().numpy()),
                "K": _floats(np.array([camera.fx, camera.fy, camera.cx, camera.cy])),
                "width": camera.width,
                "height": camera.height,
                "near": camera.near,
            }
            for name, camera in kept
        ],
        "start": 0,
        "center": _floats(center),
        "radius": radius or None,
        "up": _floats(up_direction(views).numpy()),
        "bounds": [_floats(low), _floats(high)],
        "poster": None,
    }
    if isinstance(model.texture, NeuralTexture) and options.max_hits:
        resolutions = _floats(array_of(model.texture.resolutions))
        header["texture"] = {**model.texture.config, "resolutions": resolutions}
    if exposures is not None and "exposures" in arrays:
        gains = exposures.log_gains
        tensors = {"mean": exposures.mean, "lengths": exposures.lengths, "falloff": exposures.falloff}
        tensors |= {"lowest": gains.amin(0), "highest": gains.amax(0)}
        header["exposures"] = {"count": len(gains)} | {name: _floats(array_of(x)) for name, x in tensors.items()}
    return header


def _floats(values: np.ndarray) -> list[float]:
    """Numbers with the digits that single precision needs."""
    return [float(f"{x:.9g}") for x in np.asarray(values, np.float64).ravel().tolist()]
