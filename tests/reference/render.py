"""Both passes (paper Sec. 4.2): collect the hits, texture the K heaviest, put the image together."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from tests.reference.collect import Shape, View, collect, rays_of
from tests.reference.hashgrid import encode
from tests.reference.sh import evaluate, plain_colors


@dataclass(frozen=True)
class Rendering:
    """The buffers that nexwarp.model.render returns, by the same names."""

    image: torch.Tensor
    plain: torch.Tensor
    textured: torch.Tensor
    ids: torch.Tensor
    depths: torch.Tensor
    weights: torch.Tensor
    alpha: torch.Tensor


@dataclass(frozen=True)
class Texture:
    """The neural field.

    Attributes:
        grid: (L, T, F).
        resolutions: (L,), cells per world unit.
        mlp: weight matrices (out, in), first layer first, ReLU between them.
        residual: colours are added to the plain ones.
        clamp: colours are limited to >= 0.
        shares: (H, W, K), a constant: depth at which each hit is looked up, over the hit's own.
    """

    grid: torch.Tensor
    resolutions: torch.Tensor
    mlp: Sequence[torch.Tensor]
    residual: bool = False
    clamp: bool = False
    shares: torch.Tensor | None = None


def field(texture: Texture, positions: torch.Tensor, depths: torch.Tensor, focal: float) -> torch.Tensor:
    """Spherical harmonics coefficients (n, C, 3) at `positions` (n, 3) seen at z-depth `depths` (n,)."""
    values = encode(positions, depths, texture.grid, texture.resolutions, focal)
    for matrix in texture.mlp[:-1]:
        values = torch.relu(values @ matrix.T)
    return (values @ texture.mlp[-1].T).unflatten(-1, (-1, 3))


def render(
    shape: Shape,
    sh: torch.Tensor,
    texture: Texture | None,
    viewmat: torch.Tensor,
    view: View,
    *,
    max_hits: int = 2,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    sh_degree: int = 3,
) -> Rendering:
    """Render; differentiable with respect to every float tensor, those of `texture` included."""
    means, (height, width) = shape.means, (view.height, view.width)
    rotation = viewmat[:3, :3]
    position = -rotation.T @ viewmat[:3, 3]
    colors = plain_colors(sh, means, position, sh_degree)
    hits = collect(shape, colors, viewmat, view, max_hits)

    filled = hits.ids >= 0
    texels = torch.zeros(height, width, max_hits, 3, dtype=means.dtype, device=means.device)
    if texture is None:
        texels = texels.index_put((filled,), colors[hits.ids[filled]])
    else:
        rays = (rays_of(view, means) @ rotation).reshape(height, width, 1, 3).expand(-1, -1, max_hits, -1)[filled]
        depths = hits.depths[filled]
        looked_up = depths if texture.shares is None else depths * texture.shares[filled]
        coefficients = field(texture, position + looked_up[:, None] * rays, depths, (view.fx * view.fy) ** 0.5)
        directions = rays / rays.norm(dim=-1, keepdim=True)
        values = evaluate(coefficients, directions, sh_degree)
        values = values + (colors[hits.ids[filled]] if texture.residual else 0.5)
        texels = texels.index_put((filled,), values.clamp_min(0) if texture.clamp else values)

    textured = (hits.weights[..., None] * texels).sum(dim=-2)
    behind = (1 - hits.alpha)[..., None] * torch.as_tensor(background, dtype=means.dtype, device=means.device)
    image = hits.plain + textured + behind
    return Rendering(image, hits.plain, textured, hits.ids, hits.depths, hits.weights, hits.alpha)
