"""Sections of a scene file: their names, types and shapes follow from the header; packing and unpacking."""

import itertools
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, cast, get_args

import numpy as np

from nexwarp.errors import FormatError
from nexwarp.export.web.quantise import chunk_count

Quality = Literal["quantised", "full"]
QUALITIES = get_args(Quality)
DTYPES = {"u8": np.uint8, "u16": np.uint16, "u32": np.uint32, "f16": np.float16, "f32": np.float32}
ALIGNMENT = 8
MAGIC = b"NXWSCENE"
FORMAT_VERSION = 1
LARGEST_HEADER = 4 * 2**20
LARGEST_SECTION = 2**30  # bytes, unpacked
SURFEL_ARRAYS = ("means", "quats", "scales", "opacities", "gammas", "limits", "sh")


@dataclass(frozen=True)
class Section:
    """An array of a scene file.

    Attributes:
        name: of the section.
        dtype: a key of `DTYPES`.
        shape: of the array.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        """Size of the array."""
        size = np.dtype(DTYPES[self.dtype]).itemsize
        for one in self.shape:
            size *= one
        return size


def expected_sections(
    quality: Quality, count: int, coefficients: int, limits: bool, photos: int, texture: Mapping[str, object] | None
) -> list[Section]:
    """Return the sections of a scene, in the order of the file, without the poster.

    Args:
        quality: of the file.
        count: number of surfels.
        coefficients: C, SH coefficients of each surfel.
        limits: whether it has detail limits.
        photos: V, photos of the exposures; 0 without exposures.
        texture: arguments of `NeuralTexture`; None without texture.
    """
    if quality == "full":
        sections = [
            Section("means", "f32", (count, 3)),
            Section("quats", "f32", (count, 4)),
            Section("scales", "f32", (count, 2)),
            Section("opacities", "f32", (count,)),
            Section("gammas", "f32", (count, 2)),
            *([Section("limits", "f32", (count, 2))] if limits else []),
            Section("sh", "f32", (count, coefficients, 3)),
        ]
    else:
        chunks, bands = chunk_count(count), round(coefficients**0.5)
        sections = [
            Section("ranges", "f32", (chunks, 7 + bands, 2)),
            Section("means", "u16", (3, count)),
            Section("quats", "u32", (count,)),
            Section("scales", "u16", (2, count)),
            Section("opacities", "u8", (count,)),
            Section("gammas", "u8", (2, count)),
            *([Section("limits_scale", "f32", (2,)), Section("limits", "u16", (2, count))] if limits else []),
            Section("sh", "u8", (coefficients * 3, count)),
        ]
    if photos:
        sections.append(Section("exposures", "f32", (photos, 9)))
    if texture is not None:
        sizes = matrix_shapes(texture)
        levels, entries, features = (int(str(texture[name])) for name in ("levels", "table_size", "features"))
        sections.append(Section("mlp", "f16" if quality == "quantised" else "f32", (sum(a * b for a, b in sizes),)))
        if quality == "quantised":
            sections.append(Section("grid_ranges", "f32", (levels, 2)))
        sections.append(Section("grid", "u8" if quality == "quantised" else "f16", (levels, entries, features)))
    return sections


def sections_of(header: Mapping[str, object], limits: bool) -> list[Section]:
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


def matrix_shapes(texture: Mapping[str, object]) -> list[tuple[int, int]]:
    """Return the shapes (out, in) of the MLP's matrices."""
    levels, features, width, hidden, degree = (
        int(str(texture[name])) for name in ("levels", "features", "width", "hidden_layers", "sh_degree")
    )
    sizes = [levels * features, *[width] * hidden, 3 * (degree + 1) ** 2]
    return [(out, into) for into, out in itertools.pairwise(sizes)]


def pack(content: bytes) -> tuple[str, bytes]:
    """Return the encoding and the bytes that are stored: compressed where that saves at least 2 %."""
    packed = zlib.compress(content, 9)
    return ("deflate", packed) if len(packed) < 0.98 * len(content) else ("raw", content)


def unpack(section: Section, encoding: object, content: bytes) -> np.ndarray:
    """Return a section's array.

    Raises:
        FormatError: the array is too large, or the bytes do not hold it; never more of them are unpacked than it has.
    """
    if section.bytes > LARGEST_SECTION:
        raise FormatError(f"section {section.name}: expected at most {LARGEST_SECTION:,} bytes, got {section.bytes:,}")
    if encoding == "deflate":
        try:
            reader = zlib.decompressobj()
            content = reader.decompress(content, section.bytes + 1)
        except zlib.error as error:
            raise FormatError(f"section {section.name}: expected compressed data ({error})") from None
    elif encoding != "raw":
        raise FormatError(f"section {section.name}: expected the encoding raw or deflate, got {encoding!r:.60}")
    if len(content) != section.bytes:
        raise FormatError(f"section {section.name}: expected {section.bytes:,} bytes, got {len(content):,}")
    array = np.frombuffer(content, np.dtype(DTYPES[section.dtype]).newbyteorder("<"))
    return array.reshape(section.shape).astype(DTYPES[section.dtype], copy=False)
