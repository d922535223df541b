"""Points in PLY files: positions, and optionally colours, track lengths, reprojection errors and observations."""

import io
import itertools
import os
from pathlib import Path
from typing import TypeAlias

import numpy as np

from nexwarp.data.capture import LARGEST_COORDINATE, Cloud, check_points
from nexwarp.io.files import one_line
from nexwarp.io.ply import write_elements

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER = 64 * 1024  # bytes
MAX_PROPERTIES = 1024
MAX_POINTS = 100_000_000
COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")  # coefficients of the harmonic Y_0 of Gaussian splats
BAND_0 = 0.28209479177387814
GREY = 128
TRACK = "track_length"
ERRORS = ("reprojection_error", "error")  # the second is COLMAP's name; it is used only beside a track length
OBSERVATION, PAIR = "observation", ("image_id", "vertex_index")

# Name, count, and properties as (name, numpy type); None for an element with lists.
Element: TypeAlias = tuple[str, int, list[tuple[str, str]] | None]


def read_ply(path: Path) -> Cloud:
    """Read the points of a PLY file, ascii or binary.

    Args:
        path: the file. Its vertices have x, y and z. Optional properties: colours red, green, blue (or diffuse_red,
            ..., or r, g, b) as integers of full range or floats in [0, 1], or f_dc_0, ... of Gaussian splats;
            `track_length`, the number of photos that see the point, unknown if 0 or less; `reprojection_error`, or
            `error` beside a `track_length`, in pixels, unknown if negative. An optional element `observation` after
            the vertices has the integers `image_id` and `vertex_index`: which photo sees which point. Other
            properties and elements are ignored.

    Returns:
        The points in the file's frame; grey if the file has no colours.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is not PLY, is damaged or truncated, has no vertices, positions or errors that are not
            finite, or observations of missing points.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, expected a PLY file of points")
    size = path.stat().st_size
    with path.open("rb") as file:
        order, elements = _header(path, file)
        vertices, observations = _elements(path, file, order, elements, size)
    names = _names(vertices)
    lacking = [axis for axis in "xyz" if axis not in names]
    if lacking:
        raise ValueError(f"{path}: expected vertices with x, y and z, found no {lacking[0]}")
    with np.errstate(invalid="ignore"):
        positions = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    check_points(path, positions, "points", lambda index: f"vertex {index}")
    with np.errstate(invalid="ignore", over="ignore"):
        colors = _colors(vertices)
    error = next((name for name in ERRORS if name in names and (name == ERRORS[0] or TRACK in names)), None)
    lengths = _known(path, vertices, TRACK if TRACK in names else None, 0.0)
    errors = _known(path, vertices, error, -1.0)
    return Cloud(
        positions,
        colors,
        np.minimum(lengths, np.iinfo(np.int32).max).astype(np.int32),
        errors.astype(np.float32),
        None if observations is None else _pairs(path, observations, len(vertices)),
    )


def write_ply(path: str | os.PathLike[str], cloud: Cloud) -> None:
    """Write points for `read_ply`; other programs can read the positions and colours.

    Args:
        path: the file, written atomically.
        cloud: the points, in the frame of the file. Unknown track lengths and errors are left out.

    Raises:
        OSError: `path` cannot be written.
    """
    vertices = {axis: cloud.positions[:, index].astype(np.float64) for index, axis in enumerate("xyz")}
    vertices |= {name: cloud.colors[:, index] for index, name in enumerate(COLORS[0])}
    if (cloud.track_lengths > 0).any():
        vertices[TRACK] = cloud.track_lengths.astype(np.int32)
    if (cloud.reprojection_errors >= 0).any():
        vertices[ERRORS[0]] = cloud.reprojection_errors.astype(np.float32)
    elements = {"vertex": vertices}
    if cloud.observations is not None:
        elements[OBSERVATION] = {name: cloud.observations[:, i].astype(np.int32) for i, name in enumerate(PAIR)}
    write_elements(path, elements)


def _names(rows: np.ndarray) -> tuple[str, ...]:
    """Names of the fields of a structured array."""
    return rows.dtype.names or ()


def _known(path: Path, vertices: np.ndarray, name: str | None, unknown: float) -> np.ndarray:
    """(P,) float64 values of a property; `unknown` where the value is negative or the property does not exist."""
    if name is None:
        return np.full(len(vertices), unknown)
    with np.errstate(invalid="ignore"):  # signalling NaNs warn when they are converted
        values = vertices[name].astype(np.float64)
    bad = ~(np.abs(values) <= LARGEST_COORDINATE)
    if bad.any():
        index = int(np.flatnonzero(bad)[0])
        raise ValueError(f"{path}: {name}: expected finite numbers, got {values[index]} (vertex {index})")
    return np.where(values < 0, unknown, values)


def _pairs(path: Path, observations: np.ndarray, count: int) -> np.ndarray:
    """(M, 2) int64 distinct pairs of photo and point, ascending."""
    with np.errstate(invalid="ignore"):
        image, vertex = (observations[name].astype(np.int64) for name in PAIR)
    if len(image) and (min(image.min(), vertex.min()) < 0 or vertex.max() >= count):
        raise ValueError(
            f"{path}: {OBSERVATION}: expected images from 0 and vertices from 0 to {count - 1}, "
            f"got images {image.min()} to {image.max()} and vertices {vertex.min()} to {vertex.max()}"
        )
    return np.stack(np.divmod(np.unique(image * count + vertex), count), axis=1)


def _header(path: Path, file: io.BufferedReader) -> tuple[str, list[Element]]:
    """Read the format and the elements."""
    if file.readline(16).strip() != b"ply":
        raise ValueError(f"{path}: expected a PLY file, but it does not begin with 'ply'")
    form = None
    elements: list[Element] = []
    while True:
        if file.tell() > MAX_HEADER:
            raise ValueError(f"{path}: expected a PLY header of at most {MAX_HEADER:,} bytes")
        line = file.readline(MAX_HEADER)
        words = line.decode("ascii", "replace").split()
        if not line:
            raise ValueError(f"{path}: truncated, the PLY header has no end_header")
        if words[:1] == ["end_header"]:
            break
        if words[:1] == ["format"] and len(words) == 3 and words[1] in ORDERS:
            form = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal() and len(words[2]) <= 18:
            elements.append((words[1], int(words[2]), []))
        elif words[:2] == ["property", "list"] and len(words) == 5 and elements:
            elements[-1] = (*elements[-1][:2], None)
        elif words[:1] == ["property"] and len(words) == 3 and elements and words[1] in TYPES:
            properties = elements[-1][2]
            if properties is not None:
                properties.append((words[2], TYPES[words[1]]))
        elif words and words[0] not in ("comment", "obj_info"):
            raise ValueError(f"{path}: expected a PLY header, got the line {' '.join(words)[:60]!r}")
    if form is None:
        raise ValueError(f"{path}: expected a PLY header with a format, found none")
    return form, elements


def _elements(
    path: Path, file: io.BufferedReader, form: str, elements: list[Element], size: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read structured arrays of the vertices and, if they follow, of the observations; skip earlier elements."""
    names = [name for name, _, properties in elements if name != OBSERVATION or _is_observation(properties)]
    vertices = None
    for name, count, properties in elements:
        if vertices is not None and (OBSERVATION not in names or properties is None):
            break
        left = size - file.tell()
        if properties is None:
            what = "its lists" if name == "vertex" else f"lists of {one_line(name, 60)} before them"
            raise ValueError(f"{path}: expected vertices without lists first, got {what}")
        fields = [(field, ORDERS[form] + kind) for field, kind in properties]
        if len({field for field, _ in fields}) < len(fields) or len(fields) > MAX_PROPERTIES:
            raise ValueError(f"{path}: element {one_line(name, 60)}: expected properties of different names")
        dtype = np.dtype(fields)
        # An ascii value has at least a digit and a separator.
        least = count * (dtype.itemsize if form != "ascii" else max(2 * len(fields), 1)) - (form == "ascii")
        if least > left or count > MAX_POINTS:
            raise ValueError(
                f"{path}: truncated, expected {count:,} of element {one_line(name, 60)}, got {left:,} bytes for them"
            )
        if name == "vertex" and vertices is None:
            if not count or not fields:
                raise ValueError(f"{path}: expected at least one vertex, got none")
            vertices = _rows(path, file, form, dtype, count)
        elif name == OBSERVATION and vertices is not None and _is_observation(properties):
            return vertices, _rows(path, file, form, dtype, count)
        elif form == "ascii":
            for _ in range(count):
                file.readline()
        else:
            file.seek(count * dtype.itemsize, io.SEEK_CUR)
    if vertices is None:
        raise ValueError(f"{path}: expected an element vertex, found none")
    return vertices, None


def _is_observation(properties: list[tuple[str, str]] | None) -> bool:
    kinds = dict(properties or ())
    return all(kinds.get(name, "f4")[0] in "iu" for name in PAIR)


def _rows(path: Path, file: io.BufferedReader, form: str, dtype: "np.dtype[np.void]", count: int) -> np.ndarray:
    if form == "ascii":
        return _ascii(path, file, dtype, count) if count else np.empty(0, dtype)
    return np.fromfile(file, dtype, count)


def _ascii(path: Path, file: io.BufferedReader, dtype: "np.dtype[np.void]", count: int) -> np.ndarray:
    names = dtype.names or ()
    lines = itertools.islice((line for line in file if line.strip()), count)
    try:
        values = np.loadtxt(lines, np.float64, comments=None, max_rows=count, ndmin=2, encoding="ascii")
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path}: expected rows of {len(names)} numbers, could not read them: {one_line(error)}"
        ) from None
    if values.shape != (count, len(names)):
        raise ValueError(f"{path}: truncated, expected {count:,} rows of {len(names)} numbers, got {values.shape}")
    vertices = np.empty(count, dtype)
    with np.errstate(invalid="ignore", over="ignore"):
        for index, name in enumerate(names):
            vertices[name] = values[:, index]
    return vertices


def _colors(vertices: np.ndarray) -> np.ndarray:
    """(P, 3) uint8 colours; grey without any."""
    names = _names(vertices)
    for triple in COLORS:
        if set(triple) <= set(names):
            channels = [vertices[name] for name in triple]
            scale = [255.0 / np.iinfo(c.dtype).max if c.dtype.kind in "iu" else 255.0 for c in channels]
            return _bytes(np.stack([c * s for c, s in zip(channels, scale, strict=True)], axis=1))
    if set(HARMONICS) <= set(names):
        return _bytes(np.stack([255.0 * (0.5 + BAND_0 * vertices[name]) for name in HARMONICS], axis=1))
    return np.full((len(vertices), 3), GREY, np.uint8)


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.floor(np.nan_to_num(values, nan=float(GREY)).clip(0, 255) + 0.5).astype(np.uint8)
