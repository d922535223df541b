"""Surfels as PLY files: with all parameters, or as Gaussians for viewers of 3D Gaussian splatting.

Both are little-endian lists of vertices whose properties have one floating type. Names and activations are those of
3DGS's files: `opacity` is a logit, `scale_*` are logarithms, `rot_*` is a quaternion wxyz, surfel to world, `f_dc_*`
are the constant SH coefficients of red, green and blue, `f_rest_*` the others: all of red, then green, then blue.
"""

import math
import os
from collections.abc import Sequence

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.errors import check_range
from nexwarp.export.bake.observe import axes
from nexwarp.export.splats import split_large
from nexwarp.io.ply import write_elements
from nexwarp.model.surfels import Surfels

MAX_EXTENT = 0.3  # largest scale of an exported Gaussian, as a fraction of its distance to the nearest camera
THINNESS = 1e-3  # third scale of an exported Gaussian, as a fraction of the surfel's smaller scale
SPLAT_DEGREE = 3  # SH degree whose coefficients viewers expect
SURFELS = "nexwarp surfels: gamma = 1 + exp(gamma_i), scale = exp(scale_i), opacity = sigmoid(opacity), rot is wxyz"
SPLATS = "nexwarp surfels as 3DGS Gaussians: the plain appearance, without texture, with gamma = 1"


def save_surfels_ply(path: str | os.PathLike[str], surfels: Surfels) -> None:
    """Write surfels with all their properties, bit for bit.

    Properties: `x y z`, `nx ny nz` (unit normal, for viewers), `f_dc_0..2`, `f_rest_*` (3 (C - 1)), `opacity`
    (logit), `scale_0 scale_1` (logarithms), `rot_0..3` (wxyz, not normalised), `gamma_0 gamma_1` (log(gamma - 1)).
    """
    raw = surfels.state_dict()
    columns = {
        **_appearance(raw["means"], surfels.normals.detach(), raw["sh0"][:, 0], raw["shN"]),
        "opacity": raw["logit_opacities"],
        **_columns("scale", raw["log_scales"]),
        **_columns("rot", raw["raw_quats"]),
        **_columns("gamma", raw["raw_gammas"]),
    }
    write_elements(path, {"vertex": {name: x.cpu().numpy() for name, x in columns.items()}}, SURFELS)


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
    `scale_0..2` (logarithms), `rot_0..3` (wxyz, unit), all float32.

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
    rest = raw["shN"].new_zeros(len(surfels), (SPLAT_DEGREE + 1) ** 2 - 1, 3)
    kept = raw["shN"][:, : (sh_degree + 1) ** 2 - 1]
    rest[:, : kept.shape[1]] = kept
    scales = torch.cat([raw["log_scales"][ids[:whole]], pieces.scales[whole:].log()])
    thin = scales.amin(dim=1, keepdim=True) + math.log(THINNESS)
    columns = {
        **_appearance(means, surfels.normals.detach()[ids], raw["sh0"][ids, 0], rest[ids]),
        "opacity": torch.cat([raw["logit_opacities"][ids[:whole]], pieces.opacities[whole:].logit()]),
        **_columns("scale", torch.cat([scales, thin], dim=1)),
        **_columns("rot", surfels.quats.detach()[ids]),
    }
    write_elements(path, {"vertex": {name: x.float().cpu().numpy() for name, x in columns.items()}}, SPLATS)


def _appearance(
    means: torch.Tensor, normals: torch.Tensor, constant: torch.Tensor, rest: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Return the columns of centres, normals and SH coefficients (N, 3) and (N, C - 1, 3)."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    placed = dict(zip(names, torch.cat([means, normals], dim=1).unbind(1), strict=True))
    return {**placed, **_columns("f_dc", constant), **_columns("f_rest", rest.mT.flatten(1))}


def _columns(name: str, values: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the columns of (N, C) values by name."""
    return {f"{name}_{i}": column for i, column in enumerate(values.unbind(1))}
