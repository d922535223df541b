"""Exported Gaussians, drawn by gsplat on CUDA."""

from pathlib import Path

import torch

import nexwarp as nw

UNIT_GAMMA = -40.0  # raw: gamma = 1 + exp(raw)


def read_ply(path: Path) -> dict[str, torch.Tensor]:
    """Return the vertices of a PLY file by property, read by plyfile."""
    import numpy as np
    from plyfile import PlyData

    vertex = PlyData.read(str(path))["vertex"]
    return {p.name: torch.from_numpy(np.array(vertex[p.name])) for p in vertex.properties}


def draw(path: Path, camera: nw.Camera, background: tuple[float, float, float]) -> torch.Tensor:
    """Render a 3DGS PLY with gsplat on the camera's device: (H, W, 3)."""
    import gsplat

    columns = {name: x.to(camera.viewmat.device) for name, x in read_ply(path).items()}

    def stack(name: str, *indices: object) -> torch.Tensor:
        return torch.stack([columns[f"{name}{i}"] for i in indices], dim=1)

    rest = stack("f_rest_", *range(45)).view(-1, 3, 15).mT
    with torch.no_grad():
        return gsplat.rasterization(
            stack("", *"xyz"),
            stack("rot_", *range(4)),
            stack("scale_", *range(3)).exp(),
            columns["opacity"].sigmoid(),
            torch.cat([stack("f_dc_", *range(3))[:, None], rest], dim=1).contiguous(),
            camera.viewmat[None],
            camera.K[None],
            camera.width,
            camera.height,
            sh_degree=3,
            packed=False,  # packed, gsplat 1.5.3 takes no backgrounds
            backgrounds=torch.tensor([background], device=camera.viewmat.device),
        )[0][0]


def untextured(surfels: nw.Surfels) -> nw.Surfels:
    """Return the same surfels with gamma = 1, which Gaussians can represent."""
    raw = {name: x.clone() for name, x in surfels.state_dict().items()}
    raw["raw_gammas"].fill_(UNIT_GAMMA)
    return nw.Surfels(raw)
