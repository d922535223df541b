"""Small seeded scenes, the same in every dtype: values are made in float64 and rounded to float32.

All but `viewmat`: a rotation rounded to float32 is orthonormal to 1e-7 only, and then it matters, in float64,
whether rays are turned into the world or surfels into the camera frame.

A scene is a dict: the arguments of `Surfels.from_activated`, and `viewmat`, `K`, `width`, `height`, `near`.
"""

from __future__ import annotations

from typing import Any

import torch
from scipy.spatial.transform import Rotation

import nexwarp as nw
from nexwarp.model.surfels import Activated
from tests.reference.collect import rotations

Scene = dict[str, Any]
SURFEL_KEYS = ("means", "quats", "scales", "opacities", "gammas", "sh")
CAMERA_KEYS = ("viewmat", "K", "width", "height", "near")


def uniform(generator: torch.Generator, *shape: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def rigid(quat: tuple[float, ...], translation: tuple[float, ...]) -> torch.Tensor:
    """Rigid motion (4, 4) float64 of a quaternion (wxyz) and a translation."""
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = rotations(torch.tensor([quat], dtype=torch.float64))[0]
    motion[:3, 3] = torch.tensor(translation, dtype=torch.float64)
    return motion


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> torch.Tensor:
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def finish(scene: Scene, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Scene:
    """Cast and move every tensor of `scene`, rounded to float32 unless it must stay rigid."""
    tensors = {key: value for key, value in scene.items() if isinstance(value, torch.Tensor)}
    rounded = {key: value if key == "viewmat" else value.float() for key, value in tensors.items()}
    return scene | {key: value.to(device=device, dtype=dtype) for key, value in rounded.items()}


def random_scene(
    count: int = 24, *, seed: int = 0, width: int = 23, height: int = 18, sh_degree=3, off_centre=False, **kind: Any
) -> Scene:
    """Make `count` surfels of all orientations in front of a turned camera, opacities well above 1/255.

    `off_centre` puts the principal point outside the image and makes fx and fy differ; `kind` is for `finish`.
    """
    generator = torch.Generator().manual_seed(seed)
    fx, fy, cx, cy = (31.0, 22.0, -4.25, height + 3.5) if off_centre else (24.0, 24.0, width / 2, height / 2)
    viewmat = rigid((0.9, 0.2, -0.3, 0.1), (0.3, -0.2, 0.5))
    z = uniform(generator, count, low=2.0, high=5.0)
    x = (uniform(generator, count, high=width) - cx) / fx * z
    centers = torch.stack([x, (uniform(generator, count, high=height) - cy) / fy * z, z], dim=-1)
    sh = 0.3 * torch.randn(count, (sh_degree + 1) ** 2, 3, generator=generator, dtype=torch.float64)
    scene = {
        "means": (centers - viewmat[:3, 3]) @ viewmat[:3, :3],
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "scales": uniform(generator, count, 2, low=0.2, high=0.9),
        "opacities": uniform(generator, count, low=0.2, high=0.95),
        "gammas": uniform(generator, count, 2, low=1.1, high=2.5),
        "sh": sh,
        "viewmat": viewmat,
        "K": intrinsics(fx, fy, cx, cy),
        "width": width,
        "height": height,
        "near": 0.01,
    }
    return finish(scene, **kind)


def layered_scene(count: int = 16, *, seed: int = 0, **kind: Any) -> Scene:
    """Make opaque sheets one behind the other, so that the transmittance reaches 1e-4 and the walk stops.

    Every third opacity lies above the cap of 0.99.
    """
    generator = torch.Generator().manual_seed(seed)
    scene = random_scene(count, seed=seed, dtype=torch.float64)
    viewmat = scene["viewmat"]
    z = torch.linspace(2.0, 4.0, count, dtype=torch.float64)
    lateral = uniform(generator, count, 2, low=-0.3, high=0.3)
    opacities = uniform(generator, count, low=0.8, high=0.97)
    opacities[::3] = 0.999
    tilt = torch.cat([0.05 * torch.randn(count, 3, generator=generator), torch.ones(count, 1)], dim=-1)  # xyzw
    turned = Rotation.from_quat([-0.2, 0.3, -0.1, 0.9]) * Rotation.from_quat(tilt)  # almost to the camera
    scene |= {
        "means": (torch.cat([lateral, z[:, None]], dim=-1) - viewmat[:3, 3]) @ viewmat[:3, :3],
        "quats": torch.from_numpy(turned.as_quat()[:, [3, 0, 1, 2]]),
        "scales": uniform(generator, count, 2, low=0.8, high=2.0),
        "opacities": opacities,
        "gammas": uniform(generator, count, 2, low=1.5, high=4.0),
    }
    return finish(scene, **kind)


def facing_scene(
    *surfels: tuple[float, float], size: tuple[int, int], scale=100.0, gamma=1.0, focal=24.0, **kind: Any
) -> Scene:
    """Make surfels (z-depth, opacity) on the axis of a camera at the origin, which they face."""
    count, (width, height) = len(surfels), size
    z, opacities = torch.tensor(surfels, dtype=torch.float64).unbind(-1)
    scene: Scene = {
        "means": torch.stack([0 * z, 0 * z, z], dim=-1),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        "scales": torch.full((count, 2), scale),
        "opacities": opacities,
        "gammas": torch.full((count, 2), gamma),
        "sh": random_scene(count)["sh"],
        "viewmat": torch.eye(4),
        "K": intrinsics(focal, focal, width / 2, height / 2),
    }
    moved = {name: x.to(**{"dtype": torch.float32} | kind) for name, x in scene.items()}  # not rounded
    return moved | {"width": width, "height": height, "near": 0.01}


def named_scene(name: str, dtype: torch.dtype, device: torch.device | str) -> Scene:
    """Make one of the scenes on which renderings are compared: random, off_centre, specks, near, layered, wide."""
    if name == "layered":
        return layered_scene(dtype=dtype, device=device)
    if name == "wide":  # a view of 90 degrees, in whose corners z-depth and distance sort surfels differently
        scene = random_scene(60, seed=4, width=36, height=28, dtype=dtype, device=device)
        scene["K"][0, 0] = scene["K"][1, 1] = 16.0
        return scene
    scene = random_scene(seed=1, off_centre=name == "off_centre", dtype=dtype, device=device)
    if name == "specks":
        scene["scales"] *= 0.1
    if name == "near":  # the plane lies amid the surfels
        scene["near"] = 3.0
    return scene


def make_surfels(scene: Scene) -> nw.Surfels:
    return nw.Surfels.from_activated(*(scene[key] for key in SURFEL_KEYS))


def detached_shape(surfels: nw.Surfels) -> Activated:
    """Return the activated geometry without its history."""
    return Activated(*(x.detach() for x in surfels.activated()))


def make_camera(scene: Scene, **changes: Any) -> nw.Camera:
    """Make the scene's camera; its viewmat is a leaf of its own that asks for a gradient."""
    values = {key: scene[key] for key in CAMERA_KEYS} | changes
    return nw.Camera(**(values | {"viewmat": values["viewmat"].detach().clone().requires_grad_()}))


def make_texture(*, seed: int = 0, sh_degree: int = 3, residual=False, device="cpu", dtype=torch.float32):
    """Make a small field with random features and matrices, large enough to be seen in the image."""
    shape = {"width": 16, "hidden_layers": 2, "sh_degree": sh_degree, "residual": residual}
    texture = nw.NeuralTexture(4, 2**8, 2, 1.0, 6.0, **shape)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        texture.grid.copy_(torch.randn(texture.grid.shape, generator=generator))
        for matrix in texture.mlp.parameters():
            matrix.copy_((2.0 / matrix.shape[1]) ** 0.5 * torch.randn(matrix.shape, generator=generator))
    return texture.to(device=device, dtype=dtype)
