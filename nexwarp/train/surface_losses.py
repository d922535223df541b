"""The loss of the surface itself, as 2DGS has it (Huang et al., 2024): normal consistency."""

import torch

from nexwarp import ops
from nexwarp.model.render import Rendering
from nexwarp.train.recipe import REFERENCE_ITERATIONS, Config

# Iteration, of a run of 30,000, from which the loss counts: that of 2DGS.
NORMALS_FROM = 7_000


def normals_factor(config: Config, iteration: int) -> float:
    """Return the factor of `normal_loss` at an iteration: 0 before the loss starts."""
    begun = iteration / config.iterations >= NORMALS_FROM / REFERENCE_ITERATIONS
    return config.losses.normals if begun else 0.0


def normal_loss(out: Rendering, counts: torch.Tensor | None = None) -> torch.Tensor:
    """Mean over pixels of sum over hits of weight * (1 - n . N), with N the normal of the median depths' map.

    Pixels whose N is not known do not count, nor those outside of `counts` (H, W) bool.
    """
    stages = out.intermediates
    normals = depth_normals(out.median_depth, stages.viewmat, stages.pinhole)
    errors = out.alpha * normals.detach().any(-1) - (out.blended_normals * normals).sum(-1)
    return (errors if counts is None else errors * counts).mean()


def depth_normals(depths: torch.Tensor, viewmat: torch.Tensor, pinhole: ops.Pinhole) -> torch.Tensor:
    """Return the normals of a depth map by central differences; differentiable with respect to both tensors.

    Args:
        depths: (H, W) z-depths, world units; 0 where there is no surface.
        viewmat: (4, 4) world to camera.
        pinhole: the image plane.

    Returns:
        (H, W, 3) unit normals that face the camera, world frame; 0 on the border and beside pixels without a surface.
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
