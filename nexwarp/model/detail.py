"""Level of detail: the first surfels of an ordered model and the coarse levels of its texture are a coarser model."""

import math

import torch

from nexwarp.errors import check_range
from nexwarp.model.detail_limits import DetailLimits
from nexwarp.model.model import Model
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import NeuralTexture, TextureShape

ORDERED = "ordered"  # entry of `Model.meta`: surfels are ordered by their share of the pictures, largest first
LEAST = 1e-4  # of a detail
LOG_SHARE = 6.5  # halvings of the surfels, from a half on, that would cost all levels; docs/detail.md has the figures


def check_detail(name: str, detail: float) -> None:
    """Raise TypeError or ValueError unless a detail is a number from 0.0001 to 1."""
    if isinstance(detail, bool) or not isinstance(detail, (int, float)):
        raise TypeError(f"{name}: expected a number, got {type(detail).__name__}")
    check_range(name, detail, LEAST, 1.0)


def surfel_count(detail: float, count: int) -> int:
    """Return how many of `count` surfels a detail has."""
    return min(math.ceil(detail * count), count)


def texture_levels(detail: float, levels: int) -> int:
    """Return how many levels of a texture a detail has, from the coarsest up: all from a half of the surfels on."""
    return max(1, math.ceil(levels * min(1.0, 1.0 + math.log2(2.0 * detail) / LOG_SHARE)))


def coarse_texture(texture: NeuralTexture, levels: int) -> NeuralTexture:
    """Return a texture of the first levels alone: what the MLP makes of zeros in the features of all finer ones."""
    finest = float(texture.resolutions[levels - 1])
    shape: TextureShape = {**texture.config, "levels": levels, "max_resolution": finest}
    coarse = NeuralTexture(**shape).to(texture.device)
    coarse.half_precision = texture.half_precision
    columns = levels * shape["features"]
    state = texture.state_dict()
    state |= {"grid": state["grid"][:levels], "resolutions": state["resolutions"][:levels]}
    state["mlp.0.weight"] = state["mlp.0.weight"][:, :columns]
    coarse.load_state_dict(state)
    return coarse


def pick_surfels(model: Model, rows: torch.Tensor) -> Model:
    """Return a model with the given rows (M,) of the surfels and their detail limits; all else is shared."""
    raw = {name: x.detach()[rows].contiguous() for name, x in model.surfels.state_dict().items()}
    limits = model.detail_limits
    if limits is not None:
        limits = DetailLimits(limits.nearest[rows].contiguous(), limits.farthest[rows].contiguous())
    return Model(Surfels(raw), model.texture, model.exposures, limits, model.options, model.meta)


def at_detail(model: Model, detail: float) -> Model:
    """Return a coarser model with parameters of its own; see `Model.at_detail`."""
    check_detail("detail", detail)
    if model.meta.get(ORDERED) is not True:
        raise ValueError(
            "detail: expected a model with surfels in the order of their share of the pictures, as trainings since "
            "nexwarp 0.3 write it; nexwarp render --detail orders the models of older runs itself"
        )
    rows = torch.arange(surfel_count(detail, len(model.surfels)), device=model.device)
    coarse = pick_surfels(model, rows)
    if model.texture is not None:
        levels = len(model.texture.resolutions)
        coarse.texture = coarse_texture(model.texture, texture_levels(detail, levels))
    return coarse
