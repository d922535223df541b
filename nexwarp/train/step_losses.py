"""All losses of a training step: the paper's, ours, and those that the caller of a training adds."""

import dataclasses
from collections.abc import Callable, Mapping

import torch

from nexwarp.render import Rendering
from nexwarp.representation.poses import PoseCorrections
from nexwarp.representation.surfels import Surfels
from nexwarp.representation.texture import NeuralTexture
from nexwarp.train.config import Config
from nexwarp.train.losses import border_loss, depth_loss, training_losses
from nexwarp.train.target import Target

OwnLoss = Callable[[Rendering, Target], torch.Tensor]
# Photos are clipped from here on: what lies beyond it is unknown.
SATURATION = 250 / 255
BUILT_IN = ("l1", "dssim", "texture", "alpha", "opacity", "grid", "empty", "depth", "poses", "border", "l2")


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


def as_taken(out: Rendering, target: Target) -> Rendering:
    """Return a rendering at the exposure of the photo that it is compared with.

    Where the photo is saturated, a brighter image counts as equal to it: it has no error and no gradient there.
    Clipped photos of different exposures would otherwise ask for different colours of the same bright surface.
    """
    if target.exposure is None:
        return out
    image, plain, textured = (x * target.exposure for x in (out.image, out.plain, out.textured))
    clipped = (target.photo >= SATURATION) & (image > target.photo)
    return dataclasses.replace(out, image=torch.where(clipped, target.photo, image), plain=plain, textured=textured)


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
    raw: Rendering | None = None,
    progress: float = 1.0,
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
        poses: corrections of the training poses, which have a prior; None where they are not learned.

    Raises:
        TypeError, ValueError: an own loss returned no scalar; the message names it.
    """
    textured, factors = config.max_hits > 0, config.losses
    losses = training_losses(
        image=out.image.clamp(0, 1) if config.clamp_image else out.image,
        textured=out.textured,
        weights=out.weights,
        target=target.photo,
        opacities=surfels.opacities,
        grid=texture.grid if textured and grid_term else None,
        resolutions=texture.resolutions * cells_unit if textured and grid_term else None,
        loss_weights=factors,
        mask=target.counts,
        empty=target.empty,
        saturation=None if target.exposure is None else SATURATION,
    )
    if factors.texels > 0 or factors.texels_l1 > 0:
        base = out.intermediates.hits.base if raw is None else raw.intermediates.hits.base
        residual = (out if raw is None else raw).textured - base
        losses["texels"] = factors.texels * residual.square().mean() + factors.texels_l1 * residual.abs().mean()
    if factors.l2 > 0 and progress >= factors.l2_from:
        missing = (out.image - target.photo).square()
        losses["l2"] = factors.l2 * (missing if target.counts is None else missing * target.counts[..., None]).mean()
    if target.beyond is not None and factors.border > 0:
        losses["border"] = factors.border * border_loss(out.image, target.photo, target.beyond)
    if target.empty is not None and factors.empty > 0:
        losses["empty"] = factors.empty * (out.alpha * target.empty).mean()
    if target.places is not None and target.expected is not None:
        losses["depth"] = factors.depth * depth_loss(out.depths, out.weights, target.places, target.expected)
    if poses is not None and target.view is not None and factors.poses > 0:
        losses["poses"] = factors.poses * poses.prior(target.view)
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
