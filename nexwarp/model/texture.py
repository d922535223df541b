"""Textures: what any has in common, and the neural texture, a hash grid and a small MLP (paper Sec. 4.1).

Also their detail limits, which are not in the paper.
"""

import itertools
import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TypedDict, TypeVar

import torch
from torch import nn
from typing_extensions import NotRequired

from nexwarp import ops
from nexwarp.cameras.camera import Camera
from nexwarp.errors import check_integer, check_number, check_tensors
from nexwarp.kernels.types import MAX_SH_DEGREE
from nexwarp.ops import fused_texture

GRID_INIT = 0.01

# Cells have int32 indices: in finer grids these overflow.
LARGEST_RESOLUTION = 1e9

NEVER = 1e30  # depth / focal of a surfel that no training view saw: its texture gets no detail

# Focal length in pixels at which no level is down-weighted: every cell is larger than a pixel.
FOCAL_WITHOUT_DOWN_WEIGHTING = 1e12


@dataclass(frozen=True)
class Hits:
    """What a picture's rays hit. All but `ids` are differentiable; `rasterize` stacks those of several cameras.

    Attributes:
        ids: (H, W, K) int32, surfels of the K heaviest hits, heaviest first; -1 in empty slots.
        depths: (H, W, K) their z-depths, world units; 0 in empty slots.
        weights: (H, W, K) their blending weights; 0 in empty slots.
        plain: (H, W, D) blended colours of all other hits (N of paper Eq. 6), and of the background where one is given.
        alpha: (H, W) 1 - final transmittance.
        points: (H, W, K, 3) the hits, world frame; the camera's position in empty slots.
        directions: (H, W, 3) unit directions of the pixels' rays, world frame.
    """

    ids: torch.Tensor
    depths: torch.Tensor
    weights: torch.Tensor
    plain: torch.Tensor
    alpha: torch.Tensor
    points: torch.Tensor
    directions: torch.Tensor


class Texture(nn.Module):
    """A texture of your own: a torch module that replaces `colors`. `render`, `Model` and `nexwarp.train` take it.

    Its parameters and buffers are float32. Model files keep those of classes that `nexwarp.register_texture` knows.

    Attributes:
        residual: add the colours to the surfels' plain colours instead of replacing them.
        sh_degree: of its colours, up to which a training raises the degree of pictures step by step.
        rates: first and last learning rate of all its parameters, which are the parameter group "texture" of a
            training; in between, rates fall log-linearly.
        per_surfel: names of parameters and buffers with a row for each surfel. Density control moves their rows;
            children take their parent's.
        config: keyword arguments that make another of the same shape, JSON values; of registered classes.
    """

    residual: bool = False
    sh_degree: int = 0
    rates: tuple[float, float] = (5e-3, 5e-4)
    per_surfel: tuple[str, ...] = ()
    config: Mapping[str, object]

    def colors(self, hits: Hits, camera: Camera) -> torch.Tensor:
        """Return the colours (H, W, K, 3) of hits; those in empty slots do not count, as long as they are finite."""
        raise NotImplementedError(f"{type(self).__name__}.colors: expected a method that returns colours of hits")

    def half_copy_key(self) -> Hashable | None:
        """Return what changes when a copy that evaluations read is made anew; None without a copy."""
        return None

    def drop_half_copy(self) -> None:
        """Give up that copy."""

    def regulariser(self) -> torch.Tensor | None:
        """Return a scalar that a training adds to its loss as it is; None adds nothing."""
        return None


Own = TypeVar("Own", bound=type[Texture])
_REGISTERED: dict[str, type[Texture]] = {}


def register_texture(kind: Own) -> Own:
    """Make `Model.save` and `nexwarp.load` know a class of textures, by its name; also a decorator of the class.

    A file keeps `config`, and parameters and buffers in float32. `load` calls the class with `config` and copies the
    tensors into what it gets; whoever reads the file registers the class first.

    Raises:
        TypeError, ValueError: no subclass of `nexwarp.Texture`, or another class has this name.
    """
    if not (isinstance(kind, type) and issubclass(kind, Texture)) or kind in (Texture, NeuralTexture):
        raise TypeError(f"kind: expected a subclass of nexwarp.Texture, got {kind!r:.60}")
    other = _REGISTERED.get(kind.__name__, kind)
    # A notebook's cell may run twice.
    if (other.__module__, other.__qualname__) != (kind.__module__, kind.__qualname__):
        raise ValueError(f"kind: expected another name, as {other.__module__} has registered {kind.__name__}")
    _REGISTERED[kind.__name__] = kind
    return kind


def registered_texture(name: str) -> type[Texture] | None:
    """Return a registered class by its name; None where there is none."""
    return _REGISTERED.get(name)


class TextureShape(TypedDict):
    """Arguments of `NeuralTexture`, as a model file keeps them; those of nexwarp 0.1 do not have the flags."""

    levels: int
    table_size: int
    features: int
    min_resolution: float
    max_resolution: float
    width: int
    hidden_layers: int
    sh_degree: int
    residual: NotRequired[bool]
    down_weighting: NotRequired[bool]


class NeuralTexture(Texture):
    """World-space field G(Delta H(x)) of SH coefficients (paper Eq. 5).

    H are hash-grid features (paper Eq. 2), Delta the down-weighting (paper Eq. 4).

    Parameters: `grid` (levels, table_size, features), float32; `mlp`, a torch module without biases whose
    `hidden_layers + 1` matrices are (out, in). Buffer: `resolutions` (levels,), cells per world unit, a geometric
    series.

    On CUDA, lookup and MLP use half-precision copies of the float32 parameters, made for each call; gradients are
    summed in float32. Set `half_precision` to False to compute in float32. `torch.autocast` changes neither.
    """

    config: TextureShape
    resolutions: torch.Tensor
    # The grid in half precision, and which grid it was: address and version.
    _half_copy: tuple[torch.Tensor, tuple[int, int]] | None = None

    def __init__(  # noqa: PLR0913  # the settings that a model file keeps
        self,
        levels: int = 16,
        table_size: int = 2**20,
        features: int = 2,
        min_resolution: float = 16.0,
        max_resolution: float = 256.0,
        width: int = 64,
        hidden_layers: int = 2,
        sh_degree: int = 3,
        residual: bool = False,
        down_weighting: bool = True,
    ) -> None:
        """Make a field with initial values.

        Args:
            levels: L, number of resolution levels.
            table_size: T, entries per level, a power of two.
            features: F, features per entry: 1, 2, 4 or 8.
            min_resolution: resolution of the coarsest level, cells per world unit.
            max_resolution: resolution of the finest level, cells per world unit.
            width: width of the hidden layers.
            hidden_layers: number of hidden layers.
            sh_degree: SH degree of the output, 0 to 3: (sh_degree + 1)^2 coefficients of three channels.
            residual: add the texture's colours to the surfels' plain colours instead of replacing them; where no photo
                trained the field it is 0, and the plain colours remain.
            down_weighting: down-weight levels whose cells are smaller than a pixel (Delta, paper Eq. 4).

        Raises:
            TypeError, ValueError: the message names the argument.
        """
        super().__init__()
        check_sizes(levels, table_size, features, width, hidden_layers, sh_degree)
        check_number("min_resolution", min_resolution, 1e-30, LARGEST_RESOLUTION)
        check_number("max_resolution", max_resolution, min_resolution, LARGEST_RESOLUTION)
        for name, flag in (("residual", residual), ("down_weighting", down_weighting)):
            if not isinstance(flag, bool):
                raise TypeError(f"{name}: expected True or False, got {flag!r:.60}")
        self.config = {
            "levels": levels,
            "table_size": table_size,
            "features": features,
            "min_resolution": float(min_resolution),
            "max_resolution": float(max_resolution),
            "width": width,
            "hidden_layers": hidden_layers,
            "sh_degree": sh_degree,
            "residual": residual,
            "down_weighting": down_weighting,
        }
        self.sh_degree, self.residual, self.down_weighting = sh_degree, residual, down_weighting
        self.half_precision = True
        self.grid = nn.Parameter(torch.full((levels, table_size, features), GRID_INIT))
        self.register_buffer("resolutions", _geometric_series(min_resolution, max_resolution, levels))
        sizes = [levels * features, *[width] * hidden_layers, 3 * (sh_degree + 1) ** 2]
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise(sizes):
            # torch.nn.Linear's own initialisation, U(+-1/sqrt(fan_in)), is the method's.
            layers += [nn.Linear(fan_in, fan_out, bias=False), nn.ReLU()]
        self.mlp = nn.Sequential(*layers[:-1])

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return self.grid.device

    def up_to(self, sh_degree: int) -> "NeuralTexture":
        """Return a copy whose colours have SH up to a degree at most: others are dropped."""
        degree = min(sh_degree, self.sh_degree)
        shape: TextureShape = {**self.config, "sh_degree": degree}
        other, state = NeuralTexture(**shape), self.state_dict()
        last = list(state)[-1]
        other.load_state_dict(state | {last: state[last][: 3 * (degree + 1) ** 2]})
        other.half_precision = self.half_precision
        return other.to(self.device)

    def stored_per_point(self, sh_degree: int) -> tuple[int, torch.dtype]:
        """Return how many values an evaluation up to an SH degree keeps for each point, at least, and their dtype.

        Features, output and, for gradients, hidden layers. Fused kernels keep features alone, for gradients alone; a
        CPU without gradients evaluates part of the points at a time.
        """
        *hidden, last = self.mlp.parameters()
        features, outputs = self.grid.shape[0] * self.grid.shape[2], 3 * (min(sh_degree, self.sh_degree) + 1) ** 2
        kept = torch.is_grad_enabled()
        matrices = [*hidden, last[:outputs]]
        if self._in_half() and fused_texture.fits(self.grid, matrices, 0):
            return features * kept, torch.float16
        if not kept and self.device.type == "cpu":
            return 0, self.grid.dtype
        dtype = torch.float16 if self._in_half() else self.grid.dtype
        return features + outputs + sum(map(len, hidden)) * kept, dtype

    def _in_half(self) -> bool:
        return self.half_precision and self.grid.is_cuda and self.grid.dtype == torch.float32

    def half_copy(self) -> torch.Tensor:
        """Return a half-precision copy (L, T, F) of the grid, which evaluations use from now on.

        Torch's own changes of the grid are noticed. Whoever writes to the grid past torch, as a kernel or through
        `grid.data` does, writes to the copy too, or calls `drop_half_copy`.
        """
        key = (self.grid.data_ptr(), self.grid._version)
        if self._half_copy is None or self._half_copy[0].device != self.grid.device:
            self._half_copy = (self.grid.detach().half(), key)
        elif self._half_copy[1] != key:
            self._half_copy[0].copy_(self.grid.detach())
            self._half_copy = (self._half_copy[0], key)
        return self._half_copy[0]

    def drop_half_copy(self) -> None:
        """Make each evaluation in half precision convert the grid again."""
        self._half_copy = None

    def half_copy_key(self) -> Hashable | None:
        """Return what changes when `half_copy` would be made anew; None without a copy."""
        return None if self._half_copy is None else (self._half_copy[0].data_ptr(), *self._half_copy[1])

    def forward(self, positions: torch.Tensor, depths: torch.Tensor, focal: float | torch.Tensor) -> torch.Tensor:
        """Return the field's SH coefficients.

        Args:
            positions: (..., 3) points, world frame.
            depths: (...) their z-depths in the camera, world units; 0 marks a point to skip.
            focal: focal length in pixels, a number or a tensor of one element.

        Returns:
            (..., (sh_degree + 1)^2, 3) coefficients, differentiable in positions, depths and the parameters.
        """
        expected = {"depths": (depths, tuple(depths.shape)), "positions": (positions, (*depths.shape, 3))}
        check_tensors(expected, dtype=self.grid.dtype, device=self.grid.device)
        out = self._evaluate(positions.reshape(-1, 3), depths.reshape(-1), focal, self.sh_degree)
        return out.T.reshape(*depths.shape, (self.sh_degree + 1) ** 2, 3)

    def colors(self, hits: Hits, camera: Camera, *, sh_degree: int = 3, clamp: bool = False) -> torch.Tensor:
        """Return the colours (H, W, K, 3) of hits; see `evaluate`. A subclass takes both keywords, too."""
        return self.evaluate(hits.points, hits.depths, hits.directions, camera.focal, sh_degree=sh_degree, clamp=clamp)

    def evaluate(
        self,
        positions: torch.Tensor,
        depths: torch.Tensor,
        directions: torch.Tensor,
        focal: float | torch.Tensor,
        *,
        sh_degree: int = 3,
        clamp: bool = False,
    ) -> torch.Tensor:
        """Return the textured colours (..., K, 3) of hits: 0.5 + SH(direction), or SH(direction) if `residual`.

        Points (..., K, 3) and unit directions (..., 3) are in the world frame; depths (..., K) are 0 in empty slots.
        """
        degree = min(sh_degree, self.sh_degree)
        flat = directions.reshape(-1, 3)
        image = (directions.shape[0], directions.shape[1]) if directions.ndim == 3 else None
        rays = ops.Rays(flat, 0.0 if self.residual else 0.5, clamp, image)
        colors = self._evaluate(positions.reshape(-1, 3), depths.reshape(-1), focal, degree, rays)
        return colors.view(positions.shape)

    def _evaluate(
        self,
        positions: torch.Tensor,
        depths: torch.Tensor,
        focal: float | torch.Tensor,
        degree: int,
        rays: ops.Rays | None = None,
    ) -> torch.Tensor:
        *hidden, last = self.mlp.parameters()
        if not self.down_weighting:
            focal = FOCAL_WITHOUT_DOWN_WEIGHTING
        if isinstance(focal, torch.Tensor):
            focal = focal.detach().to(self.grid).reshape(1)
        else:
            focal = self.grid.new_full((1,), float(focal))
        table = self.half_copy() if self._in_half() and self._half_copy is not None else None
        # The derivative of a slice, even of all, would copy it into zeros.
        weights = [*hidden, last if degree == self.sh_degree else last[: 3 * (degree + 1) ** 2]]
        field = ops.Field(self.grid, weights, self.resolutions.to(self.grid.dtype), self._in_half(), table)
        return ops.texture(ops.Points(positions, depths, focal), field, rays)


def _geometric_series(first: float, last: float, count: int) -> torch.Tensor:
    """Return (count,) float32, computed in float64."""
    # Not by torch: on the device "meta", where files are checked, a logarithm imports its compiler, 1.2 s.
    low, high = math.log(first), math.log(last)
    values = [math.exp(low + (high - low) * i / max(count - 1, 1)) for i in range(count)]
    return torch.tensor(values, dtype=torch.float32)


def check_sizes(levels: int, table_size: int, features: int, width: int, hidden_layers: int, sh_degree: int) -> None:
    """Raise TypeError or ValueError unless each size is an int in its range."""
    check_integer("levels", levels, 1, 64)
    check_integer("table_size", table_size, 1, 2**30)
    check_integer("features", features, 1, 8)
    check_integer("width", width, 1, 4096)
    check_integer("hidden_layers", hidden_layers, 0, 64)
    check_integer("sh_degree", sh_degree, 0, MAX_SH_DEGREE)
    if table_size & (table_size - 1):
        raise ValueError(f"table_size: expected a power of two, got {table_size}")
    if features not in (1, 2, 4, 8):
        raise ValueError(f"features: expected 1, 2, 4 or 8, got {features}")


class DetailLimits(nn.Module):
    """Range of pixel sizes at which training views saw each of N surfels: depth / focal length, in world units.

    Closer than `nearest`, the texture keeps the detail of the nearest training view, as no view constrained finer
    levels. Farther than `farthest`, the texture keeps the detail of the farthest training view, and the surfel is
    blurred by the difference in pixel size, so that surfels smaller than a pixel do not alias.

    Buffers:
        nearest: (N,) depth / focal of the nearest training view in which the surfel's texture was visible; `NEVER` if
            there is none.
        farthest: (N,) the same of the farthest training view; of the surfel's centre if its texture was never visible.

    Raises:
        TypeError, ValueError: a type, shape or device does not fit; the message names the argument.
    """

    nearest: torch.Tensor
    farthest: torch.Tensor

    def __init__(self, nearest: torch.Tensor, farthest: torch.Tensor) -> None:
        super().__init__()
        check_tensors({"nearest": (nearest, ("N",)), "farthest": (farthest, ("N",))})
        self.register_buffer("nearest", nearest)
        self.register_buffer("farthest", farthest)

    def __len__(self) -> int:
        return len(self.nearest)
