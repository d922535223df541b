"""Compares renderings of exported Gaussians by gsplat with our own, for each test view of a trained run.

    python -m benchmarks.splats runs/fox

renders the run without its texture and with gamma = 1, renders the file of `nexwarp export` with gsplat 1.5.3 and its
defaults (with its blur of 0.3 pixel^2), and prints the PSNR between the two. Needs CUDA, gsplat and plyfile.
"""

import statistics
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import torch
import tyro

import nexwarp as nw
from nexwarp.cameras.cameras_file import CAMERAS_FILE, load_cameras
from nexwarp.export.surfels_ply import save_splats_ply
from nexwarp.io.pictures import to_uint8
from nexwarp.run.metrics import psnr

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


def main(
    run: Annotated[Path, tyro.conf.Positional],
    max_views: int = 8,
) -> int:
    """Compare a trained run's exported Gaussians with our own rendering.

    Args:
        run: run folder.
        max_views: at most so many test views.
    """
    if not torch.cuda.is_available():
        print("expected a CUDA device, found none", file=sys.stderr)
        return 2
    model = nw.load(run)
    surfels = untextured(model.surfels).to("cuda")
    degree = model.options.sh_degree
    sets = load_cameras(run / CAMERAS_FILE)
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "splats.ply"
        cameras = [camera for members in sets.values() for camera in members.values()]
        save_splats_ply(path, surfels, degree, cameras=cameras)
        count = len(read_ply(path)["x"])
        for name, camera in list(sets["test"].items())[:max_views]:
            camera = camera.to("cuda")
            with torch.no_grad():
                mine = nw.render(surfels, None, camera, sh_degree=degree).image
            figures.append(psnr(to_uint8(draw(path, camera, (0.0, 0.0, 0.0))).cpu(), to_uint8(mine).cpu()))
            print(f"{name}: {figures[-1]:.2f} dB", flush=True)
    print(
        f"{len(surfels):,} surfels as {count:,} Gaussians: {statistics.fmean(figures):.2f} dB, least {min(figures):.2f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
