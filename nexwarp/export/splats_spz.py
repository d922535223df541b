"""Surfels as quantised Gaussians in Niantic's SPZ format, a tenth of the size of the PLY file; by GaussForge."""

import gzip
import importlib.util
import math
import os
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nexwarp.cameras.camera import Camera
from nexwarp.errors import FormatError, SettingError
from nexwarp.export.surfels_ply import MAX_EXTENT, SPLAT_DEGREE, save_splats_ply
from nexwarp.io.files import one_line, write_atomically
from nexwarp.model.surfels import Surfels

# SPZ has 24 bits for a coordinate; its header says how many of them are behind the point. GaussForge writes 12.
COORDINATE_BITS, WRITTEN_BITS, FRACTION_BYTE = 24, 12, 13
LARGEST_COORDINATE = 2.0 ** (COORDINATE_BITS - 1 - WRITTEN_BITS) - 1  # values beyond would wrap around
MOST_SHIFT = 12  # more or fewer fractional bits
SMALLEST_SCALE, LARGEST_SCALE = -10.0, 5.9375  # logarithms, in steps of 1/16
LARGEST_LOSS = 0.01
ARRAYS = ("positions", "scales", "rotations", "alphas", "colors", "sh")


def save_splats_spz(
    path: str | os.PathLike[str],
    surfels: Surfels,
    sh_degree: int = SPLAT_DEGREE,
    *,
    cameras: Sequence[Camera] = (),
    max_extent: float = MAX_EXTENT,
) -> None:
    """Write the Gaussians of `save_splats_ply`, whose arguments these are, as an SPZ file.

    Positions have steps of 2^-24 world units, or 2^-22 of the farthest coordinate; 1/4096 units where few
    Gaussians are farther than 2,047 units from the origin, which are left out. UserWarning where more than 1 % of the
    Gaussians are smaller or larger than the format can say. FormatError: no Gaussians, or too far ones.
    """
    if importlib.util.find_spec("gaussforge") is None:
        raise SettingError("--format spz: needs the package gaussforge, found none; pip install 'nexwarp[splats]'")
    import gaussforge

    if not len(surfels):
        raise FormatError(f"{path}: expected surfels to write, the model has none")
    with tempfile.TemporaryDirectory() as folder:
        ply = Path(folder) / "splats.ply"
        save_splats_ply(ply, surfels, sh_degree, cameras=cameras, max_extent=max_extent)
        content = ply.read_bytes()
    library = gaussforge.GaussForge()
    gaussians = _checked(path, library.read(content, "ply"))
    count = gaussians["numPoints"]
    arrays = {name: np.frombuffer(gaussians[name], np.float32).reshape(count, -1) for name in ARRAYS}
    reach = np.abs(arrays["positions"]).max(axis=1)
    shift = _shift(float(reach.max()))
    if shift < 0 and (reach >= LARGEST_COORDINATE).mean() <= LARGEST_LOSS:
        shift = 0  # a few far ones would cost all others their precision
    near = reach * 2.0**shift < LARGEST_COORDINATE
    if (~near).mean() > LARGEST_LOSS:
        raise FormatError(
            f"{path}: SPZ holds Gaussians up to {LARGEST_COORDINATE * 2.0**-shift:,.0f} units from the origin, "
            f"{(~near).sum():,} of {count:,} are farther away; use --format ply"
        )
    large = arrays["scales"][:, :2]  # the third is thin on purpose
    lost = ((large < SMALLEST_SCALE - 0.03) | (large > LARGEST_SCALE + 0.03)).any(axis=1)
    if lost.mean() > LARGEST_LOSS:
        warnings.warn(
            f"{path}: SPZ holds scales from {math.exp(SMALLEST_SCALE):.2g} to {math.exp(LARGEST_SCALE):.3g} units; "
            f"{lost.sum():,} of {count:,} Gaussians have others, and change their size; use --format ply",
            stacklevel=2,
        )
    arrays["positions"] = arrays["positions"] * np.float32(2.0**shift)
    gaussians |= {name: array[near].tobytes() for name, array in arrays.items()} | {"numPoints": int(near.sum())}
    packed = bytearray(gzip.decompress(_checked(path, library.write(gaussians, "spz"))))
    packed[FRACTION_BYTE] += shift
    write_atomically(Path(path), gzip.compress(packed, mtime=0))


def _shift(farthest: float) -> int:
    """Fractional bits more than 12, or fewer, with which a coordinate still fits."""
    if farthest * 2.0**MOST_SHIFT < LARGEST_COORDINATE:
        return MOST_SHIFT
    return max(math.floor(math.log2(LARGEST_COORDINATE / farthest)), -MOST_SHIFT)


def _checked(path: str | os.PathLike[str], answer: Mapping[str, Any]) -> Any:
    """Return what GaussForge returned, unless that is an error."""
    if "error" in answer:
        raise FormatError(f"{path}: GaussForge could not write it ({one_line(answer['error'])})")
    return answer["data"]
