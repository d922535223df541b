"""The training losses (paper Sec. 4.3), one function a term, each a scalar tensor.

Images are (H, W, 3) with values in [0, 1] (others are allowed). `weights` (H, W, K) holds the blending
weights W of the K textured hits of each pixel, empty slots 0, and `textured` (H, W, 3) is sum_k W_k T_k.
Terms of images are differentiable once; a `target` gets no gradient, and one that requires it is refused.
"""

import torch

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
    if mask is not None:
        image = torch.where(mask[..., None], image, target)
        textured, weights = _masked(textured, weights, target, mask)
    if empty is not None:
        textured, weights = _masked(textured, weights, target, ~empty)
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
        heaviest = weights[..., :ALPHA_HITS].contiguous()
        _, _, alpha_term = photometric_terms(None, None, heaviest, None, alpha=1.0)
        assert alpha_term is not None
        alpha_term = factors.alpha * alpha_term
    terms = {
        "l1": l1_term,
        "dssim": weighted_dssim(image, target, factors.dssim) if factors.dssim > 0.0 else None,
        "texture": texture_term,
        "alpha": alpha_term,
    }
    return {name: term for name, term in terms.items() if term is not None}


def _masked(
    textured: torch.Tensor, weights: torch.Tensor, target: torch.Tensor, mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Put the photograph, without a gradient, into the texture where the mask is False."""
    seen = mask[..., None]
    fixed = weights.detach()
    perfect = target * (fixed.sum(-1, keepdim=True) + WEIGHT_EPSILON)
    return torch.where(seen, textured, perfect), torch.where(seen, weights, fixed)


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
    # Not by two indices: on a CPU that adds its gradients, where there are many, by atomics in any order.
    shares, reached = (x.flatten(0, 1).index_select(0, places) for x in (weights, depths))
    means = (shares * reached).sum(-1) / (shares.sum(-1) + WEIGHT_EPSILON)
    known = expected > 0
    errors = (means / torch.where(known, expected, 1) - 1).abs() * known
    return errors.sum() / known.sum().clamp_min(1)


def grid_loss(grid: torch.Tensor, resolutions: torch.Tensor) -> torch.Tensor:
    """L_grid = sum_l sum(H_l^2) / s_l^3 of a grid (L, T, F). The paper prints H without its square, which is meant."""
    # A norm: its forward pass makes no (L, T, F) temporary, its backward pass only the gradient itself.
    return (torch.linalg.vector_norm(grid, dim=(1, 2)).square() / resolutions**3).sum()
