"""Test-time pose optimisation: test cameras moved to where their photos fit the rendering best, the model fixed.

The test poses of a refined training are still the given ones, with their errors. As in BARF and its followers, they are
fitted to the test photos before they are judged; metrics.json says so.
"""

import dataclasses
from collections.abc import Callable, Sequence

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.data import View
from nexwarp.errors import check_range
from nexwarp.model.model import Model
from nexwarp.model.poses import PoseCorrections, pose_differences

STEPS = 80  # of each view; the first half sees the photo at half its size
RATE = 5e-3  # Adam's first learning rate: radians, and shifts in scene scales
LAST_RATE = 0.02  # the last rate, relative to the first

Aim = tuple[Camera, torch.Tensor, torch.Tensor]  # camera; photo (H, W, 3); what counts of it (H, W), 0 or 1


def fit_poses(
    model: Model, views: Sequence[View], *, steps: int = STEPS, progress: Callable[[int, int], object] = lambda *_: None
) -> tuple[list[View], dict[str, float]]:
    """Return views with the poses at which the model's renderings fit their photos best, and entries for metrics.json.

    These say how the poses were fitted and how far they moved. Each view takes `steps` gradient steps; the model is on
    the device to render on, and stays as it is.
    """
    check_range("steps", steps, 1)
    scale = model.meta.get("scene_scale", 1.0)
    unit = float(scale) if isinstance(scale, (int, float)) else 1.0
    fitted = []
    learned = [parameter for parameter in model.parameters() if parameter.requires_grad]
    try:
        for parameter in learned:
            parameter.requires_grad_(False)
        with torch.enable_grad():
            for view in views:
                fitted.append(dataclasses.replace(view, camera=_fit(model, view, unit, steps)))
                progress(len(fitted), len(views))
    finally:
        for parameter in learned:
            parameter.requires_grad_(True)
    before, after = (torch.stack([view.camera.viewmat for view in group]) for group in (views, fitted))
    angles, shifts = pose_differences(before, after)
    facts: dict[str, float] = {
        "steps": steps,
        "mean_rotation_degrees": angles.mean().item(),
        "mean_shift_scene_scales": shifts.mean().item() / unit,
    }
    return fitted, facts


def _fit(model: Model, view: View, unit: float, steps: int) -> Camera:
    """Return a view's camera on the CPU, at the pose of the smallest L1 error that the descent has met."""
    start = view.camera.to(model.device)
    photo = view.image.to(model.device).float() / 255
    whole = (start, photo, torch.ones_like(photo[..., 0]) if view.mask is None else view.mask.to(photo))
    half = _halved(*whole) if min(start.width, start.height) > 1 else whole
    poses = PoseCorrections([start], unit, [_middle_depth(model, start, unit)]).to(model.device)
    optimizer = torch.optim.Adam(poses.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, LAST_RATE ** (1 / steps))
    best = start
    least = float("inf")
    for step in range(steps + 1):
        aim = half if 0 < step < steps // 2 else whole  # the given pose is judged at full size
        camera, target, counts = aim
        errors = (model.render(poses.camera(camera, 0)).image.clamp(0, 1) - target).abs().mean(-1)
        error = (errors * counts).sum() / counts.sum().clamp(min=1)
        if aim is whole and error.item() < least:
            (best,) = poses.cameras([start])
            least = error.item()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        schedule.step()
    return best.to("cpu")


@torch.no_grad()
def _middle_depth(model: Model, camera: Camera, unit: float) -> float:
    """Return the median z-depth of a rendering, world units; where nothing is hit, `unit`."""
    depths = model.render(camera).median_depth
    hit = depths[depths > 0]
    return hit.median().item() if len(hit) else unit


def _halved(camera: Camera, photo: torch.Tensor, counts: torch.Tensor) -> Aim:
    """Return camera, photo and mask at half the size."""
    layers = torch.cat([photo, counts[..., None]], -1).permute(2, 0, 1)
    layers = torch.nn.functional.avg_pool2d(layers, 2).permute(1, 2, 0)
    K = camera.K.clone()
    K[:2] /= 2
    small = dataclasses.replace(camera, K=K, width=camera.width // 2, height=camera.height // 2)
    return small, layers[..., :3].contiguous(), (layers[..., 3] == 1).to(photo)
