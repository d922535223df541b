"""The surfels: geometry and plain (non-textured) appearance (paper Sec. 4.1)."""

import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from nexwarp import ops
from nexwarp.cameras.camera import Array
from nexwarp.data.ply import read_vertices
from nexwarp.errors import FormatError, check_each, check_finite, check_tensors
from nexwarp.kernels.types import MAX_SH_DEGREE
from nexwarp.model.bounds import check_bounds
from nexwarp.ops.project import GEOMETRY

COEFFICIENTS = tuple((degree + 1) ** 2 for degree in range(MAX_SH_DEGREE + 1))  # of SH degrees 0 to 3
# Distance from the ends of the ranges, where raw values are infinite. Activated values change by at most 2e-6.
END = 1e-6
SOFT = -5.0  # raw gamma of kernels that are all but Gaussian, and that a training can still sharpen

PARAMETERS: dict[str, tuple[int | str, ...]] = {  # and their shapes
    "means": ("N", 3),
    "raw_quats": ("N", 4),
    "log_scales": ("N", 2),
    "logit_opacities": ("N",),
    "raw_gammas": ("N", 2),
    "sh0": ("N", 1, 3),
    "shN": ("N", "C - 1", 3),
}


class Activated(NamedTuple):
    """Activated geometry of N surfels, as the kernels take it: the properties of `Surfels`; differentiable."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    gammas: torch.Tensor


class Surfels(nn.Module):
    """N surfels. The parameters are raw values, the properties are activated ones.

    Parameters (raw): `means` (N, 3) world units; `raw_quats` (N, 4) wxyz, any length but zero; `log_scales` (N, 2);
    `logit_opacities` (N,); `raw_gammas` (N, 2), gamma = 1 + exp(raw); `sh0` (N, 1, 3); `shN` (N, C - 1, 3).

    Properties (activated), differentiable: `quats` (N, 4) wxyz unit, surfel to world; `normals` (N, 3), the z axes;
    `scales` (N, 2) world units; `opacities` (N,) in (0, 1); `gammas` (N, 2) >= 1; `sh` (N, C, 3).
    """

    means: nn.Parameter
    raw_quats: nn.Parameter
    log_scales: nn.Parameter
    logit_opacities: nn.Parameter
    raw_gammas: nn.Parameter
    sh0: nn.Parameter
    shN: nn.Parameter

    def __init__(self, raw: dict[str, torch.Tensor]) -> None:
        """Take the raw values by parameter name, as `state_dict` returns them."""
        super().__init__()
        if raw.keys() != PARAMETERS.keys():
            raise ValueError(f"raw: expected the keys {sorted(PARAMETERS)}, got {sorted(raw)}")
        check_tensors({name: (raw[name], shape) for name, shape in PARAMETERS.items()})
        check_coefficients("shN", raw["shN"].shape[1] + 1)
        for name in PARAMETERS:
            self.register_parameter(name, nn.Parameter(raw[name]))

    @classmethod
    def from_activated(
        cls, means: Array, quats: Array, scales: Array, opacities: Array, gammas: Array, sh: Array
    ) -> "Surfels":
        """Make surfels with new leaf parameters from activated values; `rasterize` keeps the graph of tensors.

        NumPy arrays become tensors on the CPU.

        Args:
            means: (N, 3) centres, world units.
            quats: (N, 4) rotations surfel to world, wxyz, of any length > 0.
            scales: (N, 2) > 0, world units along the surfel's x and y axes.
            opacities: (N,) in [0, 1].
            gammas: (N, 2) >= 1; 1 is a Gaussian, large values a hard-edged quad.
            sh: (N, C, 3) spherical harmonics of the plain colour, DC first; C = (d + 1)^2, d of 0 to 3.

        Raises:
            TypeError, ValueError: a type, shape, device or value does not fit, or a tensor has a graph, which the new
                parameters would cut; the message names the argument.
        """
        means, quats, scales, opacities, gammas, sh = (
            torch.from_numpy(x) if isinstance(x, np.ndarray) else x
            for x in (means, quats, scales, opacities, gammas, sh)
        )
        shapes = GEOMETRY | {"sh": ("N", "C", 3)}
        arguments = dict(zip(shapes, (means, quats, scales, opacities, gammas, sh), strict=True))
        check_tensors({name: (x, shapes[name]) for name, x in arguments.items()})
        if means.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"means: expected float32 or float64, got {means.dtype}")
        check_coefficients("sh", sh.shape[1])
        for name, tensor in arguments.items():
            if tensor.grad_fn is not None and torch.is_grad_enabled():
                raise ValueError(
                    f"{name}: expected a tensor without a graph, got one of {type(tensor.grad_fn).__name__}; "
                    "nexwarp.rasterize keeps the graph, detach() leaves it"
                )
            check_finite(name, tensor)
        largest = quats.abs().amax(dim=-1, keepdim=True)
        check_each("quats", largest[..., 0] > 0, quats, "a length > 0")
        check_each("scales", scales > 0, scales, "values > 0")
        check_each("opacities", (opacities >= 0) & (opacities <= 1), opacities, "values in [0, 1]")
        check_each("gammas", gammas >= 1, gammas, "values >= 1")
        raw = {
            "means": means,
            "raw_quats": nn.functional.normalize(quats / largest, dim=-1),
            "log_scales": scales.log(),
            "logit_opacities": torch.logit(opacities, eps=END),
            "raw_gammas": (gammas - 1).clamp_min(END).log(),
            "sh0": sh[:, :1],
            "shN": sh[:, 1:],
        }
        return cls({name: tensor.detach().clone(memory_format=torch.contiguous_format) for name, tensor in raw.items()})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Surfels":
        """Load surfels from a PLY file, float32 on the CPU: one of `nexwarp export`, or Gaussians of 3DGS.

        A Gaussian becomes a surfel along its two largest axes, with a gamma of 1.007.

        Args:
            path: the file. Properties of its vertices: x, y, z; f_dc_* and f_rest_*; opacity, a logit; scale_*, two or
                three logarithms; rot_*, wxyz; and gamma_*, log(gamma - 1), of surfels.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file is damaged, a property is missing, or its values are out of range.
        """
        file = Path(path)
        vertices = read_vertices(file)
        names = vertices.dtype.names or ()
        for name in ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "rot_0"):
            if name not in names:
                raise FormatError(f"{file}: expected surfels, or Gaussians of 3DGS, found no property {name}")

        def columns(*wanted: str) -> torch.Tensor:
            return torch.from_numpy(np.stack([vertices[name].astype(np.float32) for name in wanted], axis=1))

        def numbered(name: str) -> torch.Tensor:
            count = sum(other.startswith(f"{name}_") for other in names)
            return columns(*(f"{name}_{i}" for i in range(count))) if count else torch.zeros(len(vertices), 0)

        try:
            quats, scales, gammas, rest = (numbered(name) for name in ("rot", "scale", "gamma", "f_rest"))
            if scales.shape[1] == 3:
                quats, scales = _flattened(quats, scales)
            raw = {
                "means": columns("x", "y", "z"),
                "raw_quats": quats,
                "log_scales": scales,
                "logit_opacities": columns("opacity")[:, 0],
                "raw_gammas": gammas if gammas.shape[1] else torch.full((len(vertices), 2), SOFT),
                "sh0": columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None],
                "shN": rest.reshape(len(vertices), 3, -1).mT.contiguous(),
            }
            check_bounds({f"surfels.{name}": x for name, x in raw.items()})
            return cls(raw)
        except (ValueError, RuntimeError) as error:
            raise FormatError(f"{file}: expected surfels, or Gaussians of 3DGS ({error})") from None

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return self.means.device

    def activated(self) -> Activated:
        """Return the activated geometry from one kernel; up to rounding, the values of the properties."""
        raw = (self.raw_quats, self.log_scales, self.logit_opacities, self.raw_gammas)
        return Activated(self.means, *ops.activate(*raw))

    @property
    def quats(self) -> torch.Tensor:
        """(N, 4) unit rotations surfel to world, wxyz."""
        return nn.functional.normalize(self.raw_quats, dim=-1)

    @property
    def normals(self) -> torch.Tensor:
        """(N, 3) unit normals, world frame: the surfel's z axis. Either side may face the camera."""
        return axes(self.quats)[2]

    @property
    def scales(self) -> torch.Tensor:
        """(N, 2) scales along the surfel's x and y axes, world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> torch.Tensor:
        """(N,) opacities in (0, 1)."""
        return self.logit_opacities.sigmoid()

    @property
    def gammas(self) -> torch.Tensor:
        """(N, 2) exponents of the generalised Gaussian (paper Eq. 3), >= 1."""
        return 1 + self.raw_gammas.exp()

    @torch.no_grad()
    def sharpen(self, least_gamma: float) -> None:
        """Raise gammas that are less than `least_gamma`, 1 or more, to it, in place."""
        if least_gamma > 1:
            self.raw_gammas.clamp_(min=math.log(least_gamma - 1))

    @property
    def sh(self) -> torch.Tensor:
        """(N, C, 3) spherical harmonics of the plain colour, DC first."""
        return torch.cat([self.sh0, self.shN], dim=1)


def _flattened(quats: torch.Tensor, log_scales: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the rotations (N, 4) and log scales (N, 2) of Gaussians whose smallest axis becomes the normal."""
    smallest = log_scales.argmin(dim=1)
    # The axes in cyclic order, the smallest one last; and the rotation that puts them there.
    order = torch.tensor([[1, 2], [2, 0], [0, 1]])[smallest]
    turns = torch.tensor([[0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [1.0, 0.0, 0.0, 0.0]])
    return turned(quats, turns[smallest]), log_scales.gather(1, order)


def turned(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Return the product (N, 4) of quaternions wxyz: the turn of the other one, then of the first."""
    w, x, y, z = one.unbind(-1)
    a, b, c, d = other.unbind(-1)
    product = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    return torch.stack(product, dim=-1)


def axes(quats: torch.Tensor) -> list[torch.Tensor]:
    """Return the x, y and z axes of surfels, (N, 3) each, world frame, of unit rotations (N, 4) wxyz."""
    w, x, y, z = quats.unbind(-1)
    columns = [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ]
    return [torch.stack(column, dim=-1) for column in columns]


def check_coefficients(name: str, count: int) -> None:
    """Raise ValueError unless `count` is the number of coefficients of an SH degree, 0 to 3."""
    if count not in COEFFICIENTS:
        *most, last = COEFFICIENTS
        counts = f"{', '.join(map(str, most))} or {last}"
        removed = "; SH degrees above 3 were removed" if count in (25, 36, 49) else ""
        raise ValueError(f"{name}: expected {counts} spherical harmonics coefficients, got {count}{removed}")


def harmonics(means: torch.Tensor, position: torch.Tensor, count: int) -> torch.Tensor:
    """Return the harmonics (N, C) of the directions from a position (3,) to means (N, 3), as derivatives of colours."""
    sh = means.new_zeros(len(means), count, 3).requires_grad_()
    with torch.enable_grad():
        colors = ops.plain_colors(sh, means, position, round(count**0.5) - 1)
        return torch.autograd.grad(colors.sum(), sh)[0][..., 0]
