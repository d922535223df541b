"""What the training views see of each surfel: where on it, how finely, from where, and whether with its texture."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.kernels.types import MAX_HITS
from nexwarp.model.model import Model
from nexwarp.model.render import Rendering
from nexwarp.model.surfels import Surfels

# Hits below this blending weight do not decide where a surfel has a texture: of 255 grey levels they change 4 at most.
LEAST_WEIGHT = 1.0 / 64.0
NOWHERE = 1e30
TINY_WEIGHT = 1e-3  # hits below it keep their plain colours


@dataclass(frozen=True)
class ViewHits:
    """The heaviest hits of each pixel of one view, at most 8 a pixel; P hits in all."""

    rendering: Rendering  # without texture
    pixels: torch.Tensor  # (P,) int64, indices of the hits' pixels, row-major
    ranks: torch.Tensor  # (P,) int64, in the pixel; 0 has the largest weight
    ids: torch.Tensor  # (P,) int64, surfels
    weights: torch.Tensor  # (P,) blending weights
    local: torch.Tensor  # (P, 2) coordinates of the hits on their surfels, in units of the scales
    directions: torch.Tensor  # (P, 3) unit directions of the rays, world frame

    def plain_colors(self) -> torch.Tensor:
        """Return the hits' plain colours (P, 3)."""
        return self.rendering.intermediates.projection.records[self.ids, 3, :3]

    def blended(self, colors: torch.Tensor) -> torch.Tensor:
        """Return the sums (H, W, 3) over each pixel's hits of weight * colors (P, 3); differentiable."""
        height, width = self.rendering.alpha.shape
        sums = colors.new_zeros(height * width, 3)
        return sums.index_add(0, self.pixels, self.weights[:, None] * colors).view(height, width, 3)


@dataclass(frozen=True)
class Observations:
    """What a set of views sees of N surfels."""

    # (N, 4) u0, v0, u1, v1, in units of the scales: the box of all textured hits of some weight; u0 > u1 without any
    boxes: torch.Tensor
    pixels: torch.Tensor  # (N, 2) largest number of pixels that one scale covers along the surfel's x and y axes
    textured: torch.Tensor  # (N,) fraction of the surfel's blending weight that is textured
    directions: torch.Tensor  # (N, 3) mean direction from which it is seen, unit, world frame; 0 if no view sees it


def axes(surfels: Surfels) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the surfels' unit x and y axes, (N, 3) each, world frame."""
    w, x, y, z = surfels.quats.detach().unbind(-1)
    across = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=-1)
    along = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1)
    return across, along


def untextured(model: Model, surfels: Surfels | None = None) -> Model:
    """Return a model that keeps 8 hits a pixel, without texture, at the mean exposure, with other colours if given."""
    options = model.options.changed(max_hits=MAX_HITS, exposure="mean", clamp_texture=False)
    return Model(surfels or model.surfels, None, None, model.detail_limits, options, model.meta)


@torch.no_grad()
def hits_of(bare: Model, camera: Camera) -> ViewHits:
    """Render a view of an `untextured` model and locate its hits on their surfels."""
    camera = camera.to(bare.device)
    rendering = bare.render(camera)
    surfels = bare.surfels
    slots = (rendering.weights >= TINY_WEIGHT).flatten().nonzero()[:, 0]
    pixels, ranks = slots // MAX_HITS, slots % MAX_HITS
    ids, weights, depths = (x.flatten()[slots] for x in (rendering.ids, rendering.weights, rendering.depths))
    ids = ids.long()
    rays = torch.stack(
        [
            (pixels % camera.width + 0.5 - camera.cx) / camera.fx,
            (pixels // camera.width + 0.5 - camera.cy) / camera.fy,
            torch.ones_like(weights),
        ],
        dim=1,
    ) @ camera.viewmat[:3, :3].to(weights)
    offsets = camera.position.to(weights) + depths[:, None] * rays - surfels.means.detach()[ids]
    coordinates = [(offsets * axis[ids]).sum(1) for axis in axes(surfels)]
    local = torch.stack(coordinates, dim=1) / surfels.scales.detach()[ids]
    return ViewHits(rendering, pixels, ranks, ids, weights, local, torch.nn.functional.normalize(rays, dim=1))


@torch.no_grad()
def observe(model: Model, cameras: Sequence[Camera]) -> Observations:
    """Render all views without texture and gather what they see of each surfel; K decides which hits are textured."""
    bare, kept = untextured(model), model.options.max_hits
    count, means = len(model.surfels), model.surfels.means.detach()
    boxes = torch.cat([means.new_full((count, 2), NOWHERE), means.new_full((count, 2), -NOWHERE)], dim=1)
    pixels, total, textured = means.new_zeros(count, 2), means.new_zeros(count), means.new_zeros(count)
    directions, scales, sides = means.new_zeros(count, 3), model.surfels.scales.detach(), axes(model.surfels)
    for camera in cameras:
        hits = hits_of(bare, camera)
        total.index_add_(0, hits.ids, hits.weights)
        directions.index_add_(0, hits.ids, hits.weights[:, None] * hits.directions)
        heavy = hits.ranks < kept
        textured.index_add_(0, hits.ids, hits.weights * heavy)
        heavy &= hits.weights >= LEAST_WEIGHT
        ids, local, rays = hits.ids[heavy], hits.local[heavy], hits.directions[heavy]
        pairs = ids[:, None].expand(-1, 2)
        for side, how in ((0, "amin"), (2, "amax")):
            boxes[:, side : side + 2].scatter_reduce_(0, pairs, local, how)
        # Pixels that one scale covers: its part across the ray, over the size of a pixel at the hit.
        cosines = torch.stack([(axis[ids] * rays).sum(1) for axis in sides], dim=1)
        sizes = hits.rendering.depths.flatten()[(hits.pixels * MAX_HITS + hits.ranks)[heavy]] / camera.focal
        covered = scales[ids] * (1 - cosines.square()).clamp_min(0).sqrt() / sizes[:, None]
        pixels.scatter_reduce_(0, pairs, covered, "amax")
    return Observations(
        boxes, pixels, textured / total.clamp_min(1e-12), torch.nn.functional.normalize(directions, dim=-1)
    )
