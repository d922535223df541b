"""Learning rates and schedules over a run, and the optimizer whose rates follow them."""

import math
from collections.abc import Callable
from typing import cast

import torch

from nexwarp.model.options import RenderOptions
from nexwarp.model.poses import PoseCorrections
from nexwarp.model.surfels import PARAMETERS, Surfels
from nexwarp.model.texture import NeuralTexture, Texture
from nexwarp.ops.tiles import Order
from nexwarp.train.adam import FusedAdam, ParameterGroup, grid_factors
from nexwarp.train.recipe import REFERENCE_ITERATIONS, Config

EPSILON = 1e-15
# First and last learning rates of pose corrections, radians and scene scales, in a run of 30,000 steps.
POSE_RATES = (2e-4, 2e-6)
OptimizerMaker = Callable[[list[ParameterGroup]], torch.optim.Optimizer]


def make_optimizer(
    surfels: Surfels,
    texture: Texture,
    config: Config,
    scale: float,
    make: OptimizerMaker | None = None,
    cells_unit: float = 1.0,
    poses: PoseCorrections | None = None,
) -> torch.optim.Optimizer:
    """Make the optimizer; each of its groups gets the ends of its schedule as `group["ends"]`.

    Args:
        surfels: to train.
        texture: to train, unless K is 0.
        config: whose learning rates count.
        scale: of the scene, world units, which the means' rates follow.
        make: makes an optimizer of one's own; None makes a `FusedAdam`, which regularises the grid.
        cells_unit: world units in which the grid's loss counts its cells.
        poses: pose corrections to train; None trains none.
    """
    ends = rate_ends(config, scale)
    parts = {name: [getattr(surfels, name)] for name in PARAMETERS}
    rest = {name: x for name, x in texture.named_parameters() if x.requires_grad}
    if isinstance(texture, NeuralTexture):
        if config.max_hits:
            parts |= {"grid": [texture.grid], "mlp": list(texture.mlp.parameters())}
        rest = {name: x for name, x in rest.items() if name != "grid" and not name.startswith("mlp.")}
    if rest:
        parts["texture"], ends["texture"] = list(rest.values()), texture.rates
    if poses is not None:
        parts["poses"] = [poses.corrections]
    groups: list[ParameterGroup] = [{"params": x, "name": name, "lr": ends[name][0]} for name, x in parts.items()]
    optimizer = _make_adam(groups, surfels.device) if make is None else make(groups)
    if not isinstance(optimizer, torch.optim.Optimizer):
        raise TypeError(f"optimizer: expected it to return a torch.optim.Optimizer, got {type(optimizer).__name__}")
    expected = {name: {id(x) for x in values} for name, values in parts.items()}
    if {g.get("name"): {id(x) for x in g["params"]} for g in optimizer.param_groups} != expected:
        names = ", ".join(str(group.get("name")) for group in optimizer.param_groups)
        raise ValueError(f"optimizer: expected it to keep the parameter groups {', '.join(parts)}, got {names}")
    for group in optimizer.param_groups:
        group["ends"] = _scaled_ends(ends[group["name"]], float(group["lr"]))
    if isinstance(optimizer, FusedAdam) and isinstance(texture, NeuralTexture) and config.max_hits:
        optimizer.regularise(texture, grid_factors(texture, config.losses, cells_unit))
    return optimizer


def _make_adam(groups: list[ParameterGroup], device: torch.device) -> FusedAdam:
    """Make Adam with the paper's epsilon; on CUDA, its rates are tensors, which a CUDA graph reads."""
    if device.type == "cuda":
        groups = [group | {"lr": torch.tensor(group["lr"], device=device)} for group in groups]
    return FusedAdam(groups, eps=EPSILON)


def _scaled_ends(ends: tuple[float, float], rate: float) -> tuple[float, float]:
    """Return the first and last rate of a group whose first rate may have been changed; their ratio is kept."""
    if math.isclose(rate, ends[0], rel_tol=1e-6):  # a rate on the GPU is rounded to float32
        return ends
    return (rate, rate) if ends[0] == 0 else (rate, rate * ends[1] / ends[0])


def rate_ends(config: Config, scale: float) -> dict[str, tuple[float, float]]:
    """Return the learning rates of a run's first and last step by group; the means' follow the scene's scale."""
    rates = config.rates
    # Adam moves a pose by at most its rate a step: a short run needs longer steps.
    longer = math.sqrt(REFERENCE_ITERATIONS / config.iterations)
    return {
        "means": (rates.means[0] * scale, rates.means[1] * scale),
        "raw_quats": (rates.quats,) * 2,
        "log_scales": (rates.scales,) * 2,
        "logit_opacities": (rates.opacities,) * 2,
        "raw_gammas": (rates.gammas,) * 2,
        "sh0": (rates.sh0,) * 2,
        "shN": (rates.shN,) * 2,
        "grid": rates.grid,
        "mlp": rates.mlp,
        "poses": (POSE_RATES[0] * longer, POSE_RATES[1] * longer),
    }


def set_rates(optimizer: torch.optim.Optimizer, iteration: int, iterations: int, factor: float) -> None:
    """Set the rates of a step, counted from 1: log-linear between the ends of each group, times a factor."""
    progress = (iteration - 1) / max(iterations - 1, 1)
    for group in optimizer.param_groups:
        first, last = group["ends"]
        rate = math.exp((1 - progress) * math.log(first) + progress * math.log(last)) if first else 0.0
        rate *= factor
        if isinstance(group["lr"], torch.Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate


def options_at(
    config: Config, iteration: int, background: tuple[float, float, float], texture_degree: int
) -> RenderOptions:
    """Return how the scene is rendered after an iteration: more hits and SH degrees are unlocked on the way."""
    unlocked = iteration // config.scaled(config.sh_every)
    return RenderOptions(
        max_hits=config.hits_at(iteration),
        background=background,
        sh_degree=min(max(config.sh_degree, texture_degree), unlocked),
        order=cast(Order, config.order),
    )
