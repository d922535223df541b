"""The texture of a model that was merged from blocks of space: a neural texture for each block."""

from collections.abc import Hashable, Mapping, Sequence

import torch
from torch import nn

from nexwarp.errors import check_tensors
from nexwarp.model.texture import NeuralTexture, TextureShape

MOST_PARTS = 1024  # in a file


class MergedTexture(NeuralTexture):
    """Textures of cells of space: a point has the texture of the cell that it is in.

    Each point is evaluated by one texture; the others skip it.

    Attributes:
        parts: the M textures; they agree in `sh_degree`, `residual` and `down_weighting`.
        cells: (M, 2, 3) lowest and highest corners of the cells, world frame. The lowest corner belongs to a cell, the
            highest does not. A point in no cell has the texture of the first one.
    """

    cells: torch.Tensor

    def __init__(self, parts: Sequence[NeuralTexture], cells: torch.Tensor) -> None:
        """Take textures and their cells.

        Raises:
            TypeError, ValueError: the message names the argument.
        """
        nn.Module.__init__(self)
        if not parts:
            raise ValueError("parts: expected at least one texture, got none")
        for index, part in enumerate(parts):
            if not isinstance(part, NeuralTexture) or isinstance(part, MergedTexture):
                raise TypeError(f"parts[{index}]: expected a NeuralTexture, got {type(part).__name__}")
            for name in ("sh_degree", "residual", "down_weighting"):
                if getattr(part, name) != getattr(parts[0], name):
                    raise ValueError(f"parts[{index}]: expected the {name} of the first one, got {getattr(part, name)}")
        check_tensors({"cells": (cells, (len(parts), 2, 3))}, dtype=torch.float32)
        self.parts = nn.ModuleList(parts)
        self.register_buffer("cells", cells)
        self.sh_degree, self.residual = parts[0].sh_degree, parts[0].residual
        self.down_weighting = parts[0].down_weighting
        self._half_copy = None  # each part has its own

    @property
    def config(self) -> dict[str, list[TextureShape]]:  # type: ignore[override]
        """Arguments of the parts, as a model file keeps them."""
        return {"parts": [part.config for part in self.textures]}

    @property
    def textures(self) -> list[NeuralTexture]:
        """The parts."""
        return [part for part in self.parts if isinstance(part, NeuralTexture)]

    @property
    def grid(self) -> nn.Parameter:  # type: ignore[override]
        """Grid of the first part, whose dtype and device are those of all."""
        return self.textures[0].grid

    @property
    def half_precision(self) -> bool:
        """Whether all parts compute in half precision on CUDA."""
        return all(part.half_precision for part in self.textures)

    @half_precision.setter
    def half_precision(self, value: bool) -> None:
        for part in self.textures:
            part.half_precision = value

    def drop_half_copy(self) -> None:
        """Drop the half-precision copies of all parts."""
        for part in self.textures:
            part.drop_half_copy()

    def half_copy_key(self) -> Hashable | None:
        """Return a key that changes where a copy does; None where no part has one."""
        keys = tuple(part.half_copy_key() for part in self.textures)
        return keys if any(keys) else None

    def stored_per_point(self, sh_degree: int) -> tuple[int, torch.dtype]:
        """Return how many values an evaluation keeps for each point, and their dtype; see `NeuralTexture`."""
        stored = [part.stored_per_point(sh_degree) for part in self.textures]
        return sum(values for values, _ in stored), stored[0][1]

    def owners(self, positions: torch.Tensor) -> torch.Tensor:
        """Return the cells (n,) int64 that points (n, 3) are in."""
        found = torch.zeros(len(positions), dtype=torch.int64, device=positions.device)
        for index, (low, high) in enumerate(self.cells):
            inside = ((positions >= low) & (positions < high)).all(dim=1)
            found = torch.where(inside, index, found)
        return found

    def _evaluate(
        self,
        positions: torch.Tensor,
        depths: torch.Tensor,
        focal: float | torch.Tensor,
        degree: int,
        directions: torch.Tensor | None = None,
        clamp: bool = False,
        image: tuple[int, int] | None = None,
    ) -> torch.Tensor:
        owners = self.owners(positions.detach())
        total: torch.Tensor | None = None
        for index, part in enumerate(self.textures):
            mine = owners == index
            skipped = torch.where(mine, depths, 0.0)
            found = part._evaluate(positions, skipped, focal, degree, directions, clamp, image)
            found = torch.where(mine[None] if directions is None else mine[:, None], found, 0.0)
            total = found if total is None else total + found
        assert total is not None
        return total


def make_texture(config: Mapping[str, object]) -> NeuralTexture:
    """Return a texture of the arguments that a model file keeps, with initial values.

    Raises:
        TypeError, ValueError: the arguments do not fit.
    """
    parts = config.get("parts")
    if parts is None:
        known = {name: value for name, value in config.items() if name in TextureShape.__annotations__}
        return NeuralTexture(**known)  # type: ignore[arg-type]  # the constructor checks the types
    if not isinstance(parts, list) or not 1 <= len(parts) <= MOST_PARTS or not all(isinstance(x, dict) for x in parts):
        raise ValueError(f"texture: expected 1 to {MOST_PARTS} parts, got {parts!r:.60}")
    return MergedTexture([make_texture({**part, "parts": None}) for part in parts], torch.zeros(len(parts), 2, 3))
