"""Points in PLY files: positions, and optionally colours."""

import codecs
import io
import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nexwarp.data.capture import Cloud, check_points
from nexwarp.io.files import one_line

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
OVERSHOOT = 2.0  # largest value of floating colours in [0, 1]; those with larger ones are in [0, 255]


@dataclass
class Element:
    """An element of a header, such as the vertices."""

    name: str
    count: int
    properties: list[tuple[str, str]]  # names and numpy types of those that are no lists
    has_lists: bool = False


def read_ply(path: Path) -> Cloud:
    """Read the points of a PLY file, ascii or binary, perhaps none, in the file's frame; grey without colours.

    Its vertices have x, y and z, and optionally colours: red, green, blue (or diffuse_red, ..., or r, g, b) as integers
    of 8 bits or of the type's full range, floats in [0, 1] or up to 255, or f_dc_0, ... of Gaussian splats. Other
    properties and elements are ignored. ValueError: the file is not PLY, is damaged or truncated, or has positions that
    are not finite.
    """
    vertices = read_vertices(path)
    lacking = [axis for axis in "xyz" if axis not in (vertices.dtype.names or ())]
    if lacking:
        raise ValueError(f"{path}: expected vertices with x, y and z, found no {lacking[0]}")
    with np.errstate(invalid="ignore", over="ignore"):  # signalling NaNs warn when they are converted
        positions = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
        check_points(path, positions, "points", lambda index: f"vertex {index}")
        return Cloud.of(positions, _colors(vertices))


def read_vertices(path: Path) -> np.ndarray:
    """Return the vertices (P,) of a PLY file, P >= 1, with a field for each property; errors as of `read_ply`."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, expected a PLY file of points")
    with path.open("rb") as file:
        form, elements = _header(path, file)
        return _vertices(path, file, form, elements)


def _header(path: Path, file: io.BufferedReader) -> tuple[str, list[Element]]:
    """Read the format and the elements."""
    if file.readline(16).removeprefix(codecs.BOM_UTF8).strip() != b"ply":
        raise ValueError(f"{path}: expected a PLY file, but it does not begin with 'ply'")
    form = None
    elements: list[Element] = []
    while file.tell() <= MAX_HEADER:
        line = file.readline(MAX_HEADER)
        words = line.decode("ascii", "replace").split()
        if not line:
            raise ValueError(f"{path}: truncated, the PLY header has no end_header")
        match words:
            case ["end_header", *_]:
                if form is None:
                    raise ValueError(f"{path}: expected a PLY header with a format, found none")
                return form, elements
            case ["format", order, _] if order in ORDERS:
                form = order
            case ["element", name, count] if count.isdecimal() and len(count) <= 18:
                elements.append(Element(name, int(count), []))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_lists = True
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append((name, TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"{path}: expected a PLY header, got the line {' '.join(words)[:60]!r}")
    raise ValueError(f"{path}: expected a PLY header of at most {MAX_HEADER:,} bytes")


def _vertices(path: Path, file: io.BufferedReader, form: str, elements: list[Element]) -> np.ndarray:
    """Read the vertices as a structured array; skip the elements before them."""
    size = path.stat().st_size
    for element in elements:
        left, name, count = size - file.tell(), one_line(element.name, 60), element.count
        if element.has_lists:
            what = "its lists" if name == "vertex" else f"lists of {name} before them"
            raise ValueError(f"{path}: expected vertices without lists first, got {what}")
        fields = [(field, ORDERS[form] + kind) for field, kind in element.properties]
        if len(dict(fields)) < len(fields) or len(fields) > MAX_PROPERTIES:
            raise ValueError(f"{path}: element {name}: expected properties of different names")
        dtype = np.dtype(fields)
        # An ascii value has at least a digit and a separator.
        least = count * (dtype.itemsize if form != "ascii" else max(2 * len(fields), 1)) - (form == "ascii")
        if least > left or count > MAX_POINTS:
            raise ValueError(f"{path}: truncated, expected {count:,} of element {name}, got {left:,} bytes for them")
        if name == "vertex":
            return _ascii(path, file, dtype, count) if form == "ascii" else np.fromfile(file, dtype, count)
        if form == "ascii":
            for _ in range(count):
                file.readline()
        else:
            file.seek(count * dtype.itemsize, io.SEEK_CUR)
    raise ValueError(f"{path}: expected an element vertex, found none")


def _ascii(path: Path, file: io.BufferedReader, dtype: "np.dtype[np.void]", count: int) -> np.ndarray:
    names = dtype.names or ()
    if not count or not names:
        return np.empty(count, dtype)
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


def _white(largest: float, dtype: np.dtype) -> float:
    """Return the value of white for colours of a type: the narrowest range that holds the largest of them."""
    if dtype.kind == "f":
        return 1.0 if largest <= OVERSHOOT else 255.0
    ranges = [255.0, 65535.0] if dtype.itemsize > 2 else [255.0]
    return next((white for white in ranges if largest <= white and dtype.itemsize > 1), float(np.iinfo(dtype).max))


def _colors(vertices: np.ndarray) -> np.ndarray:
    """(P, 3) uint8 colours; grey without any."""
    names = set(vertices.dtype.names or ())
    values = np.full((len(vertices), 3), GREY)
    triple = next((triple for triple in COLORS if set(triple) <= names), None)
    if triple is not None:
        channels = [vertices[name] for name in triple]
        values = np.stack(channels, axis=1).astype(np.float64)
        largest = values.max(initial=0.0, where=np.isfinite(values))
        values *= 255.0 / _white(largest, channels[0].dtype)
    elif set(HARMONICS) <= names:
        values = np.stack([255.0 * (0.5 + BAND_0 * vertices[name]) for name in HARMONICS], axis=1)
    return np.floor(np.nan_to_num(values, nan=float(GREY)).clip(0, 255) + 0.5).astype(np.uint8)
