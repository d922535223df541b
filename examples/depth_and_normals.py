"""Write depth, normals and a mask of a model's view, as pictures and as exact numbers.

python examples/depth_and_normals.py --model runs/demo --out runs/demo/geometry
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import nexwarp as nw


def grey(depth: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Picture (H, W, 3) of a depth (H, W): near is white, far is dark, nothing is black."""
    inverse = torch.where(mask, 1.0 / depth.clamp_min(1e-6), 0.0)
    return (inverse / inverse.max().clamp_min(1e-6))[..., None].expand(-1, -1, 3)


def save(path: Path, picture: torch.Tensor) -> None:
    """Write values from 0 to 1 (H, W, 3) as a picture."""
    Image.fromarray((255 * picture.clamp(0, 1)).round().byte().cpu().numpy()).save(path)


def main() -> None:
    """Render one view, and write what it tells of the geometry."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="runs/demo")
    parser.add_argument("--view", help="name of a training or test view; by default the first test view")
    parser.add_argument("--out", default="runs/demo/geometry")
    parser.add_argument("--opaque", type=float, default=0.5, help="alpha from which on a pixel belongs to the scene")
    args = parser.parse_args()
    model = nw.load(args.model).to("cuda" if torch.cuda.is_available() else "cpu")
    sets = nw.load_cameras(Path(args.model) / "cameras.json")
    cameras = sets["test"] | sets["train"]
    with torch.no_grad():
        rendering = model.render(cameras[args.view or next(iter(cameras))])
    mask = rendering.alpha >= args.opaque
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    save(out / "image.png", rendering.image)
    save(out / "mask.png", mask[..., None].expand(-1, -1, 3).float())
    save(out / "expected_depth.png", grey(rendering.expected_depth, mask))
    save(out / "median_depth.png", grey(rendering.median_depth, mask))
    save(out / "normals.png", (rendering.normals + 1.0) / 2.0 * mask[..., None])  # x, y, z as red, green, blue
    # Float32: z-depths in world units, normals in the world frame.
    names = ("expected_depth", "median_depth", "normals", "alpha")
    np.savez(out / "geometry.npz", **{name: getattr(rendering, name).cpu().numpy() for name in names})
    print(f"{100 * mask.float().mean().item():.1f} % of the pixels are opaque; files in {out}")


if __name__ == "__main__":
    main()
