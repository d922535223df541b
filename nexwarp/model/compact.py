"""Coding of a model's tensors in compact files, a third as large; docs/format.md describes it."""

from collections.abc import Mapping

import torch

from nexwarp.errors import check_tensors
from nexwarp.model.detail_limits import NEVER

CODE = ".code"  # end of the name of a tensor that decodes another
# Names of the coded tensors of each kind. `DTYPES` has their types in the file; the others are as in full files.
CURVED = ("surfels.means",)  # a + b sinh(c q): fine near the scene's middle, with a long reach
LINEAR = ("surfels.log_scales", "surfels.logit_opacities", "surfels.sh0")  # a + b q
LINEAR_BYTES = ("surfels.raw_gammas",)  # a + b q
SQUARED = ("surfels.shN", "texture.grid")  # b q |q|: fine near 0, where most coefficients are
QUATS = "surfels.raw_quats"  # q, a multiple of the unit quaternion
ROUNDED = ("footprints", "far_footprints")  # bfloat16: all magnitudes, with three digits
LARGEST = {torch.int16: 2**15 - 1, torch.int8: 2**7 - 1}
DTYPES = {
    **dict.fromkeys((*CURVED, *LINEAR, QUATS), torch.int16),
    **dict.fromkeys((*LINEAR_BYTES, *SQUARED), torch.int8),
    **dict.fromkeys(ROUNDED, torch.bfloat16),
}
CODE_NAMES = {name + CODE for name in (*CURVED, *LINEAR, *LINEAR_BYTES, *SQUARED)}
STORED = {torch.int16: "I16", torch.int8: "I8", torch.bfloat16: "BF16"}
# What logarithms are clamped to. exp(-20) is invisible as an opacity, as its difference from 1 and as a share of the
# median scale; a gamma of 1 + exp(20) is a hard edge, one of 1 + exp(-20) a Gaussian.
REACH = 20.0


def _rows(name: str) -> int:
    """Return how many numbers decode a column."""
    return 3 if name in CURVED else 1 if name in SQUARED else 2


def encode(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the tensors of a compact file, from those of a full one on the CPU."""
    coded: dict[str, torch.Tensor] = {}
    for name, tensor in tensors.items():
        if name not in DTYPES:
            coded[name] = tensor
            continue
        kind, values = DTYPES[name], tensor.double()
        if name in ROUNDED:
            # Rounded towards 0: the largest value is a bound.
            coded[name] = values.clamp(max=NEVER).float().view(torch.int32).bitwise_and(-65536).view(torch.float32)
            coded[name] = coded[name].to(kind)
        elif name == QUATS:
            largest = values.abs().amax(1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
            coded[name] = (values / largest * LARGEST[kind]).round().to(kind)
        else:
            whole, code = _encoded(name, values, LARGEST[kind])
            coded[name], coded[name + CODE] = whole.to(kind), code
    return coded


def _encoded(name: str, values: torch.Tensor, largest: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return whole numbers of at most `largest`, and the numbers (R, columns) that decode each column."""
    if len(values) == 0:
        return values, torch.zeros(_rows(name), *_columns(name, values.shape))
    if name in SQUARED:
        axes = tuple(range(1, values.ndim)) if name == "texture.grid" else (0,)
        scale = (values.abs().amax(axes, keepdim=True) / largest**2).float().double()
        roots = (values.abs() / scale.clamp_min(torch.finfo(torch.float32).tiny)).sqrt().round().clamp(max=largest)
        return roots * values.sign(), scale.float().reshape(1, *_columns(name, values.shape))
    if name in CURVED:
        middle = values.median(0).values.float().double()
        spread = (values - middle).abs().median(0).values.clamp_min(1e-12).float().double()
        bent = torch.asinh((values - middle) / spread)
        step = (bent.abs().amax(0) / largest).clamp_min(1e-12).float().double()
        return (bent / step).round().clamp(-largest, largest), torch.stack([middle, spread, step]).float()
    if name == "surfels.log_scales":  # their unit is that of the scene
        middle = values.median(0).values
        values = values.clamp(middle - REACH, middle + REACH)
    elif name in ("surfels.logit_opacities", "surfels.raw_gammas"):  # the median may be at an end: most opacities 1
        values = values.clamp(-REACH, REACH)
    low, high = values.amin(0), values.amax(0)
    middle = ((low + high) / 2).float().double()
    step = torch.maximum(high - middle, middle - low).div(largest).clamp_min(1e-12).float().double()
    return ((values - middle) / step).round().clamp(-largest, largest), torch.stack([middle, step]).float()


def decode(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the tensors of a full file, from those of a compact one; ValueError where a code does not fit."""
    full = {name: x for name, x in tensors.items() if not name.endswith(CODE)}
    for name, tensor in full.items():
        if name in ROUNDED or name == QUATS:
            full[name] = tensor.float()
        elif name in DTYPES:
            if name + CODE not in tensors:
                raise ValueError(f"expected the tensor {name + CODE}, found none")
            code = tensors[name + CODE]
            check_tensors({name + CODE: (code, (_rows(name), *_columns(name, tensor.shape)))}, dtype=torch.float32)
            full[name] = _decoded(name, tensor.double(), code.double()).float()
    return full


def _columns(name: str, shape: torch.Size) -> tuple[int, ...]:
    """Return the shape of what is coded alike: a level of the grid, a column of the others."""
    return tuple(shape[:1] if name == "texture.grid" else shape[1:])


def _decoded(name: str, whole: torch.Tensor, code: torch.Tensor) -> torch.Tensor:
    if name == "texture.grid":
        return code[0][:, None, None] * whole * whole.abs()
    if name in SQUARED:
        return code[0] * whole * whole.abs()
    if name in CURVED:
        return code[0] + code[1] * torch.sinh(code[2] * whole)
    return code[0] + code[1] * whole
