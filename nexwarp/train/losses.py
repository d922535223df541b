"""The losses of a training step: those of paper Sec. 4.3, ours, and those that the caller of a training adds.

Images are (H, W, 3), photos with values in [0, 1]; renderings are clamped. `weights` (H, W, K) holds the blending
weights W of the K textured hits of each pixel, empty slots 0, and `textured` (H, W, 3) is sum_k W_k T_k.
Terms of images are differentiable once; a `target` gets no gradient, and one that requires it is refused.
"""

import dataclasses
from collections.abc import Callable, Mapping

import torch

from nexwarp import ops
from nexwarp.kernels.photometric import WEIGHT_EPSILON
from nexwarp.model.render import Rendering
from nexwarp.ops.photometric import depth_term, photometric_terms
from nexwarp.ops.ssim import weighted_dssim
from nexwarp.train.recipe import LossWeights
from nexwarp.train.state import TrainingState
from nexwarp.train.target import Target

OwnLoss = Callable[[Rendering, Target], torch.Tensor]
# Photos are clipped from here on: what lies beyond it is unknown.
SATURATION = 250 / 255
# Factor of the squared pose corrections, which keeps poses near the given ones.
POSE_PRIOR = 0.1
BUILT_IN = ("l1", *LossWeights.__annotations__, "poses", "regulariser")
ALPHA_HITS = 2  # of a pixel's hits, the heaviest ones whose weights the alpha term counts


def photo_losses(out: Rendering, target: Target, factors: LossWeights) -> dict[str, torch.Tensor]:
    """Return the terms "l1", "dssim", "texture" and "alpha" of a rendering, `as_taken`, times their factors.

    A term whose factor is 0 is neither computed nor returned; with K = 0 there is no texture and no alpha term. The
    image is clamped to [0, 1], as by the authors' code. Where the photo does not count, no term has a gradient, and
    those of the image and the texture are 0. Where there is nothing but background, texture and alpha terms do not
    count. In the L1 and texture terms, a channel of a photo with an exposure equals any brighter one from `SATURATION`
    on.
    """
    image, textured, weights, photo = out.image, out.textured, out.weights, target.photo
    if target.counts is not None:
        image = torch.where(target.counts[..., None], image, photo)
        textured, weights = _masked(textured, weights, photo, target.counts)
    if target.empty is not None:
        textured, weights = _masked(textured, weights, photo, ~target.empty)
    saturation = None if target.exposure is None else SATURATION
    has_slots = weights.shape[-1] > 0
    # With all hits of K = 4, test views were worse than with K = 2.
    all_count = weights.shape[-1] <= ALPHA_HITS
    shares = {
        "l1": 1.0 - factors.dssim,
        "texture": factors.texture * has_slots,
        "alpha": factors.alpha * (has_slots and all_count),
    }
    l1_term, texture_term, alpha_term = photometric_terms(
        image, textured, weights, photo, **shares, saturation=saturation
    )
    if not all_count and factors.alpha > 0.0:
        heaviest = weights[..., :ALPHA_HITS].contiguous()
        _, _, alpha_term = photometric_terms(None, None, heaviest, None, alpha=1.0)
        assert alpha_term is not None
        alpha_term = factors.alpha * alpha_term
    terms = {
        "l1": l1_term,
        "dssim": weighted_dssim(image, photo, factors.dssim) if factors.dssim > 0.0 else None,
        "texture": texture_term,
        "alpha": alpha_term,
    }
    return {name: term for name, term in terms.items() if term is not None}


def _masked(
    textured: torch.Tensor, weights: torch.Tensor, photo: torch.Tensor, mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Put the photo, without a gradient, into the texture where the mask is False."""
    seen = mask[..., None]
    fixed = weights.detach()
    perfect = photo * (fixed.sum(-1, keepdim=True) + WEIGHT_EPSILON)
    return torch.where(seen, textured, perfect), torch.where(seen, weights, fixed)


def normal_loss(out: Rendering, counts: torch.Tensor | None = None) -> torch.Tensor:
    """Mean over pixels of sum over hits of weight * (1 - n . N), with N the normal of the median depths' map.

    Pixels whose N is not known do not count, nor those outside of `counts` (H, W) bool.
    """
    stages = out.intermediates
    normals = depth_normals(out.median_depth, stages.viewmat, stages.pinhole)
    errors = out.alpha * normals.detach().any(-1) - (out.blended_normals * normals).sum(-1)
    return (errors if counts is None else errors * counts).mean()


def depth_normals(depths: torch.Tensor, viewmat: torch.Tensor, pinhole: ops.Pinhole) -> torch.Tensor:
    """Return the normals (H, W, 3) of a depth map by central differences; differentiable with respect to both tensors.

    Unit normals, world frame, that face the camera of a viewmat (4, 4); 0 on the border and beside pixels without a
    surface, whose z-depth (H, W), world units, is 0.
    """
    points = ops.unproject(depths[..., None], viewmat, pinhole)[0][:, :, 0]
    # Relative to the depth, so that the unit of the world does not matter.
    scale = torch.where(depths > 0, depths, 1.0).detach()[1:-1, 1:-1, None]
    across = (points[1:-1, 2:] - points[1:-1, :-2]) / scale
    down = (points[2:, 1:-1] - points[:-2, 1:-1]) / scale
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    known = depths > 0
    known = known[1:-1, 2:] & known[1:-1, :-2] & known[2:, 1:-1] & known[:-2, 1:-1]
    return torch.nn.functional.pad(normals.where(known[..., None], 0.0), (0, 0, 1, 1, 1, 1))


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
        image, textured = ops.expose(out.image, out.textured, target.exposure, target.photo, SATURATION)
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

    The rendering is that of the target's camera, `as_taken`. The grid's term is left out: the optimizer computes it.
    Losses of one's own are added as they are.
    """
    texture, factors = state.texture, state.config.losses
    losses = photo_losses(out, target, factors)
    if factors.opacity > 0:
        losses["opacity"] = factors.opacity * state.surfels.opacities.mean()
    if factors.binary > 0:
        opacities = state.surfels.opacities
        losses["binary"] = factors.binary * (opacities * (1 - opacities)).mean()
    if target.empty is not None and factors.empty > 0:
        losses["empty"] = factors.empty * (out.alpha * target.empty).mean()
    if target.places is not None and target.expected is not None:
        points = target.expected, target.places
        losses["depth"] = depth_term(out.depths, out.weights, *points, factor=factors.depth)
    if target.depth is not None:
        losses["depth_maps"] = depth_term(out.depths, out.weights, target.depth, factor=factors.depth_maps)
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
