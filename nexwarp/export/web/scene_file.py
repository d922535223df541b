"""Scene files: one binary file with a JSON header that the web page streams; FORMAT.md describes it."""

import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import focus_ahead, up_direction
from nexwarp.errors import FormatError, SettingError
from nexwarp.export.web import quantise
from nexwarp.model.exposures import Exposures
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.model.texture import NeuralTexture

SCENE_FILE = "scene.nxw"
QUALITIES = ("quantised", "full")
MAGIC = b"NXWSCENE"
FORMAT_VERSION = 1
LARGEST_SURFELS = 2**24
LARGEST_HEADER = 4 * 2**20
ALIGNMENT = 8
DTYPES = {"u1": "u8", "u2": "u16", "u4": "u32", "f2": "f16", "f4": "f32"}
MOST_CAMERAS = 200


@dataclass(frozen=True)
class SceneData:
    """A scene, activated: N surfels, float32, and what a rendering needs beside them."""

    means: np.ndarray  # (N, 3) world units
    quats: np.ndarray  # (N, 4) unit, wxyz, surfel to world
    scales: np.ndarray  # (N, 2) world units
    opacities: np.ndarray  # (N,)
    gammas: np.ndarray  # (N, 2)
    limits: np.ndarray | None  # (N, 2) detail limits, nearest and farthest; None limits nothing
    sh: np.ndarray  # (N, C, 3) coefficients of the plain colour
    options: RenderOptions
    texture: NeuralTexture | None
    # Of V photos, see `Exposures`: "poses" (V, 9), position, direction and coefficients of each; "mean" (3,), "lengths"
    # (2,), "falloff" (3,); "lowest" and "highest" (3,), the extreme log gains.
    exposures: dict[str, np.ndarray] | None

    @classmethod
    @torch.no_grad()
    def of(cls, model: Model) -> "SceneData":
        """Take the values of a model; FormatError: it has too many surfels for a file, or blends them by distance."""
        surfels, options = model.surfels, model.options
        if len(surfels) > LARGEST_SURFELS:
            raise FormatError(f"model: expected at most {LARGEST_SURFELS:,} surfels, got {len(surfels):,}")
        if options.order != "depth":
            raise FormatError(f"order: expected depth, which the web page draws, got {options.order}")
        texture = model.texture if options.max_hits else None
        if not isinstance(texture, NeuralTexture | None):
            name = type(texture).__name__
            raise FormatError(f"texture: expected a nexwarp.NeuralTexture, which the web page draws, got {name}")
        limits = model.detail_limits if options.detail_limits else None
        return cls(
            **{name: array_of(x) for name, x in surfels.activated()._asdict().items()},
            limits=None if limits is None else array_of(torch.stack([limits.nearest, limits.farthest], 1)),
            sh=array_of(surfels.sh),
            options=options,
            texture=texture,
            exposures=_exposures(model.exposures) if options.exposure == "photos" else None,
        )

    def __len__(self) -> int:
        return len(self.means)


def _exposures(exposures: Exposures | None) -> dict[str, np.ndarray] | None:
    if exposures is None:
        return None
    values = {name: array_of(x) for name, x in exposures.named_buffers()}
    poses = np.concatenate([values[name] for name in ("positions", "directions", "coefficients")], axis=1)
    gains = values["log_gains"]
    kept = {name: values[name] for name in ("mean", "lengths", "falloff")}
    return {"poses": poses, **kept, "lowest": gains.min(0), "highest": gains.max(0)}


def array_of(tensor: torch.Tensor) -> np.ndarray:
    """Return a tensor's values as float32."""
    return np.ascontiguousarray(tensor.detach().float().cpu().numpy())


def encode_scene(
    model: Model,
    cameras: Mapping[str, Camera],
    *,
    quality: str = "quantised",
    title: str = "",
    poster: bytes | None = None,
) -> bytes:
    """Return the content of a scene file of a quality, with cameras by name; of more than 200, every n-th is kept.

    `poster` is a JPEG picture that is shown until the scene is loaded.
    """
    if quality not in QUALITIES:
        raise SettingError(f"--quality: expected {' or '.join(QUALITIES)}, got {quality!r:.60}")
    scene = SceneData.of(model)
    if quality == "full":
        names = ("means", "quats", "scales", "opacities", "gammas", "limits", "sh")
        arrays = {name: array for name in names if (array := getattr(scene, name)) is not None}
    else:
        arrays = quantised(scene)
    if scene.exposures is not None:
        arrays["exposures"] = scene.exposures["poses"]
    if scene.texture is not None:
        grid = array_of(scene.texture.grid).astype(np.float16)  # as in model files
        weights = np.concatenate([array_of(matrix).ravel() for matrix in scene.texture.mlp.parameters()])
        if quality == "full":
            arrays |= {"mlp": weights, "grid": grid}
        else:
            codes, ranges = quantise.encode_levels(grid)
            arrays |= {"mlp": weights.astype(np.float16), "grid_ranges": ranges, "grid": codes}
    header = scene_header(scene, cameras, title) | {"quality": quality}
    return joined_file(MAGIC, header, arrays, poster)


def quantised(scene: SceneData) -> dict[str, np.ndarray]:
    """Return the sections of the surfels by name, in the order of the file; surfels are in Morton order."""
    order = quantise.morton_order(scene.means)
    quats, swapped = quantise.encode_quats(scene.quats[order])
    scales, gammas = (np.where(swapped[:, None], x[order, ::-1], x[order]) for x in (scene.scales, scene.gammas))
    sh = scene.sh[order]
    means, mean_ranges = quantise.encode_chunks(scene.means[order].astype(np.float64), np.uint16)
    scale_codes, scale_ranges = quantise.encode_chunks(quantise.log_of(scales), np.uint16)
    gamma_codes, gamma_ranges = quantise.encode_chunks(quantise.log_of(gammas), np.uint8)
    degrees = range(round(sh.shape[1] ** 0.5))
    bands = [quantise.encode_band(sh[:, degree**2 : (degree + 1) ** 2]) for degree in degrees]
    sections = {
        "ranges": np.concatenate([mean_ranges, scale_ranges, gamma_ranges, *(band[1] for band in bands)], axis=1),
        "means": means.T,
        "quats": quats,
        "scales": scale_codes.T,
        "opacities": np.rint(scene.opacities[order].clip(0, 1) * 255).astype(np.uint8),
        "gammas": gamma_codes.T,
    }
    if scene.limits is not None:
        codes, sections["limits_scale"] = quantise.encode_limits(scene.limits[order])
        sections["limits"] = codes.T
    sections["sh"] = np.concatenate([band[0] for band in bands], axis=1).T
    return sections


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
    if len(text) > LARGEST_HEADER:
        raise FormatError(f"header: expected at most {LARGEST_HEADER:,} bytes, got {len(text):,}")
    return b"".join([magic, struct.pack("<II", FORMAT_VERSION, len(text)), text, *parts])


def scene_header(scene: SceneData, cameras: Mapping[str, Camera], title: str) -> dict[str, object]:
    """Return the header without quality and sections."""
    options, texture, exposures = scene.options, scene.texture, scene.exposures
    kept = list(cameras.items())[:: -(-len(cameras) // MOST_CAMERAS) or 1]
    views = [camera for _, camera in kept]
    low, high = (np.percentile(scene.means, q, axis=0) if len(scene) else np.zeros(3) for q in (2, 98))
    center, share = focus_ahead(views)
    header: dict[str, object] = {
        "format_version": FORMAT_VERSION,
        "generator": "nexwarp",
        "title": title,
        "surfels": len(scene),
        "sh_coefficients": scene.sh.shape[1],
        "chunk": quantise.CHUNK,
        "options": {
            "max_hits": options.max_hits,
            "background": list(options.background),
            "sh_degree": options.sh_degree,
            "clamp_texture": options.clamp_texture,
            "exposure": options.exposure,
            "detail_limits": scene.limits is not None,
        },
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
        "center": _floats(center.numpy() if share > 0.5 else (low + high) / 2),
        "up": _floats(up_direction(views).numpy()),
        "bounds": [_floats(low), _floats(high)],
        "poster": None,
    }
    if texture is not None:
        header["texture"] = {**texture.config, "resolutions": _floats(array_of(texture.resolutions))}
    if exposures is not None:
        numbers = {name: _floats(values) for name, values in exposures.items() if name != "poses"}
        header["exposures"] = {"count": len(exposures["poses"]), **numbers}
    return header


def _floats(values: np.ndarray) -> list[float]:
    """Numbers with the digits that single precision needs."""
    return [float(f"{x:.9g}") for x in np.asarray(values, np.float64).ravel().tolist()]
