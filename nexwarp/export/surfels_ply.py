"""Surfels as PLY files: with all parameters, or as Gaussians for viewers of 3D Gaussian splatting.

Both are little-endian lists of vertices whose properties have one floating type. Names and activations are those of
3DGS's files: `opacity` is a logit, `scale_*` are logarithms, `rot_*` is a quaternion wxyz, surfel to world, `f_dc_*`
are the constant SH coefficients of red, green and blue, `f_rest_*` the others: all of red, then green, then blue.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.errors import FormatError, MissingError, check_range
from nexwarp.export.bake.observe import axes
from nexwarp.export.splats import split_large
from nexwarp.io.files import one_line
from nexwarp.io.ply import write_elements
from nexwarp.model.bounds import check_bounds
from nexwarp.model.surfels import Surfels

# Largest scale of an exported Gaussian, as a fraction of its distance to the nearest camera.
MAX_EXTENT = 0.3

# Third scale of an exported Gaussian, as a fraction of the surfel's smaller scale.
THINNESS = 1e-3

# Viewers expect the coefficients of SH degree 3.
SPLAT_DEGREE = 3
SPLAT_COEFFICIENTS = (SPLAT_DEGREE + 1) ** 2

POSITION, NORMAL = ["x", "y", "z"], ["nx", "ny", "nz"]

TYPES = {"float": np.dtype("<f4"), "float32": np.dtype("<f4"), "double": np.dtype("<f8"), "float64": np.dtype("<f8")}

LONGEST_HEADER = 2**16
SURFELS = "nexwarp surfels: gamma = 1 + exp(gamma_i), scale = exp(scale_i), opacity = sigmoid(opacity), rot is wxyz"

SPLATS = "nexwarp surfels as 3DGS Gaussians: the plain appearance, without texture, with gamma = 1"


def save_surfels_ply(path: str | os.PathLike[str], surfels: Surfels) -> None:
    """Write surfels with all their properties; `load_surfels_ply` reads them bit for bit.

    Properties: `x y z`, `nx ny nz` (unit normal, for viewers), `f_dc_0..2`, `f_rest_*` (3 (C - 1)), `opacity`
    (logit), `scale_0 scale_1` (logarithms), `rot_0..3` (wxyz, not normalised), `gamma_0 gamma_1` (log(gamma - 1)).

    Raises:
        OSError: `path` cannot be written.
    """
    raw = surfels.state_dict()
    columns = {
        **_columns(POSITION + NORMAL, torch.cat([raw["means"], surfels.normals.detach()], dim=1)),
        **_columns(_names("f_dc", 3), raw["sh0"][:, 0]),
        **_columns(_names("f_rest", 3 * raw["shN"].shape[1]), raw["shN"].mT.flatten(1)),
        "opacity": raw["logit_opacities"].cpu().numpy(),
        **_columns(_names("scale", 2), raw["log_scales"]),
        **_columns(_names("rot", 4), raw["raw_quats"]),
        **_columns(_names("gamma", 2), raw["raw_gammas"]),
    }
    write_elements(path, {"vertex": columns}, SURFELS)


def save_splats_ply(
    path: str | os.PathLike[str],
    surfels: Surfels,
    sh_degree: int = SPLAT_DEGREE,
    *,
    cameras: Sequence[Camera] = (),
    max_extent: float = MAX_EXTENT,
) -> None:
    """Write surfels as Gaussians for viewers of 3D Gaussian splatting, without the texture and with gamma = 1.

    Each surfel becomes a flat Gaussian, whose third scale is a thousandth of the smaller of the other two. Viewers
    approximate the projection of a Gaussian as affine, which is inaccurate for one that is large compared with its
    distance. A surfel that is large for one of the cameras therefore becomes several Gaussians; these come last.

    Properties: `x y z`, `nx ny nz`, `f_dc_0..2`, `f_rest_0..44` (0 above `sh_degree`), `opacity` (logit),
    `scale_0..2` (logarithms), `rot_0..3` (wxyz, unit).

    Args:
        path: file to write, atomically.
        surfels: the surfels, on any device.
        sh_degree: largest SH degree to write, 0 to 3; higher coefficients are 0.
        cameras: cameras to render accurately from; without any, each surfel is one Gaussian.
        max_extent: largest scale of a Gaussian, as a fraction of its distance to the nearest camera; `math.inf` splits
            nothing.

    Raises:
        ValueError: `sh_degree` is out of its range, or `max_extent` is not > 0.
        OSError: `path` cannot be written.
    """
    check_range("sh_degree", sh_degree, 0, SPLAT_DEGREE)
    if not max_extent > 0:
        raise ValueError(f"max_extent: expected more than 0, got {max_extent}")
    raw = surfels.state_dict()
    pieces = split_large(surfels.means, surfels.scales, surfels.opacities, cameras, max_extent)
    ids, whole = pieces.ids, pieces.whole
    means = raw["means"][ids]
    means[whole:] += sum(
        offset[whole:, None] * axis[ids[whole:]]
        for offset, axis in zip(pieces.offsets.unbind(1), axes(surfels), strict=True)
    )
    rest = raw["shN"].new_zeros(len(surfels), SPLAT_COEFFICIENTS - 1, 3)
    kept = raw["shN"][:, : (sh_degree + 1) ** 2 - 1]
    rest[:, : kept.shape[1]] = kept
    scales = torch.cat([raw["log_scales"][ids[:whole]], pieces.scales[whole:].log()])
    thin = scales.amin(dim=1, keepdim=True) + float(np.log(THINNESS))
    columns = {
        **_columns(POSITION + NORMAL, torch.cat([means, surfels.normals.detach()[ids]], dim=1).float()),
        **_columns(_names("f_dc", 3), raw["sh0"][ids, 0].float()),
        **_columns(_names("f_rest", 3 * rest.shape[1]), rest[ids].mT.flatten(1).float()),
        "opacity": torch.cat([raw["logit_opacities"][ids[:whole]], pieces.opacities[whole:].logit()])
        .float()
        .cpu()
        .numpy(),
        **_columns(_names("scale", 3), torch.cat([scales, thin], dim=1).float()),
        **_columns(_names("rot", 4), surfels.quats.detach()[ids].float()),
    }
    write_elements(path, {"vertex": columns}, SPLATS)


def load_surfels_ply(path: str | os.PathLike[str]) -> Surfels:
    """Read a file of `save_surfels_ply` onto the CPU, bit for bit. Other properties are ignored.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file has another format, is damaged, or holds values that cannot be rendered.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingError(f"{path}: no such file, expected surfels as PLY")
    with open(path, "rb") as file:
        count, dtype, start = _header(path, file.read(LONGEST_HEADER))
        size = path.stat().st_size
        if size != start + count * dtype.itemsize:
            raise FormatError(f"{path}: expected {start + count * dtype.itemsize} bytes, got {size}")
        file.seek(start)
        vertices = np.fromfile(file, dtype, count)
    names = dtype.names or ()
    rest = sum(name.startswith("f_rest_") for name in names)
    sizes = {"f_dc": 3, "f_rest": rest, "scale": 2, "rot": 4, "gamma": 2}
    expected = [*POSITION, "opacity", *(one for name, size in sizes.items() for one in _names(name, size))]
    missing = [name for name in expected if name not in names]
    if missing:
        raise FormatError(f"{path}: expected the properties of nexwarp surfels, found no {missing[0]}")

    def take(names: list[str]) -> torch.Tensor:
        stacked = np.stack([vertices[name] for name in names], axis=1) if names else np.empty((count, 0), dtype[0])
        return torch.from_numpy(stacked.astype(dtype[0].newbyteorder("=")))

    raw = {
        "means": take(POSITION),
        "raw_quats": take(_names("rot", 4)),
        "log_scales": take(_names("scale", 2)),
        "logit_opacities": take(["opacity"])[:, 0],
        "raw_gammas": take(_names("gamma", 2)),
        "sh0": take(_names("f_dc", 3))[:, None],
    }
    try:
        if rest % 3:
            raise ValueError(f"f_rest: expected a multiple of 3 properties, got {rest}")
        raw["shN"] = take(_names("f_rest", rest)).reshape(count, 3, rest // 3).mT
        check_bounds({f"surfels.{name}": x for name, x in raw.items()})
        return Surfels({name: x.contiguous() for name, x in raw.items()})
    except (TypeError, ValueError) as error:
        raise FormatError(f"{path}: expected nexwarp surfels ({one_line(error)})") from None


def _names(name: str, count: int) -> list[str]:
    return [f"{name}_{i}" for i in range(count)]


def _columns(names: list[str], values: torch.Tensor) -> dict[str, np.ndarray]:
    """Return the columns of (N, C) values by name."""
    return dict(zip(names, values.cpu().numpy().T, strict=True))


def _header(path: Path, data: bytes) -> tuple[int, np.dtype, int]:
    """Return the number of vertices, their layout, and the offset of the first in bytes."""
    mark = b"end_header\n"
    end = data.find(mark, 0, LONGEST_HEADER)
    if not data.startswith(b"ply\n") or end < 0:
        raise FormatError(f"{path}: expected a PLY file written by nexwarp")
    lines = [line.split() for line in data[:end].decode("ascii", errors="replace").splitlines()[1:]]
    lines = [words for words in lines if words and words[0] != "comment"]
    try:
        kind, (element, name, count), *properties = lines
        if kind != ["format", "binary_little_endian", "1.0"]:
            raise ValueError(f"expected binary_little_endian 1.0, got {' '.join(kind[1:])}")
        if (element, name) != ("element", "vertex"):
            raise ValueError(f"expected vertices, got {element} {name}")
        wrong = next((words for words in properties if words[0] != "property" or len(words) != 3), None)
        if wrong:
            raise ValueError(f"expected vertices only, with one value per property, got {' '.join(wrong)}")
        kinds = {words[1] for words in properties}
        if len(kinds) != 1 or not kinds <= TYPES.keys():
            raise ValueError(f"expected properties of one floating type, got {', '.join(sorted(kinds)) or 'none'}")
        if not 0 <= int(count) < 2**31:
            raise ValueError(f"expected a number of vertices, got {count}")
        dtype = np.dtype([(words[2], TYPES[words[1]]) for words in properties])
    except ValueError as error:
        raise FormatError(f"{path}: expected the header of nexwarp surfels ({one_line(error)})") from None
    return int(count), dtype, end + len(mark)
