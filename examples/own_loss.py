"""Train with a loss of one's own.

python examples/own_loss.py --steps 500 --weight 0.5
"""

import argparse
import dataclasses
from collections.abc import Callable

import torch

import nexwarp as nw


def edge_loss(weight: float) -> Callable[[nw.Rendering, nw.Target], torch.Tensor]:
    """L1 between the differences of neighbouring pixels, in the rendering and in the photo, where the photo counts."""

    def loss(rendering: nw.Rendering, target: nw.Target) -> torch.Tensor:
        error = (rendering.image - target.photo) * (1.0 if target.counts is None else target.counts[..., None])
        return weight * (error.diff(dim=0).abs().mean() + error.diff(dim=1).abs().mean())

    return loss


def main() -> None:
    """Train, and tell how the own loss and the PSNR change."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--weight", type=float, default=0.5)
    parser.add_argument("--downscale", type=int, default=4, help="reduce the demo's photos of 96x72 by this factor")
    args = parser.parse_args()
    demo = nw.load_scene("demo", downscale=args.downscale)
    config = dataclasses.replace(nw.preset("default"), iterations=args.steps, max_surfels=2000)
    reports: list[tuple[float, float]] = []

    def keep(step: nw.StepReport) -> None:
        reports.append((step.losses["edges"].item(), step.psnr()))

    nw.train(demo, config, callbacks=[keep], losses={"edges": edge_loss(args.weight)})
    tenth = max(len(reports) // 10, 1)
    for name, part in (("first", reports[:tenth]), ("last", reports[-tenth:])):
        edges, psnr = torch.tensor(part).mean(dim=0).tolist()
        print(f"{name} steps: edge loss {edges:.4f}, {psnr:.2f} dB")


if __name__ == "__main__":
    main()
