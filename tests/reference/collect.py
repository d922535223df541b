"""The collection pass (paper Sec. 4.2): blend the plain colours, keep the K heaviest hits of each pixel."""

from dataclasses import dataclass
from typing import NamedTuple

import torch

ALPHA_MAX = 0.99
ALPHA_MIN = 1 / 255
TRANSMITTANCE_MIN = 1e-4


class Shape(NamedTuple):
    """Surfels: (N, 3) in the world, (N, 4) wxyz surfel to world, (N, 2), (N,), (N, 2)."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    gammas: torch.Tensor


class View(NamedTuple):
    """Intrinsics and size in pixels; hits count beyond the z-depth `near`, in order of their centres' `order`."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float
    order: str = "depth"  # or "distance"


@dataclass(frozen=True)
class Hits:
    """What the collection pass leaves in each pixel.

    Attributes:
        plain: (H, W, D) blended colour of the hits that are not in the buffer.
        base: (H, W, D) blended colour of those that are.
        ids: (H, W, K) int64, surfels in the buffer, heaviest first, -1 where empty.
        depths: (H, W, K) z-depths of the hits, 0 where empty.
        weights: (H, W, K) blending weights, 0 where empty.
        alpha: (H, W) one minus the final transmittance.
    """

    plain: torch.Tensor
    base: torch.Tensor
    ids: torch.Tensor
    depths: torch.Tensor
    weights: torch.Tensor
    alpha: torch.Tensor


@dataclass(frozen=True)
class Walk:
    """All pixels P against all surfels N, sorted front to back by the depth of their centres.

    Attributes:
        order: (N,) int64, surfels front to back; the columns of the others.
        t: (P, N) z-depth of the hit.
        alphas: (P, N), 0 where there is no hit or the pixel is opaque already.
        before: (P, N) transmittance in front of the hit.
    """

    order: torch.Tensor
    t: torch.Tensor
    alphas: torch.Tensor
    before: torch.Tensor


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4), wxyz, of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def rays_of(view: View, like: torch.Tensor) -> torch.Tensor:
    """Camera-frame directions (H * W, 3) with z = 1 through the pixel centres, row by row."""
    x, y = (torch.arange(size, dtype=like.dtype, device=like.device) + 0.5 for size in (view.width, view.height))
    x, y = torch.meshgrid((x - view.cx) / view.fx, (y - view.cy) / view.fy, indexing="xy")
    return torch.stack([x, y, torch.ones_like(x)], dim=-1).reshape(-1, 3)


def power(u: torch.Tensor, gamma: torch.Tensor) -> torch.Tensor:
    """|u|^(2 gamma), smooth at 0 and finite (with its gradient) wherever exp(-power / 2) is not zero."""
    return (gamma * (u * u).clamp_min(1e-20).log()).clamp_max(50).exp()


def intersect(
    centers: torch.Tensor, axes: torch.Tensor, scales: torch.Tensor, rays: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Meet every ray (P, 3) with the plane of every surfel: u, v, t and whether they meet, each (P, N).

    Args:
        centers: (N, 3) in the camera frame.
        axes: (N, 3, 3) in the camera frame; the columns are the u axis, the v axis and the normal.
        scales: (N, 2).
        rays: (P, 3) in the camera frame, z = 1.
    """
    normals = axes[:, :, 2]
    slope = rays @ normals.T
    meets = slope.abs() > 1e-12
    t = (centers * normals).sum(-1) / torch.where(meets, slope, 1.0)
    offsets = t[..., None] * rays[:, None] - centers
    u = (offsets * axes[:, :, 0]).sum(-1) / scales[:, 0]
    v = (offsets * axes[:, :, 1]).sum(-1) / scales[:, 1]
    return u, v, t, meets


def collect(shape: Shape, colors: torch.Tensor, viewmat: torch.Tensor, view: View, max_hits: int) -> Hits:
    """Blend colours (N, D) in every pixel of a camera (4, 4), world to camera; differentiable in every tensor."""
    walked = walk(shape, viewmat, view)
    ranked, t, alphas = walked.order, walked.t, walked.alphas
    weights = alphas * walked.before
    alpha = 1 - torch.prod(1 - alphas, dim=-1)

    # The buffer: a stable sort of hits that are already front to back lets the nearer one win a tie.
    heaviest = torch.sort(weights.detach(), dim=-1, descending=True, stable=True).indices[:, :max_hits]
    filled = weights.detach().gather(-1, heaviest) > 0
    kept = torch.zeros_like(weights, dtype=torch.bool).scatter(-1, heaviest, filled)
    plain = torch.where(kept, 0.0, weights) @ colors[ranked]
    base = torch.where(kept, weights, 0.0) @ colors[ranked]

    def slots(values: torch.Tensor, empty: float) -> torch.Tensor:
        values = torch.where(filled, values, empty)
        values = torch.nn.functional.pad(values, (0, max_hits - values.shape[-1]), value=empty)
        return values.reshape(view.height, view.width, max_hits)

    return Hits(
        plain=plain.reshape(view.height, view.width, -1),
        base=base.reshape(view.height, view.width, -1),
        ids=slots(ranked[heaviest], -1),
        depths=slots(t.gather(-1, heaviest), 0.0),
        weights=slots(weights.gather(-1, heaviest), 0.0),
        alpha=alpha.reshape(view.height, view.width),
    )


def walk(shape: Shape, viewmat: torch.Tensor, view: View) -> Walk:
    """Meet every pixel's ray with every surfel."""
    means, quats, scales, opacities, gammas = shape
    rotation = viewmat[:3, :3]
    centers = means @ rotation.T + viewmat[:3, 3]

    # The hit (paper Eq. 3).
    u, v, t, meets = intersect(centers, rotation @ rotations(quats), scales, rays_of(view, means))
    exponent = power(u, gammas[:, 0]) + power(v, gammas[:, 1])
    alphas = (opacities * torch.exp(-exponent / 2)).clamp_max(ALPHA_MAX)
    counts = meets & (alphas >= ALPHA_MIN) & (t > view.near)
    alphas = torch.where(counts, alphas, 0.0)

    # Front to back: transmittance before each hit, up to and including the hit that makes the pixel opaque.
    keys = centers.norm(dim=-1) if view.order == "distance" else centers[:, 2]
    ranked = torch.sort(keys.detach().float(), stable=True).indices
    alphas, t = alphas[:, ranked], t[:, ranked]
    before = transmittance_before(alphas)
    return Walk(ranked, t, torch.where(before >= TRANSMITTANCE_MIN, alphas, 0.0), before)


def transmittance_before(alphas: torch.Tensor) -> torch.Tensor:
    """Transmittance (P, N) in front of each of the sorted `alphas` (P, N): 1, 1 - a_0, (1 - a_0)(1 - a_1)."""
    shifted = torch.nn.functional.pad(1 - alphas, (1, 0), value=1.0)[:, : alphas.shape[1]]
    return torch.cumprod(shifted, dim=-1)
