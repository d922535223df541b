"""All losses of a training step: the paper's, ours, and those that the caller of a training adds."""

import dataclasses
from collections.abc import Callable, Mapping

import torch

from nexwarp.model.render import Rendering
from nexwarp.model.texture import NeuralTexture
from nexwarp.ops import expose
from nexwarp.train.adam import FusedAdam
from nexwarp.train.losses import depth_loss, grid_loss, photo_losses
from nexwarp.train.state import TrainingState
from nexwarp.train.surface_losses import normal_loss
from nexwarp.train.target import Target

OwnLoss = Callable[[Rendering, Target], torch.Tensor]
# Photos are clipped from here on: what lies beyond it is unknown.
SATURATION = 250 / 255
# Factor of the squared pose corrections, which keeps poses near the given ones.
POSE_PRIOR = 0.1
BUILT_IN = ("l1", "dssim", "texture", "alpha", "opacity", "grid", "empty", "depth", "normals", "poses", "regulariser")


def check_own_losses(losses: Mapping[str, OwnLoss] | None) -> dict[str, OwnLoss]:
    """Return own losses as a dictionary; ValueError for a name of ours, TypeError for what is no function."""
    for name, loss in (losses or {}).items():
        if name in BUILT_IN:
            raise ValueError(f"losses: expected names other than {', '.join(BUILT_IN)}, got {name!r}")
        if not callable(loss):
            raise TypeError(f"losses[{name!r}]: expected a function, got {type(loss).__name__}")
    return dict(losses or {})


def as_taken(out: Rendering, target: Target, *, plain: bool = True) -> Rendering:
    """Return a rendering at the exposure of the photo that it is compared with; `plain` says whether `out.plain`, too.

    Where the photo is saturated, a brighter image counts as equal to it: it has no error and no gradient there.
    Clipped photos of different exposures would otherwise ask for different colours of the same bright surface.
    """
    if target.exposure is None:
        return out
    if out.image.is_cuda:
        image, textured = expose(out.image, out.textured, target.exposure, target.photo, SATURATION)
    else:  # where vector instructions make torch's passes faster than one kernel
        image, textured = out.image * target.exposure, out.textured * target.exposure
        brighter = (target.photo >= SATURATION) & (image > target.photo)
        image = torch.where(brighter, target.photo, image)
    colors = out.plain * target.exposure if plain else out.plain
    return dataclasses.replace(out, image=image, plain=colors, textured=textured)


def step_losses(
    out: Rendering, target: Target, state: TrainingState, own: Mapping[str, OwnLoss] | None = None
) -> dict[str, torch.Tensor]:
    """Return the terms of a step's loss by name, multiplied by their factors: their sum is the loss.

    The rendering is that of the target's camera, `as_taken`. The grid's term is left out where the optimizer, a
    `FusedAdam`, computes it. Losses of one's own are added as they are.
    """
    config, texture, factors = state.config, state.texture, state.config.losses
    losses = photo_losses(
        out.image.clamp(0, 1),  # as the authors' code does
        out.textured,
        out.weights,
        target.photo,
        factors,
        mask=target.counts,
        empty=target.empty,
        saturation=None if target.exposure is None else SATURATION,
    )
    if factors.opacity > 0:
        losses["opacity"] = factors.opacity * state.surfels.opacities.mean()
    regular = config.max_hits > 0 and factors.grid > 0 and not isinstance(state.optimizer, FusedAdam)
    if regular and isinstance(texture, NeuralTexture):
        losses["grid"] = factors.grid * grid_loss(texture.grid, texture.resolutions * state.cells_unit)
    if target.empty is not None and factors.empty > 0:
        losses["empty"] = factors.empty * (out.alpha * target.empty).mean()
    if target.places is not None and target.expected is not None:
        losses["depth"] = factors.depth * depth_loss(out.depths, out.weights, target.places, target.expected)
    if target.normals > 0:
        losses["normals"] = target.normals * normal_loss(out, target.counts)
    if state.poses is not None and target.view is not None:
        losses["poses"] = POSE_PRIOR * state.poses.prior(target.view)
    if (regulariser := texture.regulariser()) is not None:
        losses["regulariser"] = _scalar("texture.regulariser", regulariser, out.image.device)
    for name, loss in (own or {}).items():
        losses[name] = _scalar(f"losses[{name!r}]", loss(out, target), out.image.device)
    return losses


def _scalar(name: str, value: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Return the value of an own loss; TypeError or ValueError where it is no floating scalar on the device."""
    if not isinstance(value, torch.Tensor) or not value.is_floating_point():
        kind = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
        raise TypeError(f"{name}: expected a floating scalar tensor, got {kind}")
    if value.shape != () or value.device != device:
        got = f"shape {tuple(value.shape)} on {value.device}"
        raise ValueError(f"{name}: expected a scalar tensor on {device}, got {got}")
    return value
