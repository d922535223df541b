"""The training losses (paper Sec. 4.3), one function a term, each a scalar tensor.

Images are (H, W, 3) with values in [0, 1] (others are allowed). `weights` (H, W, K) holds the blending
weights W of the K textured hits of each pixel, empty slots 0, and `textured` (H, W, 3) is sum_k W_k T_k.
Terms of images are differentiable once; a `target` gets no gradient, and one that requires it is refused.
"""

import torch

from nexwarp.errors import check_tensors
from nexwarp.kernels.photometric import WEIGHT_EPSILON
from nexwarp.ops.photometric import photometric_terms
from nexwarp.ops.ssim import weighted_dssim
from nexwarp.train.recipe import LossWeights

ALPHA_HITS = 2  # of a pixel's hits, the heaviest ones whose weights the alpha term counts


def photo_losses(
    image: torch.Tensor,
    textured: torch.Tensor,
    weights: torch.Tensor,
    target: torch.Tensor,
    factors: LossWeights,
    *,
    mask: torch.Tensor | None = None,
    empty: torch.Tensor | None = None,
    saturation: float | None = None,
) -> dict[str, torch.Tensor]:
    """Return the terms that compare a rendering with its photo, already multiplied by their factors.

    Args:
        image: (H, W, 3), the rendering with its background.
        textured: (H, W, 3), sum_k W T.
        weights: (H, W, K), W; with K = 0 there is no texture and no alpha term.
        target: (H, W, 3), the photograph.
        factors: of the terms; one whose factor is 0 is neither computed nor returned.
        mask: (H, W) bool, True where the photograph counts: elsewhere no term has a gradient, and those of the image
            and the texture are 0. None is True everywhere.
        empty: (H, W) bool, True where `target` is nothing but background: texture and alpha terms do not count there.
        saturation: a channel of `target` with at least this value equals any brighter one in the L1 and texture terms.
            None compares all values.

    Returns:
        Term ("l1", "dssim", "texture", "alpha") -> weighted scalar tensor.
    """
    _check_masks(image, mask=mask, empty=empty)
    image, textured, weights = _counted(image, textured, weights, target, mask, empty)
    has_slots = weights.shape[-1] > 0
    # With all hits of K = 4, test views were worse than with K = 2.
    all_count = weights.shape[-1] <= ALPHA_HITS
    shares = {
        "l1": 1.0 - factors.dssim,
        "texture": factors.texture * has_slots,
        "alpha": factors.alpha * (has_slots and all_count),
    }
    l1_term, texture_term, alpha_term = photometric_terms(
        image, textured, weights, target, **shares, saturation=saturation
    )
    if not all_count and factors.alpha > 0.0:
        alpha_term = factors.alpha * alpha_loss(weights[..., :ALPHA_HITS].contiguous())
    terms = {
        "l1": l1_term,
        "dssim": weighted_dssim(image, target, factors.dssim) if factors.dssim > 0.0 else None,
        "texture": texture_term,
        "alpha": alpha_term,
    }
    return {name: term for name, term in terms.items() if term is not None}


def _check_masks(image: torch.Tensor, **masks: torch.Tensor | None) -> None:
    """Raise TypeError or ValueError unless each mask that is there is bool, of the image's size and on its device."""
    for name, mask in masks.items():
        if mask is not None:
            check_tensors({name: (mask, image.shape[:2])}, dtype=torch.bool, device=image.device)


def _computed(term: torch.Tensor | None) -> torch.Tensor:
    """Return a term whose factor is not 0, which is therefore computed."""
    assert term is not None
    return term


def _counted(
    image: torch.Tensor,
    textured: torch.Tensor,
    weights: torch.Tensor,
    target: torch.Tensor,
    mask: torch.Tensor | None,
    empty: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Put the photograph, without a gradient, where it does not count; in `empty` pixels into the texture alone."""
    if mask is not None:
        image, textured, weights = _masked(image, textured, weights, target, mask)
    if empty is not None:
        _, textured, weights = _masked(image, textured, weights, target, ~empty)
    return image, textured, weights


def _masked(
    image: torch.Tensor, textured: torch.Tensor, weights: torch.Tensor, target: torch.Tensor, mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Put the photograph, without a gradient, where the mask is False."""
    seen = mask[..., None]
    fixed = weights.detach()
    perfect = target * (fixed.sum(-1, keepdim=True) + WEIGHT_EPSILON)
    return (
        torch.where(seen, image, target),
        torch.where(seen, textured, perfect),
        torch.where(seen, weights, fixed),
    )


def l1(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """L_1: mean absolute difference of two (H, W, 3) images."""
    return _computed(photometric_terms(image, None, None, target, l1=1.0)[0])


def dssim(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """L_D-SSIM = 1 - SSIM of two (H, W, 3) images; differentiable once, and with respect to `image` only.

    SSIM with a Gaussian window of 11 x 11 pixels and sigma 1.5 on each channel, zeros outside the image
    ("same" padding), C1 = 0.01^2 and C2 = 0.03^2, averaged over all pixels and channels.

    Raises:
        ValueError: `target` requires a gradient, which it would not get.
    """
    return weighted_dssim(image, target)


def alpha_loss(weights: torch.Tensor) -> torch.Tensor:
    """L_alpha: mean over the pixels of 1 - sum_k W, for (H, W, K) weights."""
    return _computed(photometric_terms(None, None, weights, None, alpha=1.0)[2])


def depth_loss(
    depths: torch.Tensor, weights: torch.Tensor, places: torch.Tensor, expected: torch.Tensor
) -> torch.Tensor:
    """Mean over points of |expected depth of their pixel's hits / their depth - 1|.

    Args:
        depths: (H, W, K) z-depths of the textured hits, world units.
        weights: (H, W, K), W.
        places: (M,) int64, row * W + column of the points' pixels; see `visible_points`.
        expected: (M,) their z-depths, > 0; what has 0 there is no point, and does not count. 0 without any.
    """
    check_tensors({"depths": (depths, ("H", "W", "K")), "weights": (weights, depths.shape)})
    check_tensors({"places": (places, ("M",))}, dtype=torch.int64, device=depths.device)
    check_tensors({"expected": (expected, places.shape)}, device=depths.device)
    # Not by two indices: on a CPU that adds its gradients, where there are many, by atomics in any order.
    shares, found = (x.flatten(0, 1).index_select(0, places) for x in (weights, depths))
    means = (shares * found).sum(-1) / (shares.sum(-1) + WEIGHT_EPSILON)
    known = expected > 0
    errors = (means / torch.where(known, expected, 1) - 1).abs() * known
    return errors.sum() / known.sum().clamp_min(1)


def opacity_loss(opacities: torch.Tensor) -> torch.Tensor:
    """L_opacity: mean of (N,) opacities."""
    check_tensors({"opacities": (opacities, ("N",))})
    return opacities.mean()


def grid_loss(grid: torch.Tensor, resolutions: torch.Tensor) -> torch.Tensor:
    """L_grid = sum_l sum(H_l^2) / s_l^3. The paper prints H without its square; the square is meant.

    Args:
        grid: (L, T, F), H.
        resolutions: (L,), s in cells per world unit.
    """
    check_tensors({"grid": (grid, ("L", "T", "F")), "resolutions": (resolutions, ("L",))})
    # A norm: its forward pass makes no (L, T, F) temporary, its backward pass only the gradient itself.
    return (torch.linalg.vector_norm(grid, dim=(1, 2)).square() / resolutions**3).sum()
