"""Reader of scene files, see `nexwarp.export.web.scene_file`: nothing is allocated before its size has been checked."""

import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np
import torch

from nexwarp.cameras.camera import MAX_CAMERAS
from nexwarp.errors import FormatError, MissingError, check_range, check_version
from nexwarp.export.web.quantise import (
    decode_chunks,
    decode_levels,
    decode_limits,
    decode_quats,
)
from nexwarp.export.web.scene_data import LARGEST_SURFELS, ExposureData, SceneData, TextureData
from nexwarp.export.web.sections import (
    FORMAT_VERSION,
    LARGEST_HEADER,
    MAGIC,
    QUALITIES,
    SURFEL_ARRAYS,
    Section,
    matrix_shapes,
    sections_of,
    unpack,
)
from nexwarp.io.files import one_line
from nexwarp.io.json_files import parse_json
from nexwarp.model.detail_limits import NEVER
from nexwarp.model.options import RenderOptions
from nexwarp.model.surfels import COEFFICIENTS, check_coefficients
from nexwarp.model.texture import NeuralTexture, TextureShape

LARGEST_VALUE = 1e16


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
    sections = sections_of(header, options.detail_limits)
    arrays = _read_arrays(content, header, start, sections)
    data = arrays if header["quality"] == "full" else _dequantised(arrays, options.detail_limits)
    for name in SURFEL_ARRAYS:
        if name in data and not bool(np.all(np.abs(data[name]) <= (NEVER if name == "limits" else LARGEST_VALUE))):
            raise FormatError(f"section {name}: expected finite values of at most {LARGEST_VALUE:g}")
    return SceneData(
        means=data["means"],
        quats=data["quats"],
        scales=data["scales"],
        opacities=data["opacities"],
        gammas=data["gammas"],
        limits=data.get("limits"),
        sh=data["sh"],
        options=options,
        texture=None if texture is None else _texture(texture, header, arrays),
        exposures=_exposures(header["exposures"], arrays),
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
    for name, low, high in (("surfels", 0, LARGEST_SURFELS), ("sh_coefficients", 1, COEFFICIENTS[-1])):
        value = header.get(name)
        if isinstance(value, bool) or not isinstance(value, int):
            raise FormatError(f"{name}: expected an integer, got {value!r:.60}")
        check_range(name, value, low, high)
    check_coefficients("sh_coefficients", header["sh_coefficients"])
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
        "sh": decode_chunks(arrays["sh"].T, ranges[:, columns]).reshape(count, bands**2, 3),
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
