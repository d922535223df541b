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
from nexwarp.export.splats import Pieces, split_large
from nexwarp.io.files import one_line, written_aside
from nexwarp.model.bounds import check_bounds
from nexwarp.model.surfels import Surfels

# Largest scale of an exported Gaussian, as a fraction of its distance to the nearest camera.
MAX_EXTENT = 0.3

# Third scale of an exported Gaussian, as a fraction of the surfel's smaller scale.
THINNESS = 1e-3

# Viewers expect the coefficients of SH degree 3.
SPLAT_DEGREE = 3
SPLAT_COEFFICIENTS = (SPLAT_DEGREE + 1) ** 2

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
        **_geometry(surfels),
        **_harmonics(raw["sh0"], raw["shN"]),
        "opacity": raw["logit_opacities"],
        **_columns("scale", raw["log_scales"]),
        **_columns("rot", raw["raw_quats"]),
        **_columns("gamma", raw["raw_gammas"]),
    }
    _write(path, columns, SURFELS)


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
    kept = raw["shN"][:, : (sh_degree + 1) ** 2 - 1].float()
    rest = kept.new_zeros(len(surfels), SPLAT_COEFFICIENTS - 1, 3)
    rest[:, : kept.shape[1]] = kept
    pieces = split_large(surfels.means, surfels.scales, surfels.opacities, cameras, max_extent)
    ids, count = pieces.ids, pieces.whole
    geometry = {name: x[ids] for name, x in _geometry(surfels).items()}
    for name, x in zip("xyz", _moved(surfels, pieces).unbind(1), strict=True):
        geometry[name][count:] = x
    scales = torch.cat([raw["log_scales"][ids[:count]], pieces.scales[count:].log()])
    thin = scales.amin(dim=1, keepdim=True) + float(np.log(THINNESS))
    columns = {
        **geometry,
        **_harmonics(raw["sh0"][ids], rest[ids]),
        "opacity": torch.cat([raw["logit_opacities"][ids[:count]], torch.logit(pieces.opacities[count:])]),
        **_columns("scale", torch.cat([scales, thin], dim=1)),
        **_columns("rot", surfels.quats.detach()[ids]),
    }
    _write(path, {name: x.float() for name, x in columns.items()}, SPLATS)


def _moved(surfels: Surfels, pieces: Pieces) -> torch.Tensor:
    """Return the centres of the pieces of split surfels, world frame."""
    ids, (along_x, along_y) = pieces.ids[pieces.whole :], pieces.offsets[pieces.whole :, :, None].unbind(1)
    w, x, y, z = surfels.quats.detach()[ids].unbind(-1)
    axis_x = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=-1)
    axis_y = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1)
    return surfels.means.detach()[ids] + along_x * axis_x + along_y * axis_y


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
    expected = ["x", "y", "z", *_names("f_dc", 3), *_names("f_rest", rest), "opacity", *_names("scale", 2)]
    expected += [*_names("rot", 4), *_names("gamma", 2)]
    missing = [name for name in expected if name not in names]
    if missing:
        raise FormatError(f"{path}: expected the properties of nexwarp surfels, found no {missing[0]}")

    def take(names: list[str]) -> torch.Tensor:
        stacked = np.stack([vertices[name] for name in names], axis=1) if names else np.empty((count, 0), dtype[0])
        return torch.from_numpy(stacked.astype(dtype[0].newbyteorder("=")))

    raw = {
        "means": take(["x", "y", "z"]),
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


def _columns(name: str, values: torch.Tensor) -> dict[str, torch.Tensor]:
    return dict(zip(_names(name, values.shape[1]), values.unbind(1), strict=True))


def _geometry(surfels: Surfels) -> dict[str, torch.Tensor]:
    normals = surfels.normals.detach()
    return dict(
        zip(("x", "y", "z", "nx", "ny", "nz"), (*surfels.means.detach().unbind(1), *normals.unbind(1)), strict=True)
    )


def _harmonics(sh0: torch.Tensor, shN: torch.Tensor) -> dict[str, torch.Tensor]:
    return {**_columns("f_dc", sh0[:, 0]), **_columns("f_rest", shN.mT.flatten(1))}


def _write(path: str | os.PathLike[str], columns: dict[str, torch.Tensor], comment: str) -> None:
    count = len(next(iter(columns.values())))
    kind = "double" if columns["x"].dtype == torch.float64 else "float"
    vertices = np.empty(count, np.dtype([(name, TYPES[kind]) for name in columns]))
    for name, values in columns.items():
        vertices[name] = values.cpu().numpy()
    lines = ["ply", "format binary_little_endian 1.0", f"comment {comment}", f"element vertex {count}"]
    lines += [*(f"property {kind} {name}" for name in columns), "end_header", ""]
    with written_aside(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(lines).encode())
        file.write(vertices.tobytes())


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
