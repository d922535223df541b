"""Parts of a scene: boxes, spheres, and the model of some of the surfels."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch

from nexwarp.model.model import Model
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import DetailLimits

REGIONS = {"box": 6, "sphere": 4}  # numbers: lowest and highest corner; centre and radius; world units


def inside(region: str, numbers: Sequence[float], points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return (N,) bool: which of (N, 3) points lie in a region, one of `REGIONS`, with its numbers."""
    if region == "sphere":
        return np.asarray(np.square(points - numbers[:3]).sum(axis=1) <= numbers[3] ** 2)
    return np.asarray(((points >= numbers[:3]) & (points <= numbers[3:])).all(axis=1))


def select(model: Model, kept: torch.Tensor) -> Model:
    """Return the model of those surfels for which `kept` (N,) is true; the rest of the model is shared."""
    surfels = Surfels({name: value[kept] for name, value in model.surfels.state_dict().items()})
    limits = model.detail_limits
    if limits is not None:
        limits = DetailLimits(limits.nearest[kept], limits.farthest[kept])
    return Model(surfels, model.texture, model.exposures, limits, model.options, model.meta)
