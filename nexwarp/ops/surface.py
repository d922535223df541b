"""Depth and normals of each pixel, over all hits that the collection pass blended."""

from dataclasses import dataclass

import torch
import warp as wp

from nexwarp.kernels.surface import surface_kernel
from nexwarp.kernels.types import types
from nexwarp.ops._interop import array, real_of
from nexwarp.ops.collect import Hits, launch_walk, walk_inputs
from nexwarp.ops.pinhole import Pinhole
from nexwarp.ops.project import Projection
from nexwarp.ops.tiles import Tiles


@dataclass(frozen=True)
class Surface:
    """Depth and normals; 0 where nothing is hit. Nothing is differentiable.

    Attributes:
        expected_depth: (H, W) mean z-depth of all hits, weighted by their blending weights, world units.
        median_depth: (H, W) z-depth of the hit that takes the transmittance to 1/2, of the last hit where it stays
            above.
        top_depth: (H, W) z-depth of the heaviest hit.
        normals: (H, W, 3) unit, world frame: mean of the normals, weighted likewise, each towards the camera.
    """

    expected_depth: torch.Tensor
    median_depth: torch.Tensor
    top_depth: torch.Tensor
    normals: torch.Tensor


@torch.no_grad()
def surface(
    projection: Projection, tiles: Tiles, hits: Hits, camera: Pinhole, viewmat: torch.Tensor, *, low_pass: bool = False
) -> Surface:
    """Walk every pixel's list once more, for what the K-buffer does not hold.

    Args:
        projection: as given to `collect`.
        tiles: as given to `collect`.
        hits: as returned by `collect`.
        camera: as given to `collect`.
        viewmat: (4, 4) world to camera.
        low_pass: as given to `collect`.
    """
    records = projection.records.detach()
    real = real_of(records)
    expected, median, top = (records.new_empty(camera.height, camera.width) for _ in range(3))
    normals = records.new_empty(camera.height, camera.width, 3)
    inputs = walk_inputs(records, projection.centers.detach(), projection.limits, tiles, camera)
    inputs += [array(tiles.reaches, types(real).vec2), array(hits.stops.view(-1), wp.int32)]
    outputs = [array(x.view(-1), real) for x in (expected, median, top)]
    outputs.append(array(normals.view(-1, 3), types(real).vec3))
    launch_walk(records, surface_kernel(real, low_pass, tiles.tile_size), tiles, inputs, outputs)
    with torch.autocast(normals.device.type, enabled=False):
        normals = torch.nn.functional.normalize(normals @ viewmat[:3, :3].to(normals), dim=-1)
    return Surface(expected, median, top, normals)
