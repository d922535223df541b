"""Recover a camera's pose by gradient descent through a model's rendering.

python examples/refine_pose.py --model runs/demo --steps 200
"""

import argparse
import dataclasses
import math
from pathlib import Path

import torch

import nexwarp as nw
from nexwarp.cameras.cameras_file import load_cameras


def moved(viewmat: torch.Tensor, twist: torch.Tensor) -> torch.Tensor:
    """Move a camera by a twist (6,): rotation in radians and translation in world units, in the camera's frame."""
    x, y, z, *shift = twist.unbind()
    zero = torch.zeros_like(x)
    rows = [(zero, -z, y, shift[0]), (z, zero, -x, shift[1]), (-y, x, zero, shift[2]), (zero,) * 4]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows])) @ viewmat


def pose_error(viewmat: torch.Tensor, true: torch.Tensor) -> tuple[float, float]:
    """Angle in degrees and distance in world units between two poses."""
    motion = (viewmat.double() @ torch.linalg.inv(true.double())).detach()
    sine = torch.stack([motion[2, 1] - motion[1, 2], motion[0, 2] - motion[2, 0], motion[1, 0] - motion[0, 1]]).norm()
    angle = math.atan2(sine.item() / 2, (motion[:3, :3].trace().item() - 1) / 2)
    return math.degrees(angle), motion[:3, 3].norm().item()


def main() -> None:
    """Perturb a training camera, then fit its rendering to that of the true pose, which stands for a photo."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="runs/demo")
    parser.add_argument("--steps", type=int, default=200)
    args = parser.parse_args()
    model = nw.load(args.model).to("cuda" if torch.cuda.is_available() else "cpu")
    camera = next(iter(load_cameras(Path(args.model) / "cameras.json")["train"].values())).to(model.device)
    with torch.no_grad():
        photo = model.render(camera).image
    generator = torch.Generator().manual_seed(0)
    noise = torch.tensor([0.03] * 3 + [0.03 * float(model.meta["scene_scale"])] * 3)
    start = moved(camera.viewmat, (noise * torch.randn(6, generator=generator)).to(model.device))
    twist = torch.zeros(6, device=model.device, requires_grad=True)
    optimizer = torch.optim.Adam([twist], lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps)
    for step in range(args.steps + 1):
        guess = dataclasses.replace(camera, viewmat=moved(start, twist))
        loss = (model.render(guess).image - photo).abs().mean()
        if step in (0, args.steps) or step % 20 == 0:
            angle, distance = pose_error(guess.viewmat, camera.viewmat)
            print(f"step {step}: loss {loss.item():.4f}, pose error {angle:.3f} degrees, {distance:.4f} world units")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()


if __name__ == "__main__":
    main()
