"""Points in PLY files: positions and, where there are any, colours, and what is known of the photos they came from."""

import io
import itertools
import os
from pathlib import Path

import numpy as np

from nexwarp.data.capture import LARGEST_COORDINATE, Cloud, check_points
from nexwarp.io.files import one_line, written_aside

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
HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")  # of Gaussian splats: coefficients of Y_0
BAND_0 = 0.28209479177387814
GREY = 128
TRACK = "track_length"
ERRORS = ("reprojection_error", "error")  # the second is COLMAP's name, but elsewhere may mean anything
OBSERVATION, PAIR = "observation", ("image_id", "vertex_index")


def read_ply(path: Path) -> Cloud:
    """Read the points of a PLY file, ascii or binary.

    Args:
        path: the file; its vertices have x, y and z, and may have red, green and blue (also diffuse_red ... or r, g,
            b; integers of full range, or floats in [0, 1]) or the f_dc_0 ... of Gaussian splats; `track_length`, the
            number of photos that see the point, where 0 or less is unknown; and `reprojection_error` (beside a
            `track_length` also `error`), in pixels, negative when unknown. Integers `image_id` and `vertex_index`
            of an element `observation` after the vertices say which photo sees which point. Others are ignored.

    Returns:
        The points, in the file's frame; grey where the file has no colours.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no PLY file, one that is damaged or truncated, no vertices, positions or errors that are not
            finite, or observations of points that are not there.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, expected a PLY file of points")
    size = path.stat().st_size
    with path.open("rb") as file:
        order, elements = _header(path, file)
        vertices, observations = _elements(path, file, order, elements, size)
    names = vertices.dtype.names
    lacking = [axis for axis in "xyz" if axis not in names]
    if lacking:
        raise ValueError(f"{path}: expected vertices with x, y and z, found no {lacking[0]}")
    with np.errstate(invalid="ignore"):
        positions = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    check_points(path, positions, "points", lambda index: f"vertex {index}")
    with np.errstate(invalid="ignore", over="ignore"):
        colors = _colors(vertices)
    error = next((name for name in ERRORS if name in names and (name == ERRORS[0] or TRACK in names)), None)
    lengths, errors = (
        np.full(len(vertices), unknown) if name not in names else _known(path, vertices, name, unknown)
        for name, unknown in ((TRACK, 0.0), (error, -1.0))
    )
    return Cloud(
        positions,
        colors,
        np.minimum(lengths, np.iinfo(np.int32).max).astype(np.int32),
        errors.astype(np.float32),
        None if observations is None else _pairs(path, observations, len(vertices)),
    )


def write_ply(path: str | os.PathLike[str], cloud: Cloud) -> None:
    """Write points so that `read_ply` gives them back, and other programs read what they know of it.

    Args:
        path: where to; written aside, then renamed.
        cloud: (P, 3) positions in the frame that the file is to have, colours, and what else is known.

    Raises:
        OSError: `path` cannot be written.
    """
    columns = {axis: ("double", cloud.positions[:, index]) for index, axis in enumerate("xyz")}
    columns |= {name: ("uchar", cloud.colors[:, index]) for index, name in enumerate(COLORS[0])}
    if (cloud.track_lengths > 0).any():
        columns[TRACK] = ("int", cloud.track_lengths)
    if (cloud.reprojection_errors >= 0).any():
        columns[ERRORS[0]] = ("float", cloud.reprojection_errors)
    elements = {"vertex": columns}
    if cloud.observations is not None:
        elements[OBSERVATION] = {name: ("int", cloud.observations[:, i]) for i, name in enumerate(PAIR)}
    header, bodies = ["ply", "format binary_little_endian 1.0"], []
    for element, members in elements.items():
        count = len(next(iter(members.values()))[1])
        header += [f"element {element} {count}", *(f"property {kind} {name}" for name, (kind, _) in members.items())]
        rows = np.empty(count, [(name, "<" + TYPES[kind]) for name, (kind, _) in members.items()])
        for name, (_, values) in members.items():
            rows[name] = values
        bodies.append(rows.tobytes())
    with written_aside(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode())
        file.writelines(bodies)


def _known(path: Path, vertices: np.ndarray, name: str, unknown: float) -> np.ndarray:
    """(P,) float64 values of a property, of which all below 0 are unknown."""
    values = vertices[name].astype(np.float64)
    bad = ~(np.abs(values) <= LARGEST_COORDINATE)
    if bad.any():
        index = int(np.flatnonzero(bad)[0])
        raise ValueError(f"{path}: {name}: expected finite numbers, got {values[index]} (vertex {index})")
    return np.where(values < 0, unknown, values)


def _pairs(path: Path, observations: np.ndarray, count: int) -> np.ndarray:
    """(M, 2) int64 ascending pairs of photo and point, each once."""
    image, vertex = (observations[name].astype(np.int64) for name in PAIR)
    if len(image) and (min(image.min(), vertex.min()) < 0 or vertex.max() >= count):
        raise ValueError(
            f"{path}: {OBSERVATION}: expected images from 0 and vertices from 0 to {count - 1}, "
            f"got images {image.min()} to {image.max()} and vertices {vertex.min()} to {vertex.max()}"
        )
    return np.stack(np.divmod(np.unique(image * count + vertex), count), axis=1)


def _header(path: Path, file: io.BufferedReader) -> tuple[str, list[tuple[str, int, list[tuple[str, str]] | None]]]:
    """Format and elements: name, count and properties, which are None for an element with lists."""
    if file.readline(16).strip() != b"ply":
        raise ValueError(f"{path}: expected a PLY file, but it does not begin with 'ply'")
    form = None
    elements: list[tuple[str, int, list[tuple[str, str]] | None]] = []
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
            if elements[-1][2] is not None:
                elements[-1][2].append((words[2], TYPES[words[1]]))
        elif words and words[0] not in ("comment", "obj_info"):
            raise ValueError(f"{path}: expected a PLY header, got the line {' '.join(words)[:60]!r}")
    if form is None:
        raise ValueError(f"{path}: expected a PLY header with a format, found none")
    return form, elements


def _elements(
    path: Path, file: io.BufferedReader, form: str, elements: list, size: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """Structured arrays of the vertices and, where they follow, of the observations; what lies before is skipped."""
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
        # An ascii value takes a digit and a blank or an end of line.
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


def _rows(path: Path, file: io.BufferedReader, form: str, dtype: np.dtype, count: int) -> np.ndarray:
    if form == "ascii":
        return _ascii(path, file, dtype, count) if count else np.empty(0, dtype)
    return np.fromfile(file, dtype, count)


def _ascii(path: Path, file: io.BufferedReader, dtype: np.dtype, count: int) -> np.ndarray:
    lines = itertools.islice((line for line in file if line.strip()), count)
    try:
        values = np.loadtxt(lines, np.float64, comments=None, max_rows=count, ndmin=2, encoding="ascii")
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path}: expected rows of {len(dtype)} numbers, could not read them: {one_line(error)}"
        ) from None
    if values.shape != (count, len(dtype)):
        raise ValueError(f"{path}: truncated, expected {count:,} rows of {len(dtype)} numbers, got {values.shape}")
    vertices = np.empty(count, dtype)
    with np.errstate(invalid="ignore", over="ignore"):
        for index, name in enumerate(dtype.names):
            vertices[name] = values[:, index]
    return vertices


def _colors(vertices: np.ndarray) -> np.ndarray:
    names = vertices.dtype.names
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
