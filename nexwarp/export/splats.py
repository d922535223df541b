"""Surfels as files: PLY with all parameters, and Gaussians for viewers of splats, as PLY, SPZ or glTF.

PLY files are little-endian lists of vertices whose properties have one floating type. Names and activations are those
of 3DGS's files: `opacity` is a logit, `scale_*` are logarithms, `rot_*` is a quaternion wxyz, surfel to world, `f_dc_*`
are the constant SH coefficients of red, green and blue, `f_rest_*` the others: all of red, then green, then blue.

Viewers linearise the projection at each Gaussian's centre, which is accurate for Gaussians that are small compared with
their distance. A large surfel therefore becomes a grid of smaller, overlapping Gaussians in its plane, whose blended
alpha approximates the surfel's.
"""

import gzip
import json
import math
import os
import struct
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.similarity import upright
from nexwarp.errors import FormatError
from nexwarp.export.bake import points_on
from nexwarp.io.files import one_line, write_atomically
from nexwarp.io.pictures import linear_light
from nexwarp.io.ply import write_elements
from nexwarp.kernels.sh import BAND_0
from nexwarp.kernels.types import ALPHA_MAX, ALPHA_MIN
from nexwarp.model.surfels import SOFT, Surfels

MAX_EXTENT = 0.3  # largest scale of an exported Gaussian, as a fraction of its distance to the nearest camera
THINNESS = 1e-3  # third scale of an exported Gaussian, as a fraction of the surfel's smaller scale
SPLATTING = "KHR_gaussian_splatting"  # extension of glTF
SPLAT_DEGREE = 3  # SH degree whose coefficients viewers expect
SURFELS = "nexwarp surfels: gamma = 1 + exp(gamma_i), scale = exp(scale_i), opacity = sigmoid(opacity), rot is wxyz"
SPLATS = "nexwarp surfels as 3DGS Gaussians: the plain appearance, without texture"

SPACING = 1.4  # between neighbouring pieces, in their standard deviations: leaves a ripple below 2 %
MOST_STEPS = 16  # pieces on either side of a surfel's centre, along one axis
FEWEST_STEPS = 3  # a coarser grid would be one Gaussian that is larger than the surfel
MOST_PIECES, PIECES_EACH = 50_000, 16  # in all, and more for each surfel, before grids get coarser
LEVELS = 128  # opacities that grids are fitted for; other opacities scale the nearest grid
FITTING_STEPS = 40
WIDTHS = (1.0, 0.95, 0.9, 0.85, 0.8, 0.75, 0.7)  # candidates of a row of pieces, in standard deviations of the surfel

# SPZ has 24 bits for a coordinate; its header says how many of them are behind the point. GaussForge writes 12.
COORDINATE_BITS, WRITTEN_BITS, FRACTION_BYTE = 24, 12, 13
LARGEST_COORDINATE = 2.0 ** (COORDINATE_BITS - 1 - WRITTEN_BITS) - 1  # values beyond would wrap around
MOST_SHIFT = 12  # more or fewer fractional bits
SMALLEST_SCALE, LARGEST_SCALE = -10.0, 5.9375  # logarithms, in steps of 1/16
LARGEST_LOSS = 0.01


def save_surfels_ply(path: str | os.PathLike[str], surfels: Surfels) -> None:
    """Write surfels with all their properties, bit for bit.

    Properties: `x y z`, `nx ny nz` (unit normal, for viewers), `f_dc_0..2`, `f_rest_*` (3 (C - 1)), `opacity`
    (logit), `scale_0 scale_1` (logarithms), `rot_0..3` (wxyz, not normalised), `gamma_0 gamma_1` (log(gamma - 1)).
    """
    raw = surfels.state_dict()
    groups = {
        "x y z": raw["means"],
        "nx ny nz": surfels.normals,
        "f_dc": raw["sh0"][:, 0],
        "f_rest": raw["shN"].mT.flatten(1),
        "opacity": raw["logit_opacities"],
        "scale": raw["log_scales"],
        "rot": raw["raw_quats"],
        "gamma": raw["raw_gammas"],
    }
    write_elements(path, {"vertex": _columns(groups)}, SURFELS)


@dataclass(frozen=True)
class Gaussians:
    """M Gaussians that show the plain appearance of surfels.

    Attributes:
        means: (M, 3) centres, world units.
        normals: (M, 3) unit normals.
        quats: (M, 4) unit quaternions wxyz, Gaussian to world.
        log_scales: (M, 3) logarithms of the standard deviations, the third thin.
        logit_opacities: (M,)
        sh: (M, (degree + 1)^2, 3) coefficients.
    """

    means: torch.Tensor
    normals: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor
    logit_opacities: torch.Tensor
    sh: torch.Tensor


@torch.no_grad()
def softened(surfels: Surfels) -> Surfels:
    """Return Gaussian surfels whose alpha has the same integral along each axis as that of these, paper Eq. 3."""
    raw, halves = surfels.state_dict(), 0.5 / surfels.gammas
    # exp(-|u|^(2 gamma) / 2) has the integral 2 * 2^halves * Gamma(1 + halves), and a Gaussian (2 pi)^(1/2).
    raw["log_scales"] = raw["log_scales"] + halves * math.log(2) + torch.lgamma(1 + halves) - math.log(math.pi / 2) / 2
    raw["raw_gammas"] = torch.full_like(raw["raw_gammas"], SOFT)
    return Surfels(raw)


@torch.no_grad()
def gaussians(
    surfels: Surfels,
    sh_degree: int = SPLAT_DEGREE,
    cameras: Sequence[Camera] = (),
    max_extent: float = MAX_EXTENT,
) -> Gaussians:
    """Return surfels as Gaussians of SH degree 0 to 3, `softened` and without the texture.

    Each surfel becomes a flat Gaussian, whose third scale is a thousandth of the smaller of the other two, or several
    of them, which come last: a scale is at most `max_extent` of the distance to the nearest of the cameras.
    """
    surfels = softened(surfels)
    raw = surfels.state_dict()
    pieces = split_large(surfels.means, surfels.scales, surfels.opacities, cameras, max_extent)
    ids, whole = pieces.ids, pieces.whole
    means = raw["means"][ids]
    means[whole:] = points_on(surfels, ids[whole:], pieces.offsets[whole:])
    sh = raw["sh0"].new_zeros(len(surfels), (sh_degree + 1) ** 2, 3)
    kept = torch.cat([raw["sh0"], raw["shN"]], dim=1)[:, : (sh_degree + 1) ** 2]
    sh[:, : kept.shape[1]] = kept
    scales = torch.cat([raw["log_scales"][ids[:whole]], pieces.scales[whole:].log()])
    thin = scales.amin(dim=1, keepdim=True) + math.log(THINNESS)
    logits = torch.cat([raw["logit_opacities"][ids[:whole]], pieces.opacities[whole:].logit()])
    return Gaussians(means, surfels.normals[ids], surfels.quats[ids], torch.cat([scales, thin], 1), logits, sh[ids])


def save_splats_ply(path: str | os.PathLike[str], splats: Gaussians) -> None:
    """Write Gaussians for viewers of 3D Gaussian splatting; SH above their degree are 0.

    Properties: `x y z`, `nx ny nz`, `f_dc_0..2`, `f_rest_0..44`, `opacity` (logit), `scale_0..2` (logarithms),
    `rot_0..3` (wxyz, unit), all float32.
    """
    missing = (SPLAT_DEGREE + 1) ** 2 - splats.sh.shape[1]
    groups = {
        "x y z": splats.means,
        "nx ny nz": splats.normals,
        "f_dc": splats.sh[:, 0],
        "f_rest": torch.nn.functional.pad(splats.sh[:, 1:].mT, (0, missing)).flatten(1),
        "opacity": splats.logit_opacities,
        "scale": splats.log_scales,
        "rot": splats.quats,
    }
    columns = _columns({name: values.float() for name, values in groups.items()})
    write_elements(path, {"vertex": columns}, SPLATS)


def _columns(groups: Mapping[str, torch.Tensor]) -> dict[str, np.ndarray]:
    """Return columns by name: those of "x y z" are x, y and z; the two of "gamma" gamma_0 and gamma_1."""
    columns: dict[str, np.ndarray] = {}
    for group, values in groups.items():
        numbered = [f"{group}_{i}" for i in range(values.shape[-1])]
        names = group.split() if " " in group or values.ndim == 1 else numbered
        columns |= zip(names, values.detach().cpu().numpy().reshape(len(values), len(names)).T, strict=True)
    return columns


def save_splats_glb(path: str | os.PathLike[str], splats: Gaussians, cameras: Sequence[Camera]) -> None:
    """Write Gaussians as glTF with KHR_gaussian_splatting.

    The file is binary glTF 2.0: one primitive of points, which programs without the extension show in the colours of
    COLOR_0. The mean of the cameras' upward directions becomes +y, by the node. FormatError: there are no Gaussians.
    """
    _check_any(path, splats)
    opacities = splats.logit_opacities.sigmoid()
    display = (BAND_0 * splats.sh[:, 0] + 0.5).clamp(0, 1)
    attributes = {
        "POSITION": splats.means,
        "COLOR_0": torch.cat([linear_light(display), opacities[:, None]], dim=1),
        f"{SPLATTING}:ROTATION": splats.quats.roll(-1, 1),  # xyzw
        f"{SPLATTING}:SCALE": splats.log_scales.exp(),
        f"{SPLATTING}:OPACITY": opacities,
    }
    for index, coefficients in enumerate(splats.sh.unbind(1)):
        degree = math.isqrt(index)
        attributes[f"{SPLATTING}:SH_DEGREE_{degree}_COEF_{index - degree**2}"] = coefficients
    arrays = {name: values.float().cpu().contiguous().numpy() for name, values in attributes.items()}
    kinds = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4"}
    accessors, views, offset = [], [], 0
    for number, array in enumerate(arrays.values()):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes})
        kind = kinds[array.shape[1:]]
        accessors.append({"bufferView": number, "componentType": 5126, "count": len(array), "type": kind})
        offset += array.nbytes
    accessors[0] |= {"min": arrays["POSITION"].min(0).tolist(), "max": arrays["POSITION"].max(0).tolist()}
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": 0, "attributes": {name: i for i, name in enumerate(arrays)}, "extensions": {SPLATTING: kernel}}
    turn = np.eye(4)
    turn[:3, :3] = upright(cameras)
    tree = {
        "asset": {"version": "2.0", "generator": "nexwarp"},
        "extensionsUsed": [SPLATTING],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": turn.T.flatten().tolist()}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + offset)
    chunks = (struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", offset, b"BIN\0"))
    write_atomically(Path(path), b"".join([header, *chunks, *(array.tobytes() for array in arrays.values())]))


def save_splats_spz(path: str | os.PathLike[str], splats: Gaussians) -> None:
    """Write Gaussians as an SPZ file.

    Positions have steps of 2^-24 world units, or 2^-22 of the farthest coordinate; 1/4096 units where few
    Gaussians are farther than 2,047 units from the origin, which are left out. UserWarning where more than 1 % of the
    Gaussians are smaller or larger than the format can say. FormatError: no Gaussians, or too far ones.
    """
    import gaussforge

    _check_any(path, splats)
    tensors = {
        "positions": splats.means,
        "scales": splats.log_scales,
        "rotations": splats.quats,
        "alphas": splats.logit_opacities,
        "colors": splats.sh[:, 0],
        "sh": torch.nn.functional.pad(splats.sh[:, 1:], (0, 0, 0, (SPLAT_DEGREE + 1) ** 2 - splats.sh.shape[1])),
    }
    count = len(splats.means)
    arrays = {name: x.detach().float().cpu().numpy() for name, x in tensors.items()}
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
    data = {name: array[near].tobytes() for name, array in arrays.items()}
    data |= {"numPoints": int(near.sum()), "meta": {"shDegree": SPLAT_DEGREE}}
    answer = gaussforge.GaussForge().write(data, "spz")
    if "error" in answer:
        raise FormatError(f"{path}: GaussForge could not write it ({one_line(answer['error'])})")
    packed = bytearray(gzip.decompress(answer["data"]))
    packed[FRACTION_BYTE] += shift
    write_atomically(Path(path), gzip.compress(packed, mtime=0))


def _check_any(path: str | os.PathLike[str], splats: Gaussians) -> None:
    if not len(splats.means):
        raise FormatError(f"{path}: expected surfels to write, the model has none")


def _shift(farthest: float) -> int:
    """Fractional bits more than 12, or fewer, with which a coordinate still fits."""
    if farthest * 2.0**MOST_SHIFT < LARGEST_COORDINATE:
        return MOST_SHIFT
    return max(math.floor(math.log2(LARGEST_COORDINATE / farthest)), -MOST_SHIFT)


@dataclass(frozen=True)
class Pieces:
    """M Gaussians: whole surfels first, then pieces of split surfels."""

    whole: int  # number of whole surfels
    ids: torch.Tensor  # (M,) int64, indices of the surfels
    offsets: torch.Tensor  # (M, 2) of the centres along the surfel's two axes, world units
    scales: torch.Tensor  # (M, 2) standard deviations along the two axes, world units
    opacities: torch.Tensor  # (M,)


@torch.no_grad()
def split_large(
    means: torch.Tensor, scales: torch.Tensor, opacities: torch.Tensor, cameras: Sequence[Camera], max_extent: float
) -> Pieces:
    """Split Gaussians of which a scale is above `max_extent` of their distance to a camera.

    The surfels that are small enough come first, in order, then pieces of the others; very many, in coarser grids.
    """
    limit = means.new_full((len(means),), math.inf)
    for camera in cameras:
        position = camera.position.to(means)
        limit = torch.minimum(limit, max_extent * (means - position).norm(dim=1))
    peak = opacities.clamp(max=ALPHA_MAX)
    level = (peak * LEVELS).round().clamp(1, LEVELS - 1)
    reach = _reach(level / LEVELS)
    wanted = (reach[:, None] * scales / (SPACING * limit[:, None])).ceil().clamp(1, MOST_STEPS)
    wanted = torch.where((scales > limit[:, None]) & (peak >= ALPHA_MIN)[:, None], wanted, 0.0).long()
    most, steps = MOST_STEPS, wanted
    while most > FEWEST_STEPS and int((2 * steps + 1).prod(dim=1).sum()) > MOST_PIECES + PIECES_EACH * len(steps):
        most -= 1
        steps = wanted.clamp(max=most)
    whole = (steps == 0).all(dim=1)
    small = whole.nonzero()[:, 0]
    parts = [(small, means.new_zeros(len(small), 2), scales[whole], opacities[whole])]
    large = (~whole).nonzero()[:, 0]
    kinds, kind = torch.unique(torch.cat([steps[large], level[large, None].long()], dim=1), dim=0, return_inverse=True)
    for index, (across, along, grade) in enumerate(kinds.tolist()):
        members = large[kind == index]
        grid, size, alpha = (x.to(means) for x in _grid(across, along, grade))
        offsets, sizes = scales[members, None] * grid, (scales[members, None] * size).expand(-1, len(grid), 2)
        alphas = (peak[members, None] * LEVELS / grade * alpha).clamp(max=ALPHA_MAX)
        ids = members.repeat_interleave(len(grid))
        parts.append((ids, offsets.flatten(0, 1), sizes.flatten(0, 1), alphas.flatten()))
    joined = [torch.cat(each) for each in zip(*parts, strict=True)]
    return Pieces(len(small), *joined)


def _reach(peak: torch.Tensor) -> torch.Tensor:
    """Return the distance from the centre, in standard deviations, at which a hit's alpha falls to 1/255."""
    return (2 * (peak / ALPHA_MIN).log().clamp(min=0)).sqrt()


@lru_cache(4096)
def _grid(across: int, along: int, level: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return centres (P, 2), sizes (2,) in those of the surfel, and opacities (P,) of 2n + 1 pieces along an axis."""
    peak = torch.tensor(level / LEVELS, dtype=torch.float64)
    reach = float(_reach(peak))
    spacing = [reach / n if n else 0.0 for n in (across, along)]
    steps = [torch.arange(-n, n + 1, dtype=torch.float64) for n in (across, along)]
    grid = torch.cartesian_prod(*steps) * torch.tensor(spacing, dtype=torch.float64)
    grid = grid[_falloff(grid) * peak >= ALPHA_MIN / 2]
    side = torch.linspace(-reach, reach, 41, dtype=torch.float64)
    places = torch.cartesian_prod(side, side)
    wanted = peak * _falloff(places)
    best = math.inf
    # Opaque pieces of a row blend to a profile that is wider than each of them: try narrower pieces.
    for narrower in WIDTHS if 0.0 in spacing else (1.0,):
        candidate = torch.tensor([step / SPACING if step else narrower for step in spacing], dtype=torch.float64)
        fitted = _fitted(grid, candidate, peak)
        falloff = _falloff((places[:, None] - grid) / candidate)
        error = float((1 - (1 - fitted * falloff).prod(1) - wanted).square().mean())
        if error < best:
            best, size, alpha = error, candidate, fitted
    kept = alpha >= ALPHA_MIN
    return grid[kept], size, alpha[kept]


def _falloff(offsets: torch.Tensor) -> torch.Tensor:
    return torch.exp(-0.5 * offsets.square().sum(-1))


def _fitted(grid: torch.Tensor, size: torch.Tensor, peak: torch.Tensor) -> torch.Tensor:
    """Return the opacities (P,) of pieces whose optical depths, -log(1 - alpha), add up to the surfel's."""
    wanted = -torch.log1p(-peak * _falloff(grid))
    falloff = _falloff((grid[:, None] - grid) / size)
    depths = wanted / falloff.sum(1)
    for _ in range(FITTING_STEPS):
        total = -torch.log1p(torch.expm1(-depths) * falloff).sum(1)
        depths = depths * (wanted / total).clamp(0.25, 4.0)
    return -torch.expm1(-depths)
