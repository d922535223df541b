"""All losses of a training step: the paper's, ours, and those that the caller of a training adds."""

import dataclasses
from collections.abc import Callable, Mapping

import torch

from nexwarp.model.poses import PoseCorrections
from nexwarp.model.render import Rendering
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import NeuralTexture
from nexwarp.ops import expose
from nexwarp.train.losses import depth_loss, training_losses
from nexwarp.train.recipe import Config
from nexwarp.train.surface_losses import normal_loss
from nexwarp.train.target import Target

OwnLoss = Callable[[Rendering, Target], torch.Tensor]
# Photos are clipped from here on: what lies beyond it is unknown.
SATURATION = 250 / 255
# Factor of the squared pose corrections, which keeps poses near the given ones.
POSE_PRIOR = 0.1
BUILT_IN = ("l1", "dssim", "texture", "alpha", "opacity", "grid", "empty", "depth", "normals", "poses")


def check_own_losses(losses: Mapping[str, OwnLoss] | None) -> dict[str, OwnLoss]:
    """Return own losses as a dictionary.

    Raises:
        TypeError: a name is no text, or a loss is no function.
        ValueError: a name is that of a built-in loss, or empty.
    """
    for name, loss in (losses or {}).items():
        if not isinstance(name, str):
            raise TypeError(f"losses: expected names that are text, got {name!r:.60}")
        if name in BUILT_IN or not name:
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
    out: Rendering,
    target: Target,
    surfels: Surfels,
    texture: NeuralTexture,
    config: Config,
    *,
    cells_unit: float = 1.0,
    own: Mapping[str, OwnLoss] | None = None,
    grid_term: bool = True,
    poses: PoseCorrections | None = None,
) -> dict[str, torch.Tensor]:
    """Return the terms of a step's loss by name, multiplied by their factors: their sum is the loss.

    Args:
        out: the rendering of the target's camera, `as_taken`.
        target: what it is compared with.
        surfels: whose opacities the sparsity term takes.
        texture: whose grid the regularisation takes.
        config: settings.
        cells_unit: world units in which the grid's loss counts its cells.
        own: losses of one's own, added as they are.
        grid_term: whether to compute the grid's term, which `FusedAdam` does itself.
        poses: corrections, which have a prior; None where poses stay as given.

    Raises:
        TypeError, ValueError: an own loss returned no scalar; the message names it.
    """
    textured, factors = config.max_hits > 0, config.losses
    grid_term = grid_term and textured and factors.grid > 0
    losses = training_losses(
        image=out.image.clamp(0, 1),  # as the authors' code does
        textured=out.textured,
        weights=out.weights,
        target=target.photo,
        opacities=surfels.opacities,
        grid=texture.grid if grid_term else None,
        resolutions=texture.resolutions * cells_unit if grid_term else None,
        loss_weights=factors,
        mask=target.counts,
        empty=target.empty,
        saturation=None if target.exposure is None else SATURATION,
    )
    if target.empty is not None and factors.empty > 0:
        losses["empty"] = factors.empty * (out.alpha * target.empty).mean()
    if target.places is not None and target.expected is not None:
        losses["depth"] = factors.depth * depth_loss(out.depths, out.weights, target.places, target.expected)
    if target.normals > 0:
        losses["normals"] = target.normals * normal_loss(out, target.counts)
    if poses is not None and target.view is not None:
        losses["poses"] = POSE_PRIOR * poses.prior(target.view)
    for name, loss in (own or {}).items():
        losses[name] = _scalar(name, loss(out, target), out.image.device)
    return losses


def _scalar(name: str, value: torch.Tensor, device: torch.device) -> torch.Tensor:
    if not isinstance(value, torch.Tensor) or not value.is_floating_point():
        kind = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
        raise TypeError(f"losses[{name!r}]: expected a floating scalar tensor, got {kind}")
    if value.shape != ():
        raise ValueError(f"losses[{name!r}]: expected a scalar tensor, got shape {tuple(value.shape)}")
    if value.device != device:
        raise ValueError(f"losses[{name!r}]: expected a tensor on {device}, got one on {value.device}")
    return value
