"""Depths and normals of the surfels as they are blended (weights of paper Sec. 4.2), over all hits of a pixel."""

from dataclasses import dataclass

import torch

from tests.reference.collect import Shape, View, rays_of, rotations, walk


@dataclass(frozen=True)
class Surface:
    """The buffers of the same names of `nexwarp.Rendering`; all 0 where nothing is hit.

    Attributes:
        expected_depth: (H, W) mean depth of the hits, weighted by their blending weights.
        median_depth: (H, W) depth of the last hit with a transmittance above 1/2 in front of it.
        top_depth: (H, W) depth of the heaviest hit.
        normals: (H, W, 3) unit, world frame: weighted mean of the normals, each facing the camera.
        blended_normals: (H, W, 3) their weighted sum.
    """

    expected_depth: torch.Tensor
    median_depth: torch.Tensor
    top_depth: torch.Tensor
    normals: torch.Tensor
    blended_normals: torch.Tensor


def surface(shape: Shape, viewmat: torch.Tensor, view: View) -> Surface:
    walked = walk(shape, viewmat, view)
    t, weights = walked.t, walked.alphas * walked.before
    hit = weights > 0
    total = weights.sum(dim=-1)
    expected = torch.where(hit, weights * t, 0.0).sum(dim=-1) / torch.where(total > 0, total, 1.0)

    # Places of the hits in front to back order, 1 for the first surfel; 0 where there is none.
    places = torch.arange(1, t.shape[1] + 1).expand_as(t)
    median = torch.where(hit & (walked.before > 0.5), places, 0)
    heaviest = torch.where(hit & (weights == row_max(weights)), t.shape[1] + 1 - places, 0)
    median_place = row_max(median)[:, 0]
    top_place = t.shape[1] + 1 - row_max(heaviest)[:, 0]  # of equal ones the first

    def depth_at(places: torch.Tensor, found: torch.Tensor) -> torch.Tensor:
        padded = torch.nn.functional.pad(t, (1, 1))
        return torch.where(found, padded.gather(1, places[:, None])[:, 0], 0.0)

    rays = rays_of(view, shape.means) @ viewmat[:3, :3]
    normals = rotations(shape.quats)[walked.order][:, :, 2]
    facing = torch.where(rays @ normals.T > 0, -1.0, 1.0)
    mean = (weights * facing) @ normals
    size = view.height, view.width
    return Surface(
        expected_depth=expected.reshape(size),
        median_depth=depth_at(median_place, median_place > 0).reshape(size),
        top_depth=depth_at(top_place, total > 0).reshape(size),
        normals=torch.nn.functional.normalize(mean, dim=-1).reshape(*size, 3),
        blended_normals=mean.reshape(*size, 3),
    )


def row_max(values: torch.Tensor) -> torch.Tensor:
    """Largest value of each row (P, N) as (P, 1); 0 without columns."""
    return torch.nn.functional.pad(values, (0, 1)).amax(dim=-1, keepdim=True)
