"""Writer of scene files: one binary file with a JSON header that the web page streams; docs/web.md describes it."""

import json
import struct
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import camera_poses, focus
from nexwarp.errors import FormatError, SettingError
from nexwarp.export.web.quantise import (
    CHUNK,
    encode_chunks,
    encode_levels,
    encode_limits,
    encode_quats,
    log_of,
    morton_order,
)
from nexwarp.export.web.scene_data import SceneData
from nexwarp.export.web.sections import (
    ALIGNMENT,
    DTYPES,
    FORMAT_VERSION,
    LARGEST_HEADER,
    MAGIC,
    QUALITIES,
    SURFEL_ARRAYS,
    Quality,
    pack,
    sections_of,
)
from nexwarp.model.model import Model

SCENE_FILE = "scene.nxw"
MOST_CAMERAS = 200


def encode_scene(
    model: Model | SceneData,
    cameras: Mapping[str, Camera],
    *,
    quality: str = "quantised",
    title: str = "",
    poster: bytes | None = None,
) -> bytes:
    """Return the content of a scene file.

    Args:
        model: the scene.
        cameras: cameras by name; of more than 200, every n-th is kept.
        quality: "quantised" or "full".
        title: of the page.
        poster: a JPEG picture that is shown until the scene is loaded; None shows none.

    Raises:
        ValueError: the message names the argument.
    """
    if quality not in QUALITIES:
        raise SettingError(f"--quality: expected {' or '.join(QUALITIES)}, got {quality!r:.60}")
    scene = SceneData.of(model) if isinstance(model, Model) else model
    arrays = _arrays(scene, cast(Quality, quality))
    header = scene_header(scene, cameras, cast(Quality, quality), title)
    stored: list[tuple[dict[str, object], bytes]] = []
    if poster is not None:
        header["poster"] = {"type": "image/jpeg"}
        stored.append(({"name": "poster", "dtype": "u8", "shape": [len(poster)], "encoding": "raw"}, poster))
    for section in sections_of(header, scene.limits is not None):
        array = np.ascontiguousarray(arrays[section.name], DTYPES[section.dtype])
        if array.shape != section.shape:
            raise FormatError(f"section {section.name}: expected shape {section.shape}, got {array.shape}")
        encoding, content = pack(array.astype(array.dtype.newbyteorder("<")).tobytes())
        entry: dict[str, object] = {
            "name": section.name,
            "dtype": section.dtype,
            "shape": list(section.shape),
            "encoding": encoding,
        }
        stored.append((entry, content))
    return joined_file(MAGIC, header, stored)


def joined_file(magic: bytes, header: dict[str, object], stored: Sequence[tuple[dict[str, object], bytes]]) -> bytes:
    """Return the file of a header and its sections, given as entries of the header with the bytes that are stored."""
    # Offsets depend on the header's length and it on them: they are counted from the end of the header.
    position, entries = 0, []
    for entry, content in stored:
        entries.append({**entry, "offset": position, "bytes": len(content)})
        position += len(content) + -len(content) % ALIGNMENT
    text = json.dumps({**header, "sections": entries}, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % ALIGNMENT)
    if len(text) > LARGEST_HEADER:
        raise FormatError(f"header: expected at most {LARGEST_HEADER:,} bytes, got {len(text):,}")
    parts = [magic, struct.pack("<II", FORMAT_VERSION, len(text)), text]
    for _, content in stored:
        parts += [content, bytes(-len(content) % ALIGNMENT)]
    return b"".join(parts)


def scene_header(scene: SceneData, cameras: Mapping[str, Camera], quality: Quality, title: str) -> dict[str, object]:
    """Return the header without its sections."""
    options, texture, exposures = scene.options, scene.texture, scene.exposures
    kept = list(cameras.items())[:: -(-len(cameras) // MOST_CAMERAS) or 1]
    views = [camera for _, camera in kept]
    low, high = (np.percentile(scene.means, q, axis=0) if len(scene) else np.zeros(3) for q in (2, 98))
    center, up = _surroundings(views, (low + high) / 2)
    return {
        "format_version": FORMAT_VERSION,
        "generator": "nexwarp",
        "title": title,
        "quality": quality,
        "surfels": len(scene),
        "sh_coefficients": scene.sh.shape[1],
        "chunk": CHUNK,
        "options": {
            "max_hits": options.max_hits,
            "background": list(options.background),
            "sh_degree": options.sh_degree,
            "low_pass": options.low_pass,
            "clamp_texture": options.clamp_texture,
            "exposure": options.exposure,
            "detail_limits": scene.limits is not None,
        },
        "texture": None if texture is None else {**texture.shape, "resolutions": _floats(texture.resolutions)},
        "exposures": None
        if exposures is None
        else {
            "count": len(exposures.poses),
            **{name: _floats(getattr(exposures, name)) for name in ("mean", "lengths", "falloff", "lowest", "highest")},
        },
        "near": views[0].near if views else 0.01,
        "cameras": [_camera_entry(name, camera) for name, camera in kept],
        "start": 0,
        "center": _floats(center),
        "up": _floats(up),
        "bounds": [_floats(low), _floats(high)],
        "poster": None,
    }


def _surroundings(cameras: Sequence[Camera], middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the point to orbit around, and the upward direction."""
    if not cameras:
        return middle, np.array([0.0, -1.0, 0.0])
    viewmats, _ = camera_poses(cameras)
    up = -viewmats[:, 1, :3].mean(0).numpy()
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    try:
        center = focus(cameras)
    except ValueError:
        return middle, up
    ahead = (viewmats[:, :3, :3] @ center + viewmats[:, :3, 3])[:, 2] > 0
    return (center.numpy() if bool(ahead.float().mean() > 0.5) else middle), up


def _camera_entry(name: str, camera: Camera) -> dict[str, object]:
    return {
        "name": name,
        "viewmat": [float(f"{x:.9g}") for x in camera.viewmat.detach().double().cpu().flatten().tolist()],
        "K": [float(f"{x:.9g}") for x in (camera.fx, camera.fy, camera.cx, camera.cy)],
        "width": camera.width,
        "height": camera.height,
        "near": camera.near,
    }


def _floats(values: np.ndarray) -> list[float]:
    """Numbers with the digits that single precision needs."""
    return [float(f"{x:.9g}") for x in np.asarray(values, np.float64).ravel().tolist()]


def _arrays(scene: SceneData, quality: Quality) -> dict[str, np.ndarray]:
    """Return the arrays of the sections by name."""
    arrays: dict[str, np.ndarray] = {}
    if quality == "full":
        for name in SURFEL_ARRAYS:
            if (array := getattr(scene, name)) is not None:
                arrays[name] = array
    else:
        arrays = _quantised(scene)
    if scene.exposures is not None:
        arrays["exposures"] = scene.exposures.poses
    if (texture := scene.texture) is not None:
        arrays["mlp"] = np.concatenate([matrix.ravel() for matrix in texture.matrices])
        arrays["grid"] = texture.grid
        if quality == "quantised":
            arrays["grid"], arrays["grid_ranges"] = encode_levels(texture.grid)
    return arrays


def _quantised(scene: SceneData) -> dict[str, np.ndarray]:
    """Return the quantised arrays of the surfels, in Morton order."""
    order = morton_order(scene.means)
    count, coefficients = len(order), scene.sh.shape[1]
    quats, swapped = encode_quats(scene.quats[order])
    scales, gammas = (np.where(swapped[:, None], x[order, ::-1], x[order]) for x in (scene.scales, scene.gammas))
    means, mean_ranges = encode_chunks(scene.means[order].astype(np.float64), np.uint16)
    scales, scale_ranges = encode_chunks(log_of(scales), np.uint16)
    gammas, gamma_ranges = encode_chunks(log_of(gammas), np.uint8)
    sh, ranges = [], [mean_ranges, scale_ranges, gamma_ranges]
    for band in range(round(coefficients**0.5)):
        values = scene.sh[order, band**2 : (band + 1) ** 2].reshape(count, 3 * (2 * band + 1)).astype(np.float64)
        # One range for all values of a band: those of a chunk are quantised as one column.
        codes, band_ranges = _encode_band(values)
        sh.append(codes)
        ranges.append(band_ranges)
    arrays = {
        "ranges": np.concatenate(ranges, axis=1),
        "means": means.T,
        "quats": quats,
        "scales": scales.T,
        "opacities": np.rint(scene.opacities[order].clip(0, 1) * 255),
        "gammas": gammas.T,
        "sh": np.concatenate(sh, axis=1).T,
    }
    if scene.limits is not None:
        codes, arrays["limits_scale"] = encode_limits(scene.limits[order])
        arrays["limits"] = codes.T
    return arrays


def _encode_band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantise (N, C) values, a range for each chunk; ranges (chunks, 1, 2)."""
    extremes = np.stack([values.min(1), values.max(1)], 1) if values.size else values[:, :0]
    if len(values) == 0:
        return np.zeros(values.shape, np.uint8), np.zeros((0, 1, 2), np.float32)
    starts = np.arange(0, len(values), CHUNK)
    low = np.minimum.reduceat(extremes[:, 0], starts).astype(np.float32)
    steps = ((np.maximum.reduceat(extremes[:, 1], starts) - low) / 255).astype(np.float32)
    row_low, row_step = (np.repeat(x.astype(np.float64), CHUNK)[: len(values), None] for x in (low, steps))
    codes = np.rint((values - row_low) / np.where(row_step > 0, row_step, 1.0)).clip(0, 255)
    return codes.astype(np.uint8), np.stack([low, steps], 1)[:, None]
