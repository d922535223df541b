"""What a scene file holds: a model as arrays, as the WebGPU renderer takes it."""

from dataclasses import dataclass

import numpy as np
import torch

from nexwarp.errors import FormatError
from nexwarp.model.exposures import Exposures
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.model.texture import NeuralTexture

LARGEST_SURFELS = 2**24


@dataclass(frozen=True)
class SceneData:
    """A scene, activated: N surfels, float32, and what a rendering needs beside them."""

    means: np.ndarray  # (N, 3) world units
    quats: np.ndarray  # (N, 4) unit, wxyz, surfel to world
    scales: np.ndarray  # (N, 2) world units
    opacities: np.ndarray  # (N,)
    gammas: np.ndarray  # (N, 2)
    limits: np.ndarray | None  # (N, 2) detail limits, nearest and farthest; None limits nothing
    sh: np.ndarray  # (N, C, 3) coefficients of the plain colour
    options: RenderOptions
    texture: NeuralTexture | None
    # Of V photos, see `Exposures`: "poses" (V, 9), position, direction and coefficients of each; "mean" (3,), "lengths"
    # (2,), "falloff" (3,); "lowest" and "highest" (3,), the extreme log gains.
    exposures: dict[str, np.ndarray] | None

    @classmethod
    @torch.no_grad()
    def of(cls, model: Model) -> "SceneData":
        """Take the values of a model; FormatError: it has too many surfels for a file, or blends them by distance."""
        surfels, options = model.surfels, model.options
        if len(surfels) > LARGEST_SURFELS:
            raise FormatError(f"model: expected at most {LARGEST_SURFELS:,} surfels, got {len(surfels):,}")
        if options.order != "depth":
            raise FormatError(f"order: expected depth, which the web page draws, got {options.order}")
        texture = model.texture if options.max_hits else None
        if not isinstance(texture, NeuralTexture | None):
            name = type(texture).__name__
            raise FormatError(f"texture: expected a nexwarp.NeuralTexture, which the web page draws, got {name}")
        limits = model.detail_limits if options.detail_limits else None
        return cls(
            **{name: array_of(x) for name, x in surfels.activated()._asdict().items()},
            limits=None if limits is None else array_of(torch.stack([limits.nearest, limits.farthest], 1)),
            sh=array_of(surfels.sh),
            options=options,
            texture=texture,
            exposures=_exposures(model.exposures) if options.exposure == "photos" else None,
        )

    def __len__(self) -> int:
        return len(self.means)


def _exposures(exposures: Exposures | None) -> dict[str, np.ndarray] | None:
    if exposures is None:
        return None
    values = {name: array_of(x) for name, x in exposures.named_buffers()}
    poses = np.concatenate([values[name] for name in ("positions", "directions", "coefficients")], axis=1)
    gains = values["log_gains"]
    kept = {name: values[name] for name in ("mean", "lengths", "falloff")}
    return {"poses": poses, **kept, "lowest": gains.min(0), "highest": gains.max(0)}


def array_of(tensor: torch.Tensor) -> np.ndarray:
    """Return a tensor's values as float32."""
    return np.ascontiguousarray(tensor.detach().float().cpu().numpy())
