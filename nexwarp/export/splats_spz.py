"""Surfels as quantised Gaussians in Niantic's SPZ format, a tenth of the size of the PLY file; by GaussForge."""

import importlib.util
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nexwarp.cameras.camera import Camera
from nexwarp.errors import FormatError, SettingError
from nexwarp.export.surfels_ply import MAX_EXTENT, SPLAT_DEGREE, save_splats_ply
from nexwarp.io.files import one_line, write_atomically
from nexwarp.model.surfels import Surfels

LARGEST_COORDINATE = 2047.0  # SPZ has 24 bits, 12 of them behind the point; values beyond would wrap around
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

    Positions have steps of 1/4096 world units. Gaussians beyond 2,047 world units from the origin are left out, as the
    format cannot hold them; FormatError if they are more than 1 %.
    """
    if importlib.util.find_spec("gaussforge") is None:
        raise SettingError("--format spz: needs the package gaussforge, found none; pip install 'nexwarp[splats]'")
    import gaussforge

    with tempfile.TemporaryDirectory() as folder:
        ply = Path(folder) / "splats.ply"
        save_splats_ply(ply, surfels, sh_degree, cameras=cameras, max_extent=max_extent)
        content = ply.read_bytes()
    library = gaussforge.GaussForge()
    gaussians = _checked(path, library.read(content, "ply"))
    count = gaussians["numPoints"]
    arrays = {name: np.frombuffer(gaussians[name], np.float32).reshape(count, -1) for name in ARRAYS if count}
    near = (np.abs(arrays["positions"]) < LARGEST_COORDINATE).all(1) if count else np.zeros(0, bool)
    if (~near).sum() > LARGEST_LOSS * count:
        raise FormatError(
            f"{path}: SPZ holds Gaussians up to {LARGEST_COORDINATE:,.0f} units from the origin, "
            f"{(~near).sum():,} of {count:,} are farther away; use --format ply"
        )
    gaussians |= {name: array[near].tobytes() for name, array in arrays.items()} | {"numPoints": int(near.sum())}
    write_atomically(Path(path), _checked(path, library.write(gaussians, "spz")))


def _checked(path: str | os.PathLike[str], answer: Mapping[str, Any]) -> Any:
    """Return what GaussForge returned, unless that is an error."""
    if "error" in answer:
        raise FormatError(f"{path}: GaussForge could not write it ({one_line(answer['error'])})")
    return answer["data"]
