"""Write depth, normals and a mask of a model's view, as pictures and as exact numbers.

python examples/depth_and_normals.py --model runs/demo --out runs/demo/geometry
"""

import argparse
from pathlib import Path

import torch

import nexwarp as nw
from nexwarp.cameras.cameras_file import load_cameras
from nexwarp.io.pictures import save_exr, save_png


def grey(depth: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Picture (H, W, 3) of a depth (H, W): near is white, far is dark, nothing is black."""
    inverse = torch.where(mask, 1.0 / depth.clamp_min(1e-6), 0.0)
    return (inverse / inverse.max().clamp_min(1e-6))[..., None].expand(-1, -1, 3)


def main() -> None:
    """Render one view, and write what it tells of the geometry."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="runs/demo")
    parser.add_argument("--view", help="name of a training or test view; by default the first test view")
    parser.add_argument("--out", default="runs/demo/geometry")
    parser.add_argument("--opaque", type=float, default=0.5, help="alpha from which on a pixel belongs to the scene")
    args = parser.parse_args()
    model = nw.load(args.model).to("cuda" if torch.cuda.is_available() else "cpu")
    sets = load_cameras(Path(args.model) / "cameras.json")
    cameras = sets["test"] | sets["train"]
    with torch.no_grad():
        rendering = model.render(cameras[args.view or next(iter(cameras))])
    mask = rendering.alpha >= args.opaque
    out = Path(args.out)
    save_png(out / "image.png", rendering.image.clamp(0, 1))
    save_png(out / "mask.png", mask[..., None].expand(-1, -1, 3).float())
    save_png(out / "expected_depth.png", grey(rendering.expected_depth, mask))
    save_png(out / "median_depth.png", grey(rendering.median_depth, mask))
    save_png(out / "normals.png", (rendering.normals + 1.0) / 2.0 * mask[..., None])  # x, y, z as red, green, blue
    save_exr(
        out / "geometry.exr",  # z-depths in world units, normals in the world frame, float32
        {
            "expected_depth": rendering.expected_depth,
            "median_depth": rendering.median_depth,
            "normals": rendering.normals,
            "alpha": rendering.alpha,
        },
    )
    print(f"{100 * mask.float().mean().item():.1f} % of the pixels are opaque; files in {out}")


if __name__ == "__main__":
    main()
