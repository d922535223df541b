"""Recover a camera's pose by gradient descent through a model's rendering.

python examples/refine_pose.py --model runs/demo --steps 200
"""

import argparse
import dataclasses
from pathlib import Path

import torch

import nexwarp as nw


def moved(viewmat: torch.Tensor, rotation: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """Move a camera in its own frame, by a rotation vector (3,) in radians and a shift (3,) in world units."""
    turn = torch.linalg.cross(rotation.expand(3, 3), torch.eye(3).to(rotation)).T
    motion = torch.cat([turn, shift[:, None]], dim=1)
    return torch.linalg.matrix_exp(torch.nn.functional.pad(motion, (0, 0, 0, 1))) @ viewmat


def pose_error(viewmat: torch.Tensor, true: torch.Tensor) -> tuple[float, float]:
    """Angle in degrees and distance in world units between two poses."""
    motion = viewmat.detach().double() @ torch.linalg.inv(true.double())
    half_angle = torch.asin(torch.linalg.matrix_norm(motion[:3, :3] - torch.eye(3).to(motion)) / 8**0.5)
    return torch.rad2deg(2 * half_angle).item(), motion[:3, 3].norm().item()


def main() -> None:
    """Perturb a training camera, then fit its rendering to that of the true pose, which stands for a photo."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="runs/demo")
    parser.add_argument("--steps", type=int, default=200)
    args = parser.parse_args()
    model = nw.load(args.model).to("cuda" if torch.cuda.is_available() else "cpu")
    camera = next(iter(nw.load_cameras(Path(args.model) / "cameras.json")["train"].values())).to(model.device)
    photo = model.render(camera).image.detach()
    torch.manual_seed(0)
    size = torch.tensor([0.03, 0.03 * (model.surfels.means.detach().std())], device=model.device)
    start = moved(camera.viewmat, *(size[:, None] * torch.randn(2, 3).to(size)))
    rotation, shift = (torch.zeros(3, device=model.device, requires_grad=True) for _ in range(2))
    rates = [{"params": [x], "lr": rate} for x, rate in zip((rotation, shift), (0.3 * size).tolist(), strict=True)]
    optimizer = torch.optim.Adam(rates)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps)
    for step in range(args.steps + 1):
        guess = dataclasses.replace(camera, viewmat=moved(start, rotation, shift))
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
