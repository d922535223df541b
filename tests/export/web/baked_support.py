"""The image of a baked scene as its definition says: all hits of a pixel, one after another, each with its texel."""

import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.export.bake import Baked
from nexwarp.kernels.types import ALPHA_MAX, ALPHA_MIN, TINY
from tests.reference.collect import rotations
from tests.scenes import intrinsics, rigid


def ring(count: int = 4, width: int = 64, height: int = 48) -> dict[str, nw.Camera]:
    """Cameras around the random scene."""
    cameras = {}
    for i in range(count):
        viewmat = rigid((0.9, 0.2, -0.3 + 0.06 * i, 0.1), (0.3 - 0.2 * i, -0.2, 0.5)).float()
        K = intrinsics(0.8 * width, 0.8 * width, width / 2, height / 2).float()
        cameras[f"{i}.png"] = nw.Camera(viewmat, K, width, height)
    return cameras


def bilinear(atlas: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Values (..., C) of an image (H, W, C) at places (..., 2), column and row of texel centres."""
    low = places.floor().long()
    share = places - low
    total = torch.zeros(*places.shape[:-1], atlas.shape[2], dtype=places.dtype)
    for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
        weight = (share[..., 0] if x else 1 - share[..., 0]) * (share[..., 1] if y else 1 - share[..., 1])
        column = (low[..., 0] + x).clamp(0, atlas.shape[1] - 1)
        row = (low[..., 1] + y).clamp(0, atlas.shape[0] - 1)
        total += weight[..., None] * atlas[row, column]
    return total


@torch.no_grad()
def composited(baked: Baked, camera: nw.Camera) -> torch.Tensor:
    """The image (H, W, 3) in float64, without tiles: every surfel at every pixel."""
    surfels = baked.surfels.double()
    viewmat, eye = camera.viewmat.double(), camera.position.double()
    frames = rotations(surfels.quats)
    y, x = torch.meshgrid(torch.arange(camera.height).double(), torch.arange(camera.width).double(), indexing="ij")
    rays = torch.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, torch.ones_like(x)], -1)
    rays = rays.reshape(-1, 3) @ viewmat[:3, :3]
    depths = ((surfels.means - eye) * frames[:, :, 2]).sum(1) / (rays @ frames[:, :, 2].T)
    offsets = eye + depths[..., None] * rays[:, None] - surfels.means
    local = torch.einsum("pni,nij->pnj", offsets, frames)[..., :2] / surfels.scales
    exponents = local.square().clamp_min(TINY).pow(surfels.gammas).sum(-1)
    alphas = (surfels.opacities * torch.exp(-0.5 * exponents)).clamp(max=ALPHA_MAX)
    alphas = alphas.where((alphas >= ALPHA_MIN) & (depths > camera.near), 0.0)
    plain = ops.plain_colors((surfels.sh0, surfels.shN), surfels.means, eye, baked.model.options.sh_degree)
    ids = torch.arange(len(surfels.means)).expand(local.shape[:2])
    places = baked.layout.texels(ids, local)
    colors = (plain + bilinear(baked.atlas.double(), places)).clamp_min(0)
    image, left = torch.zeros(len(rays), 3).double(), torch.ones(len(rays), 1).double()
    for i in ((surfels.means @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2]).argsort().tolist():
        image += left * alphas[:, i, None] * colors[:, i]
        left *= 1 - alphas[:, i, None]
    image += left * torch.tensor(baked.model.options.background).double()
    return image.reshape(camera.height, camera.width, 3)
