"""Learning rates and schedules over a run."""

import dataclasses

import torch

from nexwarp.representation.surfels import Surfels
from nexwarp.representation.texture import NeuralTexture
from nexwarp.train.config import Config
from nexwarp.train.densify import PARAMETERS, DensifyConfig


def make_optimizer(surfels: Surfels, texture: NeuralTexture, config: Config, scale: float) -> torch.optim.Adam:
    """Make Adam with the learning rates of a config; `scale` is the scene's, which the means' rates follow."""
    rates = config.rates
    ends: dict[str, tuple[float, float]] = {
        "means": (rates.means[0] * scale, rates.means[1] * scale),
        "raw_quats": (rates.quats,) * 2,
        "log_scales": (rates.scales,) * 2,
        "logit_opacities": (rates.opacities,) * 2,
        "raw_gammas": (rates.gammas,) * 2,
        "sh0": (rates.sh0,) * 2,
        "shN": (rates.shN,) * 2,
    }
    groups = [{"params": [getattr(surfels, name)], "ends": ends[name], "lr": ends[name][0]} for name in PARAMETERS]
    if config.max_hits:
        groups.append({"params": [texture.grid], "ends": rates.grid, "lr": rates.grid[0]})
        groups.append({"params": list(texture.mlp.parameters()), "ends": rates.mlp, "lr": rates.mlp[0]})
    on_gpu = surfels.means.is_cuda
    if on_gpu:  # where a CUDA graph finds them
        groups = [group | {"lr": torch.tensor(group["lr"], device=surfels.means.device)} for group in groups]
    return torch.optim.Adam(groups, eps=1e-15, fused=True, capturable=on_gpu)


def densify_schedule(config: Config) -> DensifyConfig:
    """Stretch the schedule to the run's length; rounds of short runs stay at least ten iterations apart."""
    d = config.densify
    every = max(config.scaled(d.every), min(d.every, 10))
    return dataclasses.replace(d, start=config.scaled(d.start), stop=config.scaled(d.stop), every=every)
