"""The baked scene: surfels, and an image of what the texture adds to their colours."""

from dataclasses import dataclass

import torch

from nexwarp import ops
from nexwarp.cameras.camera import Camera
from nexwarp.export.bake.layout import Layout
from nexwarp.export.bake.observe import Observations, hits_of, untextured
from nexwarp.model.model import Model
from nexwarp.model.surfels import Surfels


@dataclass(frozen=True)
class Baked:
    """Surfels whose colour at a point is their plain colour plus a texel of the atlas, for all hits of a pixel."""

    model: Model  # that was baked
    surfels: Surfels  # its surfels, with SH that take over the texture's dependence on the direction
    seen: Observations  # what the views see of the surfels
    layout: Layout  # the surfels' texels in the atlas
    atlas: torch.Tensor  # (height, width, 3) float32, added to the plain colours, sRGB

    @torch.no_grad()
    def render(self, camera: Camera) -> torch.Tensor:
        """Return the image (H, W, 3) of a camera at the mean exposure.

        Of each pixel, the 8 heaviest hits have their texels; further hits have their plain colours.
        """
        hits = hits_of(untextured(self.model, self.surfels), camera)
        plain = hits.plain_colors()
        return hits.rendering.image + hits.blended(torch.maximum(self.added(hits.ids, hits.local), -plain))

    def added(self, ids: torch.Tensor, local: torch.Tensor) -> torch.Tensor:
        """Return what the atlas adds (..., 3) to the colours of surfels (...) at coordinates (..., 2) on them."""
        return sample(self.atlas, self.layout.texels(ids, local))


def mean_colors(surfels: Surfels, seen: Observations, sh_degree: int) -> torch.Tensor:
    """Return the plain colours (N, 3) of surfels from the mean directions that the views see them in."""
    return ops.plain_colors((surfels.sh0, surfels.shN), seen.directions, surfels.means.new_zeros(3), sh_degree)


def encode_atlas(atlas: torch.Tensor) -> tuple[torch.Tensor, float]:
    """Return uint8 codes of an atlas, 128 for 0, and the value that 127 steps stand for."""
    scale = max(float(atlas.abs().amax().clamp(max=1.0)), 1e-3) if atlas.numel() else 1.0
    return (atlas / scale * 127).round().clamp(-127, 127).add(128).to(torch.uint8), scale


def sample(atlas: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Interpolate an atlas (height, width, C) bilinearly at places (..., 2), column and row; differentiable."""
    size = atlas.new_tensor([atlas.shape[1], atlas.shape[0]])
    grid = (2 * places + 1) / size - 1
    values = torch.nn.functional.grid_sample(
        atlas.permute(2, 0, 1)[None], grid.reshape(1, -1, 1, 2), align_corners=False, padding_mode="border"
    )
    return values[0, :, :, 0].T.reshape(*places.shape[:-1], atlas.shape[2])
