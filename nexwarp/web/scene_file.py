"""Scene files: one binary file with a JSON header that the web page streams; docs/web.md describes it."""

import json
import os
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch

from nexwarp.camera import MAX_CAMERAS, Camera
from nexwarp.cameras.paths import camera_poses, focus
from nexwarp.checks import check_range, check_version
from nexwarp.errors import FormatError, MissingError, SettingError
from nexwarp.io.files import one_line
from nexwarp.io.json_files import parse_json
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.representation.detail_limits import NEVER
from nexwarp.representation.texture import NeuralTexture, TextureShape
from nexwarp.web.quantise import (
    CHUNK,
    decode_chunks,
    decode_levels,
    decode_limits,
    decode_quats,
    encode_chunks,
    encode_levels,
    encode_limits,
    encode_quats,
    log_of,
    morton_order,
)
from nexwarp.web.scene_data import LARGEST_SURFELS, ExposureData, SceneData, TextureData
from nexwarp.web.sections import (
    ALIGNMENT,
    DTYPES,
    QUALITIES,
    Quality,
    Section,
    expected_sections,
    matrix_shapes,
    pack,
    unpack,
)

SCENE_FILE = "scene.nxw"
MAGIC = b"NXWSCENE"
FORMAT_VERSION = 1
LARGEST_HEADER = 4 * 2**20
MOST_CAMERAS = 200
LARGEST_VALUE = 1e16
SURFEL_ARRAYS = ("means", "quats", "scales", "opacities", "gammas", "limits", "sh")


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
    for section in _sections_of(header, scene.limits is not None):
        array = np.ascontiguousarray(arrays[section.name], DTYPES[section.dtype])
        if array.shape != section.shape:
            raise FormatError(f"section {section.name}: expected shape {section.shape}, got {array.shape}")
        encoding, content = pack(array.astype(array.dtype.newbyteorder("<")).tobytes())
        entry = {"name": section.name, "dtype": section.dtype, "shape": list(section.shape), "encoding": encoding}
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
    from nexwarp import __version__

    options, texture, exposures = scene.options, scene.texture, scene.exposures
    kept = list(cameras.items())[:: -(-len(cameras) // MOST_CAMERAS) or 1]
    views = [camera for _, camera in kept]
    low, high = (np.percentile(scene.means, q, axis=0) if len(scene) else np.zeros(3) for q in (2, 98))
    center, up = _surroundings(views, (low + high) / 2)
    return {
        "format_version": FORMAT_VERSION,
        "generator": f"nexwarp {__version__}",
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
        values = scene.sh[order, band**2 : (band + 1) ** 2].reshape(count, -1).astype(np.float64)
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


def _sections_of(header: Mapping[str, object], limits: bool) -> list[Section]:
    """Return the sections that a checked header describes, without the poster."""
    exposures = cast("Mapping[str, int] | None", header["exposures"])
    return expected_sections(
        cast(Quality, header["quality"]),
        cast(int, header["surfels"]),
        cast(int, header["sh_coefficients"]),
        limits,
        0 if exposures is None else exposures["count"],
        cast("Mapping[str, object] | None", header["texture"]),
    )


def save_scene(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write a scene file."""
    from nexwarp.io.files import write_atomically

    write_atomically(Path(path), content)
    return Path(path)


def load_scene_file(path: str | os.PathLike[str]) -> SceneData:
    """Read a scene file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is damaged or holds something else.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingError(f"{path}: expected a scene file")
    try:
        return decode_scene(path.read_bytes())
    except (ValueError, TypeError, KeyError, OverflowError, MemoryError) as error:
        raise FormatError(f"{path}: expected a scene file of nexwarp ({one_line(error)})") from None


def decode_scene(content: bytes) -> SceneData:
    """Return the scene of a scene file's content; ValueError if it is damaged."""
    header, start = read_header(content)
    texture = _texture_shape(header["texture"])
    options = _read_options(header["options"])
    sections = _sections_of(header, options.detail_limits)
    arrays = _read_arrays(content, header, start, sections)
    data = arrays if header["quality"] == "full" else _dequantised(arrays, options.detail_limits)
    for name in SURFEL_ARRAYS:
        if name in data and not bool(np.all(np.abs(data[name]) <= (NEVER if name == "limits" else LARGEST_VALUE))):
            raise FormatError(f"section {name}: expected finite values of at most {LARGEST_VALUE:g}")
    return SceneData(
        *(data[name] for name in ("means", "quats", "scales", "opacities", "gammas")),
        data.get("limits"),
        data["sh"],
        options,
        None if texture is None else _texture(texture, header, arrays),
        _exposures(header["exposures"], arrays),
    )


def read_header(content: bytes) -> tuple[dict[str, object], int]:
    """Return the header, its sizes checked, and the offset of the first section.

    Raises:
        FormatError: the content is not that of a scene file.
    """
    if content[: len(MAGIC)] != MAGIC or len(content) < 16:
        raise FormatError(f"expected {MAGIC.decode()} at the start, got {content[:8]!r}")
    version, length = struct.unpack_from("<II", content, 8)
    check_version(version, FORMAT_VERSION)
    check_range("header bytes", length, 2, min(LARGEST_HEADER, len(content) - 16))
    header = parse_json("header", content[16 : 16 + length])
    if not isinstance(header, dict):
        raise FormatError("header: expected a JSON object")
    if header.get("quality") not in QUALITIES:
        raise FormatError(f"quality: expected {' or '.join(QUALITIES)}, got {header.get('quality')!r:.60}")
    for name, low, high in (("surfels", 0, LARGEST_SURFELS), ("sh_coefficients", 1, 16)):
        value = header.get(name)
        if isinstance(value, bool) or not isinstance(value, int):
            raise FormatError(f"{name}: expected an integer, got {value!r:.60}")
        check_range(name, value, low, high)
    if header["sh_coefficients"] not in (1, 4, 9, 16):
        raise FormatError(f"sh_coefficients: expected 1, 4, 9 or 16, got {header['sh_coefficients']}")
    exposures = header.setdefault("exposures", None)
    if exposures is not None:
        if not isinstance(exposures, dict) or not isinstance(exposures.get("count"), int):
            raise FormatError("exposures: expected an object with a count")
        check_range("exposures.count", exposures["count"], 1, MAX_CAMERAS)
    header.setdefault("texture", None)
    return header, 16 + length


def _texture_shape(value: object) -> TextureShape | None:
    """Return the arguments of the texture, checked by its constructor, which allocates nothing here."""
    if value is None:
        return None
    if not isinstance(value, dict):
        raise FormatError("texture: expected an object")
    shape = {name: value[name] for name in TextureShape.__annotations__}
    with torch.device("meta"):
        NeuralTexture(**shape)
    return cast(TextureShape, shape)


def _read_options(value: object) -> RenderOptions:
    if not isinstance(value, dict) or not isinstance(value.get("background"), list):
        raise FormatError("options: expected an object with a background")
    return RenderOptions(**{**value, "background": tuple(value["background"])})


def _read_arrays(
    content: bytes, header: Mapping[str, object], start: int, sections: list[Section]
) -> dict[str, np.ndarray]:
    """Unpack the sections; they must be those that the header describes, in order."""
    entries = header.get("sections")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise FormatError("sections: expected a list of objects")
    entries = [entry for entry in entries if entry.get("name") != "poster"]
    found = [(entry.get("name"), entry.get("dtype"), entry.get("shape")) for entry in entries]
    expected = [(section.name, section.dtype, list(section.shape)) for section in sections]
    if found != expected:
        raise FormatError(f"sections: expected {expected}, got {found!r:.300}")
    arrays = {}
    for section, entry in zip(sections, entries, strict=True):
        offset, size = entry.get("offset"), entry.get("bytes")
        if not (isinstance(offset, int) and isinstance(size, int) and 0 <= offset and 0 <= size):
            raise FormatError(f"section {section.name}: expected an offset and bytes, got {offset!r:.60}, {size!r:.60}")
        if start + offset + size > len(content):
            raise FormatError(f"section {section.name}: expected {size:,} bytes, but the file ends before")
        begin = start + offset
        arrays[section.name] = unpack(section, entry.get("encoding"), content[begin : begin + size])
    return arrays


def _dequantised(arrays: Mapping[str, np.ndarray], limits: bool) -> dict[str, np.ndarray]:
    """Return the arrays of the surfels in float32."""
    ranges, count = arrays["ranges"], len(arrays["quats"])
    bands = ranges.shape[1] - 7
    widths = [3 * (2 * band + 1) for band in range(bands)]
    columns = np.repeat(np.arange(7, 7 + bands), widths)
    data = {
        "means": decode_chunks(arrays["means"].T, ranges[:, :3]),
        "quats": decode_quats(arrays["quats"]),
        "scales": np.exp(decode_chunks(arrays["scales"].T, ranges[:, 3:5])),
        "opacities": arrays["opacities"].astype(np.float32) / 255,
        "gammas": np.maximum(np.exp(decode_chunks(arrays["gammas"].T, ranges[:, 5:7])), 1),
        "sh": decode_chunks(arrays["sh"].T, ranges[:, columns]).reshape(count, -1, 3),
    }
    if limits:
        data["limits"] = decode_limits(arrays["limits"].T, arrays["limits_scale"])
    return data


def _texture(shape: TextureShape, header: Mapping[str, object], arrays: Mapping[str, np.ndarray]) -> TextureData:
    resolutions = np.array(cast(dict[str, object], header["texture"]).get("resolutions"), np.float32)
    if resolutions.shape != (shape["levels"],) or not bool(np.all((resolutions > 0) & (resolutions < 1e10))):
        raise FormatError(f"resolutions: expected {shape['levels']} positive numbers")
    grid = arrays["grid"] if "grid_ranges" not in arrays else decode_levels(arrays["grid"], arrays["grid_ranges"])
    flat, matrices = arrays["mlp"].astype(np.float32), []
    if not bool(np.isfinite(flat).all() and np.isfinite(grid).all()):
        raise FormatError("texture: expected finite values")
    for out, into in matrix_shapes(shape):
        matrices.append(flat[: out * into].reshape(out, into))
        flat = flat[out * into :]
    return TextureData(shape, resolutions, grid, matrices)


def _exposures(value: object, arrays: Mapping[str, np.ndarray]) -> ExposureData | None:
    if value is None:
        return None
    entries = cast(dict[str, object], value)
    parts = {}
    for name, size in (("mean", 3), ("lengths", 2), ("falloff", 3), ("lowest", 3), ("highest", 3)):
        parts[name] = np.array(entries.get(name), np.float32)
        if parts[name].shape != (size,) or not bool(np.isfinite(parts[name]).all()):
            raise FormatError(f"exposures.{name}: expected {size} numbers")
    return ExposureData(arrays["exposures"], **parts)
