"""The content of a scene file: a model as arrays, as the WebGPU renderer takes it."""

from dataclasses import dataclass

import numpy as np
import torch

from nexwarp.errors import FormatError
from nexwarp.model.exposures import Exposures
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.model.texture import TextureShape

LARGEST_SURFELS = 2**24


@dataclass(frozen=True)
class TextureData:
    """A neural texture.

    Attributes:
        shape: arguments of `nexwarp.NeuralTexture`.
        resolutions: (L,) float32, cells per world unit.
        grid: (L, T, F) float16.
        matrices: the MLP's matrices (out, in), float32.
    """

    shape: TextureShape
    resolutions: np.ndarray
    grid: np.ndarray
    matrices: list[np.ndarray]


@dataclass(frozen=True)
class ExposureData:
    """Exposures, see `nexwarp.model.exposures.Exposures`.

    Attributes:
        poses: (V, 9) float32: position, direction and coefficients of each photo.
        mean: (3,) mean log gain.
        lengths: (2,) see `Exposures`.
        falloff: (3,) see `Exposures`.
        lowest: (3,) smallest log gains.
        highest: (3,) largest log gains.
    """

    poses: np.ndarray
    mean: np.ndarray
    lengths: np.ndarray
    falloff: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray

    @classmethod
    def of(cls, exposures: Exposures) -> "ExposureData":
        """Take the buffers of exposures."""
        x = {name: value.detach().cpu().float().numpy() for name, value in exposures.tensors().items()}
        poses = np.concatenate([x["positions"], x["directions"], x["coefficients"]], axis=1)
        lowest, highest = x["log_gains"].min(0), x["log_gains"].max(0)
        return cls(poses, x["mean"], x["lengths"], x["falloff"], lowest, highest)

    def gains(self, viewmat: np.ndarray) -> np.ndarray:
        """Return the gains (3,) of a camera, as `Exposures.gains` does."""
        position, direction = -viewmat[:3, :3].T @ viewmat[:3, 3], viewmat[2, :3]
        away = ((self.poses[:, :3] - position) ** 2).sum(1)
        away += ((self.lengths[0] * (self.poses[:, 3:6] - direction)) ** 2).sum(1)
        r = np.sqrt(3 * away) / self.lengths[1]
        log_gains = self.mean + ((1 + r) * np.exp(-r)) @ self.poses[:, 6:]
        return np.exp(np.clip(log_gains, self.lowest, self.highest))


@dataclass(frozen=True)
class SceneData:
    """A scene, activated: N surfels, float32, and what a rendering needs beside them.

    Attributes:
        means: (N, 3) world units.
        quats: (N, 4) unit, wxyz, surfel to world.
        scales: (N, 2) world units.
        opacities: (N,).
        gammas: (N, 2).
        limits: (N, 2) detail limits, nearest and farthest; None limits nothing.
        sh: (N, C, 3) coefficients of the plain colour.
        options: options of the rendering.
        texture: the neural texture; None for a scene without.
        exposures: the exposures; None for a scene without.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    gammas: np.ndarray
    limits: np.ndarray | None
    sh: np.ndarray
    options: RenderOptions
    texture: TextureData | None
    exposures: ExposureData | None

    @classmethod
    @torch.no_grad()
    def of(cls, model: Model) -> "SceneData":
        """Take the values of a model; the texture's grid becomes half precision, as in model files.

        Raises:
            ValueError: the model has more surfels than a scene file may have, or blends them by distance.
        """
        surfels = model.surfels
        if len(surfels) > LARGEST_SURFELS:
            raise FormatError(f"model: expected at most {LARGEST_SURFELS:,} surfels, got {len(surfels):,}")
        if model.options.order != "depth":
            raise FormatError(f"order: expected depth, which the web page draws, got {model.options.order}")
        active = surfels.activated()
        limits = None
        if model.detail_limits is not None and model.options.detail_limits:
            limits = _array(torch.stack([model.detail_limits.nearest, model.detail_limits.farthest], 1))
        texture = None
        if model.texture is not None and model.options.max_hits:
            texture = TextureData(
                model.texture.config,
                _array(model.texture.resolutions),
                _array(model.texture.grid.detach()).astype(np.float16),
                [_array(x.detach()) for x in model.texture.mlp.parameters()],
            )
        exposures = None
        if model.exposures is not None and model.options.exposure == "photos":
            exposures = ExposureData.of(model.exposures)
        arrays = [_array(x) for x in (active.means, active.quats, active.scales, active.opacities, active.gammas)]
        means, quats, scales, opacities, gammas = arrays
        colors, options = _array(surfels.sh), model.options
        return cls(means, quats, scales, opacities, gammas, limits, colors, options, texture, exposures)

    def __len__(self) -> int:
        return len(self.means)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().float().cpu().numpy())
