"""Coding of compact model files: numbers as coarse as pictures allow, entropy-coded; docs/format.md describes it.

A number is rounded to a step at which a bit more or less changes pictures by about as much as for any other number. For
the surfels these are fixed multiples of the noise that pictures may get. For the hash grid they follow from how much
the textured colours change with its entries, S (F, F) for each level: the mean square of a colour's change for changes
u of all entries, each of its own, is u S u. An entry x becomes whole numbers q = W (x - mean) with W^T W proportional
to S, so that rounding them is equally visible in all directions, and with W turned so that the q are uncorrelated.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
import torch

from nexwarp.errors import check_tensors
from nexwarp.model.model import Model
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import NEVER, NeuralTexture

NOISE = 0.002  # standard deviation of what rounding the grid changes in pictures, of 1; surfels add less
NOISES = (1e-5, 0.1)  # least and most
CODE = ".code"  # end of the name of a tensor that decodes another
GRID = "texture.grid"
MEANS = "surfels.means"  # a + b sinh(c q): fine near the scene's middle, with a long reach
QUATS = "surfels.raw_quats"  # q, a multiple of the unit quaternion
ROUNDED = ("footprints", "far_footprints")  # upper halves of float32: all magnitudes, with three digits
# Steps of other numbers, a + b q, and of the above, for a noise of 1; that of the means is in units of sinh^-1, that of
# quaternions of their largest number.
STEPS = {
    MEANS: 1 / 40,
    QUATS: 1 / 8,
    "surfels.log_scales": 1.0,
    "surfels.logit_opacities": 4.0,
    "surfels.raw_gammas": 40.0,
    "surfels.sh0": 2.5,
    "surfels.shN": 2.5,
}
CODED = (*STEPS, GRID, *ROUNDED)
CODE_NAMES = {name + CODE for name in (*STEPS, GRID) if name != QUATS}
LARGEST = 2**23 - 1  # whole number
# What logarithms are clamped to. exp(-20) is invisible as an opacity, as its difference from 1 and as a share of the
# median scale; a gamma of 1 + exp(20) is a hard edge, one of 1 + exp(-20) a Gaussian.
REACH = 20.0
POINTS = 2**16  # on the surfels, at which S is measured
FLAT = 1e-3  # least eigenvalue of S, of their mean: at fewer points, the smallest are not known

# A stream of n bytes holds at most FREE + PER_BYTE * n numbers: a small file cannot ask for much memory.
FREE, PER_BYTE = 2**20, 2**6
DIGITS = 12  # to base 4, at most
DECODER_MEMORY = 2**27  # bytes
SHIFTS = np.arange(0, 8, 2, dtype=np.uint8)
# xz's filter, LZMA2: literals without contexts; the fastest of its searches for matches, of which there are few.
CODER = {"id": 0x21, "preset": 6, "lc": 0, "lp": 0, "pb": 0, "mf": 3, "nice_len": 32, "depth": 1}

# Version 2 had neither streams nor `STEPS`.
TYPES_2 = {
    **dict.fromkeys((MEANS, QUATS, "surfels.log_scales", "surfels.logit_opacities", "surfels.sh0"), "I16"),
    **dict.fromkeys(("surfels.raw_gammas", "surfels.shN", GRID), "I8"),
    **dict.fromkeys(ROUNDED, "BF16"),
}
SQUARED_2 = ("surfels.shN", GRID)  # b q |q|


def encode(
    tensors: Mapping[str, torch.Tensor], sensitivity: torch.Tensor | None = None, noise: float = NOISE
) -> dict[str, torch.Tensor]:
    """Return the tensors of a compact file, from those of a full one on the CPU.

    `sensitivity` (L, F, F) is that of the grid's levels, `texture_sensitivity`; without it, numbers of the grid are
    rounded to 8 bits. `noise` is the standard deviation that the grid's rounding gives pictures, of 1.
    """
    coded: dict[str, torch.Tensor] = {}
    for name, tensor in tensors.items():
        if name not in CODED:
            coded[name] = tensor
            continue
        values, code = tensor.double(), None
        if name in ROUNDED:  # towards 0: the largest value is a bound
            whole = values.clamp(max=NEVER).float().view(torch.int32) >> 16
        elif name == QUATS:
            largest = values.abs().amax(1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
            whole = values / largest / min(noise * STEPS[QUATS], 1 / 64)
        elif name == GRID:
            whole, code = _coded_grid(values, sensitivity, noise)
        else:
            whole, code = _coded_columns(name, values, noise * STEPS[name])
        coded[name] = _packed(name, whole.round().to(torch.int32).numpy())
        if code is not None:
            coded[name + CODE] = code
    return coded


def _coded_columns(name: str, values: torch.Tensor, step: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what becomes whole numbers (N, ...), and the rows (2 or 3, ...) that decode each column."""
    if len(values) == 0:
        return values, torch.zeros(3 if name == MEANS else 2, *values.shape[1:])
    rows = []
    if name == MEANS:
        middle = values.median(0).values.float().double()
        spread = (values - middle).abs().median(0).values.clamp_min(1e-12).float().double()
        values, rows = torch.asinh((values - middle) / spread), [middle, spread]
    else:
        if name == "surfels.log_scales":  # their unit is that of the scene
            center = values.median(0).values
            values = values.clamp(center - REACH, center + REACH)
        elif name in ("surfels.logit_opacities", "surfels.raw_gammas"):  # most opacities may be 1, the median at an end
            values = values.clamp(-REACH, REACH)
        middle = ((values.amin(0) + values.amax(0)) / 2).float().double()
        values, rows = values - middle, [middle]
    steps = (values.abs().amax(0) / LARGEST).clamp_min(step).float().double()
    return values / steps, torch.stack([*rows, steps]).float()


def _coded_grid(
    grid: torch.Tensor, sensitivity: torch.Tensor | None, noise: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what becomes whole numbers (L, T, F), and each level's (1 + F, F): x = row 0 + q @ other rows."""
    levels, _, features = grid.shape
    whole, codes = [], []
    for level, entries in enumerate(grid):
        middle = entries.mean(0).float().double()
        entries = entries - middle
        largest = entries.abs().max().clamp_min(1e-12)
        rows = torch.eye(features).double() * largest / 127
        if sensitivity is not None and (seen := sensitivity[level].double().diagonal().mean()) > 0:
            values, vectors = torch.linalg.eigh(sensitivity[level].double())
            root = vectors * values.clamp_min(FLAT * seen).sqrt() @ vectors.T
            turn = torch.linalg.eigh(root @ entries.T @ entries @ root).eigenvectors
            rows = turn.T @ torch.linalg.inv(root) * noise * math.sqrt(12 / (levels * features))
        numbers = torch.linalg.solve(rows, entries, left=False)
        excess = (numbers.abs().max() / LARGEST).clamp_min(1.0)
        rows, numbers = rows * excess, numbers / excess
        whole.append(numbers)
        codes.append(torch.cat([middle[None], rows]).float())
    return torch.stack(whole), torch.stack(codes)


def texture_sensitivity(model: Model) -> torch.Tensor | None:
    """Return S (L, F, F) float64, see above, of a `NeuralTexture`, on average over points of the surfels.

    Points are taken by the surfels' opacities, with the detail of depths between those of their nearest and farthest
    training views. Half of S is left: the share that a textured hit has in its pixel, squared. None without a grid.
    """
    if type(model.texture) is not NeuralTexture or not len(model.surfels):
        return None
    generator = torch.Generator().manual_seed(0)
    with torch.inference_mode(False), torch.enable_grad():
        model = copy.deepcopy(model).cpu().requires_grad_()
        surfels, texture = model.surfels, cast(NeuralTexture, model.texture)
        ids, points = surface_points(surfels, generator)
        depths = torch.full((POINTS,), 1e-12)
        if (limits := model.detail_limits) is not None:
            nearest, farthest = limits.nearest[ids], limits.farthest[ids]
            between = torch.rand(POINTS, generator=generator)
            depths = torch.where(nearest < farthest, nearest ** (1 - between) * farthest**between, farthest)
        directions = torch.nn.functional.normalize(torch.randn(POINTS, 3, generator=generator))
        colors = texture.evaluate(points[:, None], depths[:, None], directions, 1.0, sh_degree=model.options.sh_degree)
        # Random signs: on average, products of two points vanish.
        signs = torch.randint(0, 2, colors.shape, generator=generator) * 2 - 1
        grads = torch.autograd.grad((colors * signs).sum(), texture.grid)[0].double()
    sensitivity = grads.mT @ grads / (3 * POINTS) / 2
    return sensitivity if bool(sensitivity.isfinite().all()) else None


@torch.no_grad()
def surface_points(surfels: Surfels, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Return surfels (POINTS,) by their opacities, and a point (POINTS, 3) in the plane of each, by its scales."""
    sums = surfels.opacities.double().cumsum(0)
    places = torch.rand(POINTS, generator=generator, dtype=torch.float64) * sums[-1]
    ids = torch.searchsorted(sums, places).clamp(max=len(surfels) - 1)
    scales = torch.nn.functional.pad(surfels.scales[ids], (0, 1))
    offsets = torch.randn(POINTS, 3, generator=generator) * scales
    real, turn = surfels.quats[ids].split([1, 3], dim=1)
    turned = 2 * torch.linalg.cross(turn, offsets)
    return ids, surfels.means[ids] + offsets + real * turned + torch.linalg.cross(turn, turned)


def _packed(name: str, whole: np.ndarray) -> torch.Tensor:
    """Return the stream (n,) uint8 of whole numbers: xz of their digits to base 4, four to a byte.

    The first digits of all numbers come first, and numbers of a column, or a level's feature, follow each other: so
    xz, whose contexts are bytes, comes within a tenth of the entropy.
    """
    import lzma

    ordered = np.moveaxis(whole, 1 if name == GRID else 0, -1).ravel()
    folded = (ordered << 1 ^ ordered >> 31).view(np.uint32)  # 0, -1, 1, -2 ... -> 0, 1, 2, 3 ...
    folded = np.pad(folded, (0, -len(folded) % 4)).reshape(-1, 4)
    digits = max(int(folded.max(initial=0)).bit_length() + 1, 2) // 2
    planes = [((folded >> 2 * k & 3) << SHIFTS).sum(1, dtype=np.uint8).tobytes() for k in range(digits)]
    stream = lzma.compress(b"".join(planes), filters=[CODER])
    stream = stream.ljust(4 * math.ceil((whole.size - FREE) / PER_BYTE / 4), b"\0")  # of numbers almost all alike
    return torch.frombuffer(bytearray(stream), dtype=torch.uint8)


def _unpacked(name: str, stream: torch.Tensor, shape: Sequence[int]) -> torch.Tensor:
    """Return the whole numbers, int32, of a stream; ValueError if it does not hold the numbers of a shape."""
    import lzma

    count = math.prod(shape)
    if count > FREE + PER_BYTE * len(stream):
        raise ValueError(f"{name}: expected at most {FREE + PER_BYTE * len(stream)} numbers, got shape {[*shape]}")
    plane = math.ceil(count / 4)  # bytes
    decoder = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=DECODER_MEMORY)
    try:
        data = decoder.decompress(stream.numpy().tobytes(), max_length=DIGITS * plane + 1)
    except lzma.LZMAError as error:
        raise ValueError(f"{name}: expected an xz stream ({error})") from None
    if not decoder.eof or len(data) not in [k * plane for k in range(1, DIGITS + 1)]:
        raise ValueError(f"{name}: expected the digits of {count} numbers, got {len(data)} bytes, or a part")
    folded = np.zeros((plane, 4), np.uint32)
    for k, packed in enumerate(np.frombuffer(data, np.uint8).reshape(-1, plane) if plane else ()):
        folded |= (packed[:, None] >> SHIFTS & 3).astype(np.uint32) << 2 * k
    signed = (folded >> 1).astype(np.int32) ^ -(folded & 1).astype(np.int32)
    axis = 1 if name == GRID else 0
    columns = [*shape[:axis], *shape[axis + 1 :]]
    return torch.from_numpy(signed.ravel()[:count]).view(*columns, shape[axis]).movedim(-1, axis)


def decode(tensors: Mapping[str, torch.Tensor], shapes: Mapping[str, Sequence[int]] | None) -> dict[str, torch.Tensor]:
    """Return the tensors of a full file, from those of a compact one; ValueError where one does not fit.

    `shapes` are those of the coded tensors; None in files of version 2, which are not streams.
    """
    full = {name: x for name, x in tensors.items() if not name.endswith(CODE)}
    for name in full.keys() & set(CODED):
        whole = full[name] if shapes is None else _unpacked(name, full[name], shapes[name])
        if name in ROUNDED and shapes is not None:
            full[name] = (whole << 16).view(torch.float32)
        elif name in ROUNDED or name == QUATS:
            full[name] = whole.float()
        elif name + CODE not in tensors:
            raise ValueError(f"expected the tensor {name + CODE}, found none")
        else:
            full[name] = _decoded(name, whole, tensors[name + CODE], shapes is None and name in SQUARED_2)
    return full


def _decoded(name: str, whole: torch.Tensor, code: torch.Tensor, squared: bool) -> torch.Tensor:
    """Return the values of whole numbers, float32, after a check of their code's shape."""
    columns = whole.shape[1:]
    shape: tuple[int, ...] = (1 if squared else 3 if name == MEANS else 2, *columns)
    if name == GRID:
        shape = (1, len(whole)) if squared else (len(whole), 1 + columns[1], columns[1])
    check_tensors({name + CODE: (code, shape)}, dtype=torch.float32)
    q, code = whole.double(), code.double()
    if squared:
        values = (code[0, :, None, None] if name == GRID else code[0]) * q * q.abs()
    elif name == GRID:
        values = code[:, :1] + q @ code[:, 1:]
    else:
        values = code[0] + code[1] * (torch.sinh(code[2] * q) if name == MEANS else q)
    return values.float()
