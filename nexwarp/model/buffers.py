"""All buffers of a rendering, and their OpenEXR file; docs/outputs.md describes it."""

import os
from dataclasses import dataclass
from pathlib import Path

import torch
from typing_extensions import Unpack

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.cameras_file import camera_entry, camera_of, origin_of
from nexwarp.io.pictures import load_exr, save_exr
from nexwarp.model.model import Model
from nexwarp.model.options import RenderChanges

FORMAT = 2
PASSES: tuple[str, ...] = ("image", "plain", "textured", "alpha", "ids", "depths", "weights", "colors")
PASSES += ("expected_depth", "median_depth", "top_depth", "normals")
SLOTS = ("ids", "depths", "weights", "colors")


@dataclass(frozen=True)
class Buffers:
    """All buffers of one rendering: those of `Rendering`, float32 but for the ids (int32); not differentiable.

    Up to rounding, image = plain + textured + (1 - alpha) background, and textured = sum over k of weights * colors.
    `background` is (3,), with the exposure applied, or (H, W, 3) if the lens has falloff.
    """

    image: torch.Tensor
    plain: torch.Tensor
    textured: torch.Tensor
    alpha: torch.Tensor
    ids: torch.Tensor
    depths: torch.Tensor
    weights: torch.Tensor
    colors: torch.Tensor
    expected_depth: torch.Tensor
    median_depth: torch.Tensor
    top_depth: torch.Tensor
    normals: torch.Tensor
    camera: Camera
    background: torch.Tensor


@torch.no_grad()
def render_buffers(model: Model, camera: Camera, **changes: Unpack[RenderChanges]) -> Buffers:
    """Render all buffers of a model; arguments and errors are those of `Model.render`."""
    camera = camera.to(model.device)
    out = model.render(camera, **changes)
    background = torch.tensor(model.options.background).to(out.image)
    if (factors := out.intermediates.factors) is not None:
        background = background * factors
    passes = {name: getattr(out, name) for name in PASSES}
    return Buffers(**passes, camera=camera, background=background)


def save_buffers(path: str | os.PathLike[str], buffers: Buffers) -> None:
    """Write one multi-part OpenEXR file, with one part per buffer, or per slot of a buffer that has K slots.

    The text attribute `nexwarp` holds camera, background and K as JSON; a background of shape (H, W, 3) is null there,
    and a part `background`. TypeError where a buffer is not float32, OSError where `path` cannot be written.
    """
    parts: dict[str, torch.Tensor] = {}
    for name in PASSES:
        value = getattr(buffers, name)
        if name in SLOTS:
            parts |= {f"{name}.{k}": value[:, :, k] for k in range(value.shape[2])}
        else:
            parts[name] = value
    camera, background = buffers.camera, buffers.background
    if background.ndim > 1:
        parts["background"] = background
    metadata = {
        "format": FORMAT,
        "max_hits": buffers.ids.shape[2],
        "background": None if background.ndim > 1 else background.tolist(),
        "camera": camera_entry(camera) | ({"origin": list(camera.origin)} if camera.origin else {}),
        "frame": "world to camera; cameras x right, y down, z forward; pixel centres at +0.5",
    }
    save_exr(path, parts, metadata)


def load_buffers(path: str | os.PathLike[str]) -> Buffers:
    """Read a file of `save_buffers` onto the CPU, bit for bit; ValueError where it has another format or is damaged."""
    path = Path(path)
    parts, metadata = load_exr(path)
    try:
        if metadata["format"] != FORMAT:
            raise ValueError(f"format: expected {FORMAT}, got {metadata['format']}")
        camera = camera_of(metadata["camera"], origin_of(metadata["camera"]))
        slots = range(metadata["max_hits"])
        buffers: dict[str, torch.Tensor] = {}
        for name in PASSES:
            if name not in SLOTS:
                buffers[name] = parts[name]
            elif slots:
                buffers[name] = torch.stack([parts[f"{name}.{k}"] for k in slots], dim=2)
            else:
                shape = (camera.height, camera.width, 0, *((3,) if name == "colors" else ()))
                buffers[name] = torch.empty(shape, dtype=torch.int32 if name == "ids" else torch.float32)
        color = metadata["background"]
        background = parts["background"] if color is None else torch.tensor(color, dtype=torch.float32)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: expected the buffers of a nexwarp rendering ({error})") from None
    return Buffers(**buffers, camera=camera, background=background)
